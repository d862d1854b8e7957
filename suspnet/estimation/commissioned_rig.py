"""A rig as its healthy records show it, and later records relative to it.

Each record is read on its own, so that a later one differs from the mean of n healthy ones by d,
logarithms of ratios to healthy. The variance of a direction a of d, such as k_s / M_s, is ::

    V(a) = v(a) + s(a)^2,    v(a) = max(a^T C a, sum_b (a^T d_b)^2)

with C that of noise and of local errors of the physics, and d_b the difference of the influences of
each band of frequencies (`suspnet.trains.fits.rig_fit`): errors that all records have in common
cancel while the rig is as it was, and do not where its modes have moved. s is the scatter from
record to record, measured: each healthy record is read as a later one with the others as healthy.
With d_i and v_i as above, ::

    s^2 = max(0, mean_i(d_i^2 - v_i)) (1 + 1 / n) / (1 + 1 / (n - 1))

Intervals have Student's quantiles of n - 1 degrees of freedom, or of one less than bands if that is
smaller: few records, and few bands, tell little of both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.stats import t

from suspnet.estimation.trip_settings import LEAST_TRIPS
from suspnet.ground.parameters import PARAMETERS, Severity
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.vehicle.rig import Rig

BANDS = 5
"""Number of bands whose errors may be the same throughout: about one for each mode, dip and flank
of the responses. On the shelf of docs/rigs.md four and five hold what other methods find, eight
give intervals half as wide that do not."""
RATIOS: Mapping[str, tuple[float, ...]] = {
    **{name: tuple(row) for name, row in zip(PARAMETERS, np.eye(5).tolist(), strict=True)},
    "k_s_over_M_s": (0, 0, 1, 0, -1),
    "c_s_over_M_s": (0, 0, 0, 1, -1),
}
"""Directions of the logarithms of (k_p, c_p, k_s, c_s, M_s) over M_p: what is read as a ratio to
healthy."""
ABSOLUTE: Mapping[str, tuple[tuple[float, ...], float]] = {
    "primary_hz": ((0.5, 0, 0, 0, 0), 1 / (2 * math.pi)),
    "secondary_hz": ((0, 0, 0.5, 0, -0.5), 1 / (2 * math.pi)),
    "primary_damping": ((-0.5, 1, 0, 0, 0), 0.5),
    "secondary_damping": ((0, 0, -0.5, 1, -0.5), 0.5),
    "mass_ratio": ((0, 0, 0, 0, 1), 1.0),
}
"""Direction and factor of what is read as it is: the numbers of ``Rig``."""
LARGEST_LOG = 300.0
"""Largest logarithm of an end of an interval: a damper that no record shows may be anything."""
MOST_UNCERTAIN = 0.5
"""Standard deviation of the logarithm of a stiffness from which a record does not show it."""


@dataclass(frozen=True, repr=False)
class RigReading(ShortRepr):
    """The numbers of a rig from one record alone.

    `logs` (5,) are the logarithms of k_p, c_p, k_s, c_s and M_s over M_p in SI units,
    `covariance` (5, 5) that of noise and local errors, `influences` (``BANDS``, 5) those of each
    band. `errors` (n_freq, 3) [-] are the fractions of each signal that the physics errs by;
    `misfit` is the rms residual over noise and errors, `bare_misfit` that over noise alone.
    """

    logs: FloatArray
    covariance: FloatArray
    influences: FloatArray
    errors: FloatArray
    misfit: float
    bare_misfit: float
    converged: bool

    @property
    def values(self) -> dict[str, float]:
        """The numbers of ``ABSOLUTE``."""
        return {
            name: factor * math.exp(float(np.dot(direction, self.logs)))
            for name, (direction, factor) in ABSOLUTE.items()
        }

    def hides(self) -> tuple[str, ...]:
        """Return which of k_p and k_s the record does not show."""
        deviations = np.sqrt(np.diag(self.covariance))
        return tuple(
            name for name in ("k_p", "k_s") if deviations[PARAMETERS.index(name)] > MOST_UNCERTAIN
        )


@dataclass(frozen=True)
class Value:
    """A number with its interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, log: float, half_width: float, factor: float = 1.0) -> Value:
        """Return the number of a logarithm and half the width of its interval."""
        ends = (math.exp(min(log + side * half_width, LARGEST_LOG)) for side in (0, -1, 1))
        return cls(*(factor * end for end in ends))


@dataclass(frozen=True, repr=False)
class RigEstimate(ShortRepr):
    """A record relative to the healthy ones.

    `ratios` are those of ``RATIOS`` to healthy, `values` those of ``ABSOLUTE`` as they are, by
    name, with intervals of `level`. `severities` are those of each number that has limits.
    """

    ratios: Mapping[str, Value]
    values: Mapping[str, Value]
    severities: Mapping[str, Severity]
    level: float
    misfit: float
    bare_misfit: float

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate as JSON-able values."""
        return {
            "ratios": {name: asdict(value) for name, value in self.ratios.items()},
            "values": {name: asdict(value) for name, value in self.values.items()},
            "severities": {name: str(severity) for name, severity in self.severities.items()},
            "level": self.level,
            "misfit": self.bare_misfit,
        }

    def __repr__(self) -> str:
        return ", ".join(
            f"{name} {v.value:.3g} ({v.low:.3g} to {v.high:.3g})" for name, v in self.ratios.items()
        )

    @property
    def severity(self) -> Severity:
        """The worst of all numbers; no number that is too uncertain makes it unknown."""
        certain = [s for s in self.severities.values() if s != Severity.UNKNOWN]
        return max(certain, default=Severity.UNKNOWN)


@dataclass(frozen=True, repr=False)
class CommissionedRig(ShortRepr):
    """A rig as its healthy records show it; `records` are their names.

    They were read in segments of `segment_s`, from `low_hz` to `high_hz`. ValueError if there are
    fewer than three, or one does not show the suspension.
    """

    rig: Rig
    segment_s: float
    low_hz: float
    high_hz: float
    records: tuple[str, ...]
    readings: tuple[RigReading, ...]

    def __post_init__(self) -> None:
        for name in ("segment_s", "low_hz", "high_hz"):
            check_number(name, getattr(self, name), above=0)
        if len(self.readings) < LEAST_TRIPS or len(self.records) != len(self.readings):
            raise ValueError(
                f"{len(self.readings)} healthy records are given, at least {LEAST_TRIPS} are needed"
            )
        for name, reading in zip(self.records, self.readings, strict=True):
            if hidden := reading.hides():
                raise ValueError(
                    f"the healthy record {name} does not show {' and '.join(hidden)}: leave it out"
                )

    @cached_property
    def logs(self) -> FloatArray:
        """Mean of the healthy records' logarithms, (5,)."""
        return np.asarray(np.mean([reading.logs for reading in self.readings], axis=0))

    @property
    def misfit(self) -> float:
        """Rms of the healthy records' misfits without errors of the physics."""
        squares = np.square([reading.bare_misfit for reading in self.readings])
        return float(np.sqrt(squares.mean()))

    def without(self, i: int) -> tuple[RigReading, ...]:
        """Return the healthy readings other than one."""
        return self.readings[:i] + self.readings[i + 1 :]

    def scatter(self, direction: Sequence[float]) -> float:
        """Return s of the module's docstring, the scatter of a healthy record about the mean."""
        a, n = np.asarray(direction), len(self.readings)
        squares = []
        for i, reading in enumerate(self.readings):
            change, variance = _change(a, reading, self.without(i))
            squares.append(change**2 - variance)
        return math.sqrt(max(0.0, float(np.mean(squares))) * (1 + 1 / n) / (1 + 1 / (n - 1)))

    @cached_property
    def error(self) -> float:
        """Fraction of the signals that the physics errs by, median over frequency, [-]."""
        return float(np.median([np.sqrt(np.mean(r.errors**2, axis=1)) for r in self.readings]))

    def half_width(self, direction: Sequence[float], variance: float, level: float) -> float:
        """Return half the width of the interval of a logarithm with that v."""
        scattered = math.hypot(math.sqrt(variance), self.scatter(direction))
        return self._student((1 + level) / 2) * scattered

    def _student(self, probability: float) -> float:
        degrees = min(len(self.readings), BANDS) - 1
        return float(t.ppf(probability, degrees))

    def healthy(self, level: float = INTERVAL_LEVEL) -> dict[str, Value]:
        """Return the numbers of ``ABSOLUTE`` of the healthy rig, with intervals of their mean."""
        n, values = len(self.readings), {}
        for name, (direction, factor) in ABSOLUTE.items():
            a = np.asarray(direction)
            variance = max(
                a @ np.mean([r.covariance for r in self.readings], axis=0) @ a / n,
                float(np.sum((_mean_influence(self.readings) @ a) ** 2)),
            )
            scatter = self.scatter(direction) ** 2 / (n + 1)
            half = self._student((1 + level) / 2) * math.sqrt(variance + scatter)
            values[name] = Value.of(float(a @ self.logs), half, factor)
        return values

    def estimate(self, reading: RigReading, level: float = INTERVAL_LEVEL) -> RigEstimate:
        """Return a later record relative to the healthy ones, with intervals of that level."""
        return self._estimate(reading, self.readings, level)

    def estimate_healthy(self, i: int, level: float = INTERVAL_LEVEL) -> RigEstimate:
        """Return a healthy record relative to the other healthy ones."""
        return self._estimate(self.readings[i], self.without(i), level)

    def _estimate(
        self, reading: RigReading, healthy: Sequence[RigReading], level: float
    ) -> RigEstimate:
        check_number("level", level, above=0, below=1)
        ratios = {}
        for name, direction in RATIOS.items():
            change, variance = _change(np.asarray(direction), reading, healthy)
            ratios[name] = Value.of(change, self.half_width(direction, variance, level))
        values = {}
        for name, (direction, factor) in ABSOLUTE.items():
            a = np.asarray(direction)
            own = max(a @ reading.covariance @ a, float(np.sum((reading.influences @ a) ** 2)))
            half = self.half_width(direction, own, level)
            values[name] = Value.of(float(a @ reading.logs), half, factor)
        severities = {
            name: _severity(ratios[name], limits.notice, limits.act)
            for name, limits in self.rig.known_limits.items()
        }
        misfits = reading.misfit, reading.bare_misfit
        return RigEstimate(ratios, values, severities, level, *misfits)


def _mean_influence(readings: Sequence[RigReading]) -> FloatArray:
    return np.asarray(np.mean([reading.influences for reading in readings], axis=0))


def _change(
    direction: FloatArray, reading: RigReading, healthy: Sequence[RigReading]
) -> tuple[float, float]:
    """Return d and v of the module's docstring along a direction."""
    change = reading.logs - np.mean([other.logs for other in healthy], axis=0)
    covariance = reading.covariance + sum(other.covariance for other in healthy) / len(healthy) ** 2
    influence = (reading.influences - _mean_influence(healthy)) @ direction
    variance = max(float(direction @ covariance @ direction), float(influence @ influence))
    return float(direction @ change), variance


def _severity(ratio: Value, notice: tuple[float, float], act: tuple[float, float]) -> Severity:
    """Return how urgent a ratio is: beyond a limit only if its interval is wholly beyond it."""
    for severity, (low, high) in ((Severity.ACT, act), (Severity.NOTICE, notice)):
        if ratio.high < low or ratio.low > high:
            return severity
    is_certain = ratio.low >= act[0] * ratio.value and ratio.high <= act[1] * ratio.value
    return Severity.NONE if is_certain else Severity.UNKNOWN
