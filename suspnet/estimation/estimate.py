"""Estimates from curves or a recording: values, intervals, flags and the healthy values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from scipy import stats

from suspnet.ground.findings import together
from suspnet.ground.parameters import UNITS, kind_of
from suspnet.ground.records import interval_ends
from suspnet.ground.settings import check_number
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.vehicle import PARAMETERS, ResponseGenerator, SpatialVehicle
from suspnet.vehicle.quantities import LogNormal

KINDS = ("missing", "cloud", "range", "misfit", "physics")
ENDS = ("value", "low", "high")
SHOWN = 10  # number of rows in the printed form
AXLE_SHARE = 0.5  # a primary spring or damper over that of its side, which both axles share
HEALTHY = "healthy_"  # name prefix of the uncertain numbers that are factors on the healthy values


@dataclass(frozen=True, repr=False)
class Estimate:
    """Parameters relative to healthy, one row per curve or recording; 1 is healthy.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters, the columns of all arrays.
    values : array of shape (n, n_outputs), [-]
        NaN where there is no estimate.
    low, high : arrays of shape (n, n_outputs), [-]
        Prediction intervals; NaN where the model was not calibrated.
    level : float
        Probability with which an interval holds the truth.
    flags : Flags
        Reasons not to trust a row; none if the model was not calibrated.
    healthy : HealthyValues or None
        Healthy values in SI units.
    found : str
        What the fit of a trip's curve found in addition to the parameters; empty if nothing.
    misfit : float, [-]
        Rms of what the fit of a trip leaves unexplained over that of the noise; NaN without a fit.
    lost : tuple of str
        Sensors without which the parts of a bogie were read, by their name in the manifest, or by
        their place where it has none.

    Examples
    --------
    >>> one = np.array([[0.93, 1.02]])
    >>> Estimate(("k_p", "c_p"), one, one - 0.01, one + 0.02, 0.9, Flags.none(1))
    k_p 0.93 (0.92 to 0.95), c_p 1.02 (1.01 to 1.04)
    """

    names: tuple[str, ...]
    values: FloatArray
    low: FloatArray
    high: FloatArray
    level: float
    flags: Flags
    healthy: HealthyValues | None = None
    found: str = ""
    misfit: float = np.nan
    lost: tuple[str, ...] = ()

    def scaled(self, factor: float) -> Estimate:
        """Return the estimate with half widths multiplied by a factor."""
        low, high = interval_ends(self.values, factor * self.half_widths)
        return replace(self, low=low, high=high)

    @property
    def half_widths(self) -> FloatArray:
        """Half the width of each interval in logarithms, shape (n, n_outputs), [-]."""
        with np.errstate(divide="ignore", invalid="ignore"):  # an end at 0 or below has no log
            return np.asarray((np.log(self.high) - np.log(self.low)) / 2)

    def si(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return values and ends of intervals in SI units, each (n, n_outputs).

        ValueError if the healthy values are unknown.
        """
        if self.healthy is None:
            raise ValueError("the estimate has no healthy values: give `healthy`")
        return self.healthy.si(self.values, self.half_widths, self.level)

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        lines = [self._line(row) for row in range(min(len(self), SHOWN))]
        if len(self) > SHOWN:
            lines.append(f"... and {len(self) - SHOWN} more")
        return "\n".join(lines) or "no curves"

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate as JSON-able values; None where there is no number.

        It includes SI values and their `unit` if the healthy values are known.
        """
        si = None if self.healthy is None else self.si()
        return {
            "level": self.level,
            "estimates": [
                {
                    "parameters": {
                        name: _ends((self.values, self.low, self.high), row, j)
                        | ({} if si is None else self._si(si, row, j))
                        for j, name in enumerate(self.names)
                    },
                    "flags": self.flags.reasons[row],
                }
                for row in range(len(self))
            ],
        }

    def _si(self, si: tuple[FloatArray, ...], row: int, j: int) -> dict[str, Any]:
        assert self.healthy is not None
        return {"si": _ends(si, row, j) | {"unit": self.healthy.units[j]}}

    def _line(self, row: int) -> str:
        parts = []
        for j, name in enumerate(self.names):
            if np.isnan(self.values[row, j]):
                parts.append(f"{name} no estimate")
                continue
            parts.append(f"{name} {self.values[row, j]:.3g}")
            if not np.isnan(self.low[row, j]):
                parts[-1] += f" ({self.low[row, j]:.3g} to {self.high[row, j]:.3g})"
        reason = self.flags.reasons[row]
        return ", ".join(parts) + (f"; flagged: {reason}" if reason else "")


def _ends(arrays: tuple[FloatArray, ...], row: int, j: int) -> dict[str, Any]:
    numbers = (float(array[row, j]) for array in arrays)
    return dict(zip(ENDS, (x if math.isfinite(x) else None for x in numbers), strict=True))


@dataclass(frozen=True)
class HealthyValues:
    """Values of the healthy vehicle, which a ratio of 1 refers to.

    They are the median of the generator's distribution, if it has one: the posterior of
    commissioning, or a prior about the vehicle file's values. The car body's is the nominal mass,
    without payload; a primary spring or damper is half of its side's. `names` are from
    ``PARAMETERS`` or ``COMPONENTS``, `values` (n,) in SI units;
    `deviations` (n,) are standard deviations of their logarithms, 0 where they are assumed to be
    known.
    """

    names: tuple[str, ...]
    values: FloatArray
    deviations: FloatArray

    @classmethod
    def of(
        cls, generator: ResponseGenerator | SpatialVehicle, names: Sequence[str]
    ) -> HealthyValues:
        """Return the healthy values of a generator's vehicle."""
        nominal = dict(zip(PARAMETERS, generator.vehicle.healthy_values(), strict=True))
        distribution = generator.distribution or LogNormal((), (), ())
        covariance = np.array(distribution.covariance).reshape(2 * (len(distribution.names),))
        values, deviations = [], []
        for name in names:
            # a part differs by a factor of its own from the mean of its kind
            factors = {f"{HEALTHY}{kind_of(name)}", f"{HEALTHY}{name}"} & set(distribution.names)
            of = [distribution.names.index(factor) for factor in sorted(factors)]
            share = AXLE_SHARE if "_axle" in name else 1.0
            values.append(
                share * nominal[kind_of(name)] * math.exp(sum(distribution.mean[i] for i in of))
            )
            deviations.append(math.sqrt(max(0.0, covariance[np.ix_(of, of)].sum())))
        return cls(tuple(names), np.array(values), np.array(deviations))

    @property
    def units(self) -> tuple[str, ...]:
        """SI unit of each value."""
        return tuple(UNITS[name] for name in self.names)

    def half_widths(self, level: float) -> FloatArray:
        """Return half the widths of their intervals in logarithms, (n,), [-]."""
        check_number("level", level, above=0, below=1)
        return np.asarray(stats.norm.ppf((1 + level) / 2) * self.deviations)

    def si(
        self, ratios: FloatArray, half_widths: FloatArray, level: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return values and ends of intervals in SI units, each (n_rows, n).

        `ratios` and `half_widths` (of logarithms) have the shape (n_rows, n). The uncertainty of
        the healthy value is independent of that of the ratio.
        """
        values = ratios * self.values
        half = np.hypot(half_widths, self.half_widths(level))
        return values, *interval_ends(values, half)


@dataclass(frozen=True)
class Flags:
    """Reasons not to trust each estimate.

    `given` has for each curve the reasons, each one of ``KINDS`` and its text.
    """

    given: tuple[tuple[tuple[str, str], ...], ...]

    @classmethod
    def none(cls, n_curves: int) -> Self:
        """Return flags of `n_curves` estimates with none set."""
        return cls(((),) * n_curves)

    @cached_property
    def found(self) -> BoolArray:
        """Which of ``KINDS`` are set, shape (n_curves, 5)."""
        kinds = [{kind for kind, _ in reasons} for reasons in self.given]
        rows = [[kind in some for kind in KINDS] for some in kinds]
        return np.array(rows, dtype=bool).reshape(len(rows), len(KINDS))

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        """The reasons of each curve as text, empty without any."""
        return tuple(together(words for _, words in given if words) for given in self.given)

    @property
    def flagged(self) -> BoolArray:
        """Whether any flag is set, shape (n_curves,)."""
        return np.asarray(self.found.any(axis=1))

    def has(self, *kinds: str) -> BoolArray:
        """Return whether any of some ``KINDS`` is set, shape (n_curves,)."""
        return np.asarray(self.found[:, [KINDS.index(kind) for kind in kinds]].any(axis=1))

    def with_kind(self, kind: str, words: str) -> Flags:
        """Return the flags with one of ``KINDS`` set in every row, and its text added."""
        return Flags(tuple((*reasons, (kind, words)) for reasons in self.given))

    def without(self, *kinds: str) -> Flags:
        """Return the flags without those of some ``KINDS``."""
        others = [
            tuple(reason for reason in reasons if reason[0] not in kinds) for reasons in self.given
        ]
        return Flags(tuple(others))
