"""Noisy curves of section III-B: magnitudes of degraded vehicles on a grid of bins, white noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from suspnet.dynamics import ResponseGenerator, Vehicle
from suspnet.ground.settings import check_settings, setting
from suspnet.spectra.directions import Directions, directions
from suspnet.spectra.misfit import CurveMisfit
from suspnet.spectra.noise import add_noise
from suspnet.spectra.observation import check_counts

MOST_BINS = 100_000
"""Largest number of frequency bins of a curve; the paper has 1000."""


@dataclass(frozen=True)
class CurveSettings:
    """Frequency bins, noise and numbers of curves.

    Raises
    ------
    TypeError, ValueError
        If a setting has the wrong type or is out of range.
    """

    kind: ClassVar[str] = "curves"

    n_train: int | str = setting(
        20_000,
        "Number of training curves, or all for the whole grid of the protocol",
        rule="whole number; 1 to 1e8",
    )
    n_test: int | str = setting(
        4_000, "Number of test curves, or all", rule="whole number; 1 to 1e8"
    )
    n_calibrate: int | None = setting(
        30_000,
        "Number of fresh curves that intervals and thresholds are learnt from; null gives the "
        "model neither",
        low=100,
        high=1e8,
    )
    snr_db: float = setting(
        34.0,
        "Signal-to-noise ratio of each curve; 34 dB is noise of 2 % of its rms",
        "dB",
        low=-20,
        high=200,
    )
    low_hz: float = setting(0.1, "First frequency bin, at least step_hz", "Hz", above=0, most=10000)
    high_hz: float = setting(20.0, "Upper end of the bins, above low_hz", "Hz", above=0, most=10000)
    step_hz: float = setting(
        0.02,
        "Distance of the bins; at most 100,000 of them up to high_hz",
        "Hz",
        above=0,
        most=10000,
    )
    cache_dir: str | None = setting(
        ".cache/suspnet",
        "Folder where features of curves are kept between runs; null keeps none",
        rule="path",
    )

    def __post_init__(self) -> None:
        check_counts(self)
        check_settings(self, "data")
        if not self.step_hz <= self.low_hz < self.high_hz:
            raise ValueError(
                "need data.step_hz <= data.low_hz < data.high_hz, got "
                f"{self.step_hz}, {self.low_hz}, {self.high_hz}"
            )
        if self.high_hz > MOST_BINS * self.step_hz:
            raise ValueError(
                f"data.step_hz={self.step_hz} makes more than {MOST_BINS} bins up to "
                f"data.high_hz={self.high_hz}; take wider ones"
            )

    def bound(self, vehicle: Vehicle) -> CurveSettings:
        """Return the same settings: none of them depends on the vehicle."""
        return self

    def observer(self, generator: ResponseGenerator) -> CurveObserver:
        """Return the source of noisy magnitudes of a generator's vehicles."""
        return CurveObserver(self, generator)

    def frequencies_hz(self) -> Tensor:
        """Return the frequency bins, shape (n_freq,), [Hz]."""
        n_bins = math.floor((self.high_hz - self.low_hz) / self.step_hz + 1e-9) + 1
        return self.low_hz + self.step_hz * torch.arange(n_bins, dtype=torch.float64)

    def words(self) -> str:
        """Return in words what is observed, with which noise."""
        return (
            f"Magnitudes of the responses, {self.low_hz:.3g} to {self.high_hz:.3g} Hz, with white "
            f"noise of {self.snr_db:g} dB, {100 * 10 ** (-self.snr_db / 20):.2g} % of each curve's "
            "rms."
        )


@dataclass(frozen=True)
class CurveObserver:
    """The observation of section III-B: magnitudes with white noise.

    Parameters
    ----------
    settings : CurveSettings
    generator : ResponseGenerator
    """

    settings: CurveSettings
    generator: ResponseGenerator

    @property
    def frequencies_hz(self) -> Tensor:
        """Bins, shape (n_freq,), [Hz]."""
        return self.settings.frequencies_hz()

    @cached_property
    def directions(self) -> Directions:
        """The directions of the generator's uncertain numbers that its curves show."""
        return directions(self)

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return abs(G_p) and abs(G_s), shape (n_vehicles, 2, n_freq), [-]."""
        return self.generator.magnitudes(ratios, self.frequencies_hz)

    def observe(self, ratios: Tensor, seed: int) -> Tensor:
        """Return noisy magnitudes; the generator's uncertain quantities are drawn too."""
        rows = self.generator.sample_unmeasured(ratios, seed)
        return add_noise(self.noise_free(rows), self.settings.snr_db, seed)

    def for_features(self, curves: Tensor) -> Tensor:
        """Return magnitudes as they are."""
        return curves

    def misfit(self, curves: Tensor, near: Tensor, used: Sequence[int] = (0, 1)) -> CurveMisfit:
        """Return the misfit of observed magnitudes, whose noise follows from their own rms."""
        return CurveMisfit(self, curves, tuple(used))
