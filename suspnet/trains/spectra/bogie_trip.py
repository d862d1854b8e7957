"""The spectral matrix of a trip from which each part of a bogie is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.welch import Welch
from suspnet.ground.parameters import FORWARD, SIDES, Direction
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.trains.spectra.subspace import SpectralMatrix

LOWEST_HZ = 0.5
"""Lowest bin whose speeds are counted: below it, they are noise of the sensors."""


@dataclass(frozen=True, repr=False)
class BogieTrip(ShortRepr):
    """Spectral matrix of a trip at one speed, its sensors in the order of the vehicle's.

    `frequencies_hz` (n_freq,) are bins that are independent of each other, `left_out` (n_freq,)
    says which of them hold other signals, None: none; `lost` are those of the vehicle's sensors
    that the trip has not. `welch` are the segments that leak into neighbouring bins, None: none do;
    each of `frequencies_hz` is in the middle of `n_bins` of their bins, whose spectra are averaged.
    `speed_scatter` [-] is the standard deviation of the speed within them over its mean.
    """

    frequencies_hz: Tensor
    spectra: SpectralMatrix
    speed_m_per_s: float
    direction: Direction = FORWARD
    lost: tuple[str, ...] = ()
    left_out: Tensor | None = None
    welch: Welch | None = None
    n_bins: int = 1
    speed_scatter: float = 0.0

    def of(self, bins: Tensor) -> Tensor:
        """Return the numbers of those bins that are not left out."""
        return bins if self.left_out is None else bins[~self.left_out[bins]]

    def in_order(self, order: Sequence[int]) -> BogieTrip:
        """Return the trip with its sensors in another order, given by their numbers."""
        return replace(self, spectra=self.spectra.of_sensors(order))

    def damper_speeds(self, sensors: Sequence[str]) -> FloatArray:
        """Return the rms speed at which primary and secondary dampers are stretched, (2,) [m/s].

        It is the mean over pairs of sensors at both ends of a damper, one of each end on a side,
        from ``LOWEST_HZ`` on; NaN where there is no pair. `sensors` are those of the vehicle.
        """
        own = [sensors[i] for i in self.kept(sensors)]
        used = self.of(torch.arange(len(self.frequencies_hz)))
        used = used[self.frequencies_hz[used] >= LOWEST_HZ]
        omega = 2 * torch.pi * self.frequencies_hz[used]
        width_hz = float(self.frequencies_hz[:2].diff())
        speeds = []
        for below, above in (("axle_box", "frame"), ("frame", "body")):
            squares = []
            for side in (*SIDES, "middle"):
                at_side = [
                    [i for i, p in enumerate(own) if p.startswith(end) and p.endswith(side)]
                    for end in (below, above)
                ]
                if all(at_side):
                    ends = [sensors_there[0] for sensors_there in at_side]
                    values = self.spectra.values[used][:, ends][:, :, ends]
                    both = values.diagonal(dim1=1, dim2=2).sum(dim=1) - 2 * values[:, 0, 1]
                    squares.append(float((both.real / omega**2).sum()) * width_hz)
            speeds.append(np.sqrt(np.mean(squares)) if squares else np.nan)
        return np.array(speeds)

    def kept(self, sensors: Sequence[str]) -> list[int]:
        """Return the numbers of those of a vehicle's sensors that the trip has.

        Sensitivities and delays are relative to the vehicle's first sensor, also if the trip has
        not that one.
        """
        return [i for i, name in enumerate(sensors) if name not in self.lost]


def smallest_noise(spectra: SpectralMatrix) -> Tensor:
    """Return the least that the other sensors do not explain of each one, (m,)."""
    inverse = torch.linalg.inv(spectra.values).diagonal(dim1=-2, dim2=-1).real
    noise: Tensor = (1 / inverse).amin(dim=0)
    return noise
