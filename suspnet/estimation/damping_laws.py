"""What healthy trips tell of how damping depends on temperature and on relative velocity.

The laws are in `suspnet.estimation.temperature` and `suspnet.estimation.relative_velocity`. Each is
a slope of log damping, of primary and of secondary damping, which is fitted where healthy trips
differ in what it depends on; elsewhere it keeps its prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from suspnet.dynamics import Vehicle
from suspnet.estimation.relative_velocity import DampingByVelocity, allowed, prior
from suspnet.estimation.temperature import (
    DAMPINGS,
    SLOPE_DEVIATION,
    USUAL_SLOPE,
    DampingByTemperature,
    kelvins_warmer,
)
from suspnet.ground.types import FloatArray

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


@dataclass(frozen=True)
class _Slope:
    """Slope of the logarithm of damping number `damping` over `over` (n_groups,)."""

    damping: int
    mean: float
    deviation: float
    over: FloatArray


class DampingSlopes:
    """Slopes of log damping that healthy trips tell, as coordinates in deviations from the prior.

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
        self._most = allowed(vehicle)
        self.healthy_c, warmer = kelvins_warmer(temperatures_c)
        logs = np.log(velocities_m_per_s)
        self._healthy_log = logs.mean(axis=0)
        self._exponents, self._deviations = prior(vehicle)
        both = range(len(DAMPINGS))
        self._warm = [
            _Slope(j, USUAL_SLOPE, SLOPE_DEVIATION, np.array(warmer)[list(trips)]) for j in both
        ]
        self._fast = [
            _Slope(j, -self._exponents[j], self._deviations[j], logs[:, j] - self._healthy_log[j])
            for j in both
            if self._most[j] > 0 and logs[:, j].std() > DIFFERENT
        ]
        self._slopes = [*(self._warm if any(warmer) else []), *self._fast]

    def __len__(self) -> int:
        return len(self._slopes)

    def factors(self, standard: Tensor, group: int) -> Tensor:
        """Return what multiplies the damping of a group, (n_rows, 2); `standard` (n_rows, len)."""
        logs = torch.zeros(len(standard), len(DAMPINGS), dtype=torch.float64)
        for slope, own in zip(self._slopes, standard.T, strict=True):
            logs[:, slope.damping] += (slope.mean + slope.deviation * own) * slope.over[group]
        return logs.exp()

    def laws(self, standard: FloatArray, spread: FloatArray) -> Laws:
        """Return the laws at coordinates (len,) with posterior deviations `spread` (len,)."""
        slopes = np.array([USUAL_SLOPE] * len(DAMPINGS))
        deviations = np.array([SLOPE_DEVIATION] * len(DAMPINGS))
        exponents, uncertain = self._exponents.copy(), self._deviations.copy()
        for slope, own, its in zip(self._slopes, standard, spread, strict=True):
            found, deviation = slope.mean + slope.deviation * own, slope.deviation * its
            j = slope.damping
            if slope in self._fast:
                exponents[j], uncertain[j] = np.clip(-found, 0, self._most[j]), deviation
            else:
                slopes[j], deviations[j] = found, deviation
        temperature = velocity = None
        if self.healthy_c is not None:
            both = tuple(slopes.tolist()), tuple(deviations.tolist())
            temperature = DampingByTemperature(self.healthy_c, *both)
        if self._most.any():
            healthy = tuple(np.exp(self._healthy_log).tolist())
            both = tuple(exponents.tolist()), tuple(uncertain.tolist())
            velocity = DampingByVelocity(healthy, *both)
        return Laws(temperature, velocity)
