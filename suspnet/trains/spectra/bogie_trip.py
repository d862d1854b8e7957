"""The spectral matrix of a trip from which each part of a bogie is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from suspnet.curves.welch import Welch
from suspnet.ground.parameters import FORWARD, Direction
from suspnet.ground.wording import ShortRepr
from suspnet.trains.spectra.subspace import SpectralMatrix


@dataclass(frozen=True, repr=False)
class BogieTrip(ShortRepr):
    """Spectral matrix of a trip at one speed, its sensors in the order of the vehicle's.

    `frequencies_hz` (n_freq,) are bins that are independent of each other, `left_out` (n_freq,)
    says which of them hold other signals, None: none; `lost` are those of the vehicle's sensors
    that the trip has not. `welch` are the segments that leak into neighbouring bins, None: none do;
    each of `frequencies_hz` is in the middle of `n_bins` of their bins, whose spectra are averaged.
    """

    frequencies_hz: Tensor
    spectra: SpectralMatrix
    speed_m_per_s: float
    direction: Direction = FORWARD
    lost: tuple[str, ...] = ()
    left_out: Tensor | None = None
    welch: Welch | None = None
    n_bins: int = 1

    def of(self, bins: Tensor) -> Tensor:
        """Return the numbers of those bins that are not left out."""
        return bins if self.left_out is None else bins[~self.left_out[bins]]

    def in_order(self, order: Sequence[int]) -> BogieTrip:
        """Return the trip with its sensors in another order, given by their numbers."""
        return replace(self, spectra=self.spectra.of_sensors(order))

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
