"""What healthy trips tell of how damping depends on temperature and on relative velocity.

The laws are in `suspnet.estimation.temperature` and `suspnet.estimation.relative_velocity`. Their
numbers are fitted where healthy trips differ in what damping depends on; elsewhere they keep their
prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from suspnet.estimation.relative_velocity import CHANGING, DampingByVelocity, linear, most, prior
from suspnet.estimation.temperature import (
    DAMPINGS,
    SLOPE_DEVIATION,
    USUAL_SLOPE,
    DampingByTemperature,
    kelvins_warmer,
)
from suspnet.ground.types import FloatArray
from suspnet.vehicle import Vehicle

DIFFERENT = 0.05
"""Standard deviation of the logarithms of relative velocities from which healthy trips show how
damping depends on them."""


@dataclass(frozen=True)
class Laws:
    """How the damping of a commissioned vehicle depends on temperature and on relative velocity.

    None if no temperature is known, or if the vehicle file allows for no dependence on velocity.
    """

    temperature: DampingByTemperature | None = None
    velocity: DampingByVelocity | None = None


class DampingNumbers:
    """Numbers of both laws that healthy trips tell, as coordinates in deviations from the prior.

    Parameters
    ----------
    vehicle : Vehicle
    temperatures_c : sequence of float or None, [°C]
        Of each trip, None if unknown.
    velocities_m_per_s : array of shape (n_groups, 2), [m/s]
        Relative velocities across the primary and the secondary suspension, of each group of
        spectra.
    trips : sequence of int
        Number of the trip of each group.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        temperatures_c: Sequence[float | None],
        velocities_m_per_s: FloatArray,
        trips: Sequence[int],
    ) -> None:
        self.healthy_c, warmer = kelvins_warmer(temperatures_c)
        self._warmer = np.array(warmer)[list(trips)]
        self._velocities, logs = velocities_m_per_s, np.log(velocities_m_per_s)
        self._healthy = np.exp(logs.mean(axis=0))
        self._most = most(vehicle)
        mean, deviation = prior(vehicle)
        # friction and its exponent, blow-off of c_p, of c_s
        varied = logs.std(axis=0)[[0, 0, 0, 0, 1]] > DIFFERENT
        # all numbers; those that the trips tell
        self._mean = np.array([*[USUAL_SLOPE] * len(DAMPINGS), *mean])
        self._deviation = np.array([*[SLOPE_DEVIATION] * len(DAMPINGS), *deviation])
        warm = [bool(any(warmer))] * len(DAMPINGS)
        self._told = np.flatnonzero([*warm, *(varied & (self._most > 0))])

    def __len__(self) -> int:
        return len(self._told)

    def factors(self, standard: Tensor, group: int) -> Tensor:
        """Return what multiplies ``CHANGING`` in a group, (n_rows, 3); `standard` (n_rows, len)."""
        numbers = torch.as_tensor(self._mean).repeat(len(standard), 1)
        numbers[:, self._told] += torch.as_tensor(self._deviation[self._told]) * standard
        slopes, shapes = numbers[:, : len(DAMPINGS)], numbers[:, len(DAMPINGS) :]
        warmed: Tensor = (slopes * self._warmer[group]).exp()
        columns = []
        for name, i in CHANGING.items():
            ends = float(self._velocities[group, i]), float(self._healthy[i])
            factor = torch.stack(linear(shapes, name, *ends)).sum(dim=0)
            columns.append(factor * warmed[:, i] if name in DAMPINGS else factor)
        return torch.stack(columns, dim=1)

    def laws(self, standard: FloatArray, covariance: FloatArray) -> Laws:
        """Return the laws at coordinates (len,) with their posterior covariance (len, len)."""
        numbers, spread = self._mean.copy(), np.diag(self._deviation**2)
        scale = self._deviation[self._told]
        numbers[self._told] += scale * standard
        spread[np.ix_(self._told, self._told)] = scale[:, None] * covariance * scale
        spread = (spread + spread.T) / 2
        n = len(DAMPINGS)
        temperature = velocity = None
        if self.healthy_c is not None:
            deviations = np.sqrt(np.diag(spread)[:n])
            both = tuple(numbers[:n].tolist()), tuple(deviations.tolist())
            temperature = DampingByTemperature(self.healthy_c, *both)
        if self._most.any():
            velocity = DampingByVelocity(
                tuple(self._healthy.tolist()),
                tuple(np.clip(numbers[n:], 0.0, self._most).tolist()),
                tuple(self._most.tolist()),
                tuple(map(tuple, spread[n:, n:].tolist())),
            )
        return Laws(temperature, velocity)
