"""A fitted method that estimates from curves, spectra and recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_curves import estimate_curves
from suspnet.estimation.from_spectra import estimate_with_noise
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.settings import check_number
from suspnet.ground.tensors import as_tensor, curves_as_tensor

if TYPE_CHECKING:
    from suspnet.trains.recordings.recording import Recording

READS_TRIPS = "suspnet.trains.identification.from_recording"
"""Module with `estimate_trip`. It is imported for a trip only: a model of curves needs no trips."""
SAME_BIN_HZ = 1e-6  # difference [Hz] below which two frequency bins are the same


@dataclass(frozen=True, repr=False)
class TrainedModel(FittedMethod):
    """A fitted method that estimates from curves, spectra and recordings.

    Its attributes are those of ``FittedMethod``.
    """

    def __repr__(self) -> str:
        task, calibrated = self.task, "calibrated" if self.intervals is not None else "uncalibrated"
        return (
            f"TrainedModel({self.name}{', refined' * self.refined}, {calibrated}: "
            f"{', '.join(task.outputs)} of {self.vehicle.name}, protocol {task.protocol})"
        )

    def estimate(
        self,
        data: ArrayLike | Tensor | CrossSpectra | Recording | Path | str,
        frequencies_hz: ArrayLike | None = None,
        *,
        level: float = INTERVAL_LEVEL,
        mass: ArrayLike | None = None,
        settings: TripSettings | None = None,
    ) -> Estimate:
        """Return stiffness and damping relative to healthy, with intervals and flags.

        Parameters
        ----------
        data : array of shape (n_curves, 2, n_freq) or (2, n_freq), [-]
            G_p and G_s: magnitudes, or complex for a model of trips. Or a trip: its manifest's
            path, a ``Recording``, or its ``CrossSpectra`` on the model's bins.
        frequencies_hz : array of shape (n_freq,), optional, [Hz]
            Bins of the curves, which must be ``settings.frequencies_hz()``, the default.
        level : float
            Probability with which an interval holds the truth, in 0 to 1.
        mass : array of shape (n_curves,), optional, [-]
            Car-body mass relative to healthy, for curves and a model trained with a known mass.
        settings : TripSettings, optional
            How recordings are read; its `level` is replaced by `level`.

        Returns
        -------
        Estimate
            One row per curve, or one row for a trip.

        Raises
        ------
        FileNotFoundError, TripError
            If a trip's files are missing or wrong.
        NoEstimateError
            If a trip is valid but nothing can be estimated from it.
        ModelFileError
            If `data` is a trip but the model was not trained on trips.
        TypeError, ValueError
            If curves, frequencies or masses do not fit the model, or the level is none.
        """
        check_number("level", level, above=0, below=1)
        if isinstance(data, CrossSpectra):
            return estimate_with_noise(self, data, level)[0]
        if isinstance(data, str | Path) or hasattr(data, "manifest"):
            chosen = replace(settings or TripSettings(), level=level)
            estimate: Estimate = import_module(READS_TRIPS).estimate_trip(self, data, chosen)
            return estimate
        observer = self.settings.observer(self.generator)
        curves = _checked_curves(data, frequencies_hz, observer.frequencies_hz)
        mass_ratios = self._checked_mass(mass, curves)
        return estimate_curves(self, observer, curves.to(self.generator.device), level, mass_ratios)

    def _checked_mass(self, mass: ArrayLike | None, curves: Tensor) -> np.ndarray | None:
        if self.task.mass_known != (mass is not None):
            raise ValueError(
                "the model was trained to know the car-body mass: give `mass`, 1 is healthy"
                if mass is None
                else "the model was trained without the car-body mass: leave `mass` out"
            )
        if mass is None:
            return None
        ratios = np.asarray(mass, dtype=np.float64).reshape(-1)
        if ratios.shape != (len(curves),) or not (np.isfinite(ratios) & (ratios > 0)).all():
            raise ValueError(
                f"`mass` must be one positive number for each of {len(curves)} curves, got {mass!r}"
            )
        return ratios


def _checked_curves(
    data: ArrayLike | Tensor, frequencies_hz: ArrayLike | None, bins: Tensor
) -> Tensor:
    values = curves_as_tensor(data)
    values = values.to(torch.complex128 if values.is_complex() else torch.float64)
    values = values[None] if values.ndim == 2 else values
    if frequencies_hz is not None:
        hertz, own = as_tensor(frequencies_hz), bins.cpu()
        if hertz.shape != own.shape or not torch.allclose(hertz, own, rtol=0, atol=SAME_BIN_HZ):
            raise ValueError(
                f"`frequencies_hz` must be the {len(own)} bins of the model, {float(own[0]):g} to "
                f"{float(own[-1]):g} Hz: model.settings.frequencies_hz(); got {hertz.numel()} bins"
            )
    if values.ndim != 3 or tuple(values.shape[1:]) != (2, len(bins)):
        raise ValueError(
            f"curves must have shape (n_curves, 2, {len(bins)}), got {tuple(values.shape)}"
        )
    return values
