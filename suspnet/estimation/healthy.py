"""Healthy values in SI units, which estimates are relative to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from suspnet.dynamics import PARAMETERS, ResponseGenerator
from suspnet.ground.checks import check_number
from suspnet.ground.parameters import UNITS
from suspnet.ground.types import FloatArray

HEALTHY = "healthy_"
"""Prefix of the uncertain numbers of a generator that its healthy values are multiplied by."""


@dataclass(frozen=True)
class HealthyValues:
    """What a ratio of 1 means: values of the healthy vehicle.

    They are the median of the generator's distribution, where it has one: the posterior of
    commissioning, or a prior about the vehicle file's values. Of the car body it is the nominal
    mass, which pay-load varies from.

    Attributes
    ----------
    names : tuple of str
        From ``PARAMETERS``.
    values : array of shape (n,), [N/m, N s/m, kg]
    deviations : array of shape (n,), [-]
        Standard deviations of their logarithms; 0 where they are taken as known.
    """

    names: tuple[str, ...]
    values: FloatArray
    deviations: FloatArray

    @classmethod
    def of(cls, generator: ResponseGenerator, names: Sequence[str]) -> HealthyValues:
        """Return the healthy values of a generator's vehicle."""
        nominal = dict(zip(PARAMETERS, generator.vehicle.healthy_values(), strict=True))
        values = {name: nominal[name] for name in names}
        deviations = dict.fromkeys(names, 0.0)
        known = generator.distribution
        if known is not None:
            told = zip(known.names, known.mean, known.deviations.tolist(), strict=True)
            for full, mean, deviation in told:
                name = full.removeprefix(HEALTHY)
                if full.startswith(HEALTHY) and name in values:
                    values[name] *= math.exp(mean)
                    deviations[name] = deviation
        return cls(tuple(names), np.array(list(values.values())), np.array([*deviations.values()]))

    @property
    def units(self) -> tuple[str, ...]:
        """SI unit of each."""
        return tuple(UNITS[name] for name in self.names)

    def half_widths(self, level: float) -> FloatArray:
        """Return half the widths of their intervals in logarithms, (n,), [-].

        Raises
        ------
        ValueError
            Unless 0 < level < 1.
        """
        check_number("level", level, above=0, below=1)
        return np.asarray(stats.norm.ppf((1 + level) / 2) * self.deviations)

    def si(
        self, ratios: FloatArray, half_widths: FloatArray, level: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return values and ends of intervals in SI units.

        The uncertainty of the healthy value counts as independent of that of the ratio.

        Parameters
        ----------
        ratios, half_widths : arrays of shape (n_rows, n), [-]
            Relative to healthy; half widths in logarithms.
        level : float
            Probability of the intervals.
        """
        values = ratios * self.values
        half = np.hypot(half_widths, self.half_widths(level))
        with np.errstate(over="ignore"):  # nothing is known: from 0 to infinity
            return values, values * np.exp(-half), values * np.exp(half)
