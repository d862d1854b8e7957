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
smaller: few records, and few bands, show little of both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import t

from suspnet.estimation.trip_settings import LEAST_TRIPS
from suspnet.ground.parameters import PARAMETERS, Limits, Severity
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.settings import check_flag, check_number
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.vehicle.rig import Rig

BANDS = 5
"""Number of bands whose errors may be the same throughout: about one for each mode, dip and flank
of the responses. On the shelf of docs/rigs.md four and five hold what other methods find, eight
give intervals half as wide that do not."""
RATIOS: Mapping[str, FloatArray] = {
    **dict(zip(PARAMETERS, np.eye(5), strict=True)),
    "k_s_over_M_s": np.array([0.0, 0, 1, 0, -1]),
    "c_s_over_M_s": np.array([0.0, 0, 0, 1, -1]),
}
"""Directions of the logarithms of (k_p, c_p, k_s, c_s, M_s) over M_p: what is read as a ratio to
healthy."""
ABSOLUTE: Mapping[str, tuple[FloatArray, float]] = {
    "primary_hz": (np.array([0.5, 0, 0, 0, 0]), 1 / (2 * math.pi)),
    "secondary_hz": (np.array([0, 0, 0.5, 0, -0.5]), 1 / (2 * math.pi)),
    "primary_damping": (np.array([-0.5, 1, 0, 0, 0]), 0.5),
    "secondary_damping": (np.array([0, 0, -0.5, 1, -0.5]), 0.5),
    "mass_ratio": (np.array([0.0, 0, 0, 0, 1]), 1.0),
}
"""Direction and factor of what is read as it is: the numbers of ``Rig``."""
SHAPES = {"logs": (5,), "covariance": (5, 5), "influences": (BANDS, 5), "errors": (-1, 3)}
"""Shapes of the arrays of a reading; -1 is any number of frequencies."""
EXPLAINED = 1.0  # rough misfit from which two masses on springs do not explain a record
LARGEST_LOG = 300.0
"""Largest logarithm of an end of an interval: a damper that no record shows may be anything."""
MOST_UNCERTAIN = 0.5
"""Standard deviation of the logarithm of a stiffness from which a record does not show it."""


@dataclass(frozen=True, eq=False, repr=False)
class Logs(ShortRepr):
    """Logarithms with what makes them uncertain.

    `logs` (5,) are those of k_p, c_p, k_s, c_s and M_s over M_p in SI units, or their differences,
    `covariance` (5, 5) that of noise and local errors, `influences` (``BANDS``, 5) those of each
    band.
    """

    logs: FloatArray
    covariance: FloatArray
    influences: FloatArray

    def along(self, direction: FloatArray) -> tuple[float, float]:
        """Return d and v of the module's docstring along a direction."""
        influence = self.influences @ direction
        variance = max(direction @ self.covariance @ direction, influence @ influence)
        return float(self.logs @ direction), float(variance)

    def minus(self, other: Logs) -> Logs:
        """Return the difference to independent ones, whose influences have the same causes."""
        return Logs(
            self.logs - other.logs,
            self.covariance + other.covariance,
            self.influences - other.influences,
        )

    @staticmethod
    def mean(several: Sequence[Logs]) -> Logs:
        """Return the mean of independent ones, whose influences have the same causes."""
        parts = ([getattr(each, name) for each in several] for name in list(SHAPES)[:3])
        logs, covariance, influences = (np.mean(part, axis=0) for part in parts)
        return Logs(logs, covariance / len(several), influences)


@dataclass(frozen=True, eq=False, repr=False)
class RigReading(Logs):
    """The numbers of a rig from one record alone.

    `errors` (n_freq, 3) [-] are the fractions of each signal that the physics errs by; `misfit` is
    the rms residual over noise and errors, `bare_misfit` that over noise alone, `rough_misfit` that
    over noise and large errors. ValueError or TypeError if a number is impossible.
    """

    errors: FloatArray
    misfit: float
    bare_misfit: float
    rough_misfit: float
    converged: bool

    def __post_init__(self) -> None:
        for name, shape in SHAPES.items():
            array = np.asarray(getattr(self, name), dtype=float)
            if array.shape != (len(array), *shape[1:]) or shape[0] not in (-1, len(array)):
                raise ValueError(f"`{name}` must be of shape {shape}, got {array.shape}")
            object.__setattr__(self, name, array)
        symmetric = np.allclose(self.covariance, self.covariance.T)
        if not symmetric or np.linalg.eigvalsh(self.covariance)[0] <= 0:
            raise ValueError("`covariance` must be symmetric and positive definite")
        if not (self.errors >= 0).all():
            raise ValueError("`errors` must not be negative")
        for name in ("misfit", "bare_misfit", "rough_misfit"):
            check_number(name, getattr(self, name), low=0)
        check_flag("converged", self.converged)

    @property
    def doubt(self) -> str:
        """Text if two masses on springs do not explain the record; empty if they do."""
        words = (
            "two masses on springs do not explain it: look at units, signs and places of sensors"
        )
        return words if self.rough_misfit >= EXPLAINED else ""

    @property
    def values(self) -> dict[str, float]:
        """The numbers of ``ABSOLUTE``."""
        return {n: f * math.exp(float(a @ self.logs)) for n, (a, f) in ABSOLUTE.items()}

    def hides(self) -> tuple[str, ...]:
        """Return which of k_p and k_s the record does not show."""
        deviations = dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)), strict=True))
        return tuple(name for name in ("k_p", "k_s") if deviations[name] > MOST_UNCERTAIN)


@dataclass(frozen=True)
class Value:
    """A number with its interval."""

    value: float
    low: float
    high: float

    def severity(self, limits: Limits) -> Severity:
        """Return how urgent a ratio is: beyond a limit only if its interval is wholly beyond it."""
        for severity, (low, high) in ((Severity.ACT, limits.act), (Severity.NOTICE, limits.notice)):
            if self.high < low or self.low > high:
                return severity
        low, high = limits.act
        is_certain = self.low >= low * self.value and self.high <= high * self.value
        return Severity.NONE if is_certain else Severity.UNKNOWN


@dataclass(frozen=True, repr=False)
class RigEstimate:
    """A record relative to the healthy ones.

    `ratios` are those of ``RATIOS`` to healthy, `values` those of ``ABSOLUTE`` as they are, by
    name, with intervals of `level`. `severities` are those of each number that has limits, `misfit`
    is the rms residual over the noise.
    """

    ratios: Mapping[str, Value]
    values: Mapping[str, Value]
    severities: Mapping[str, Severity]
    level: float
    misfit: float

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
        check_enough(len(self.records))
        for name, reading in zip(self.records, self.readings, strict=True):
            if hidden := reading.hides():
                raise ValueError(
                    f"the healthy record {name} does not show {' and '.join(hidden)}: leave it out"
                )

    @property
    def misfit(self) -> float:
        """Rms of the healthy records' misfits without errors of the physics."""
        squares = np.square([reading.bare_misfit for reading in self.readings])
        return float(np.sqrt(squares.mean()))

    @cached_property
    def error(self) -> float:
        """Fraction of the signals that the physics errs by, median over frequency, [-]."""
        errors = np.concatenate([reading.errors for reading in self.readings])
        return float(np.median(np.sqrt(np.mean(errors**2, axis=1))))

    def scatter(self, direction: FloatArray) -> float:
        """Return s of the module's docstring, the scatter of a healthy record about the mean."""
        n = len(self.readings)
        changes = [self._change(i).along(direction) for i in range(n)]
        excess = np.mean([change**2 - variance for change, variance in changes])
        return math.sqrt(max(0.0, float(excess)) * (1 + 1 / n) / (1 + 1 / (n - 1)))

    def healthy(self, level: float = INTERVAL_LEVEL) -> dict[str, Value]:
        """Return the numbers of ``ABSOLUTE`` of the healthy rig, with intervals of their mean."""
        return self._values(Logs.mean(self.readings), level, 1 / math.sqrt(len(self.readings) + 1))

    def estimate(self, reading: RigReading, level: float = INTERVAL_LEVEL) -> RigEstimate:
        """Return a later record relative to the healthy ones, with intervals of that level."""
        return self._estimate(reading, reading.minus(Logs.mean(self.readings)), level)

    def estimate_healthy(self, i: int, level: float = INTERVAL_LEVEL) -> RigEstimate:
        """Return a healthy record relative to the other healthy ones."""
        return self._estimate(self.readings[i], self._change(i), level)

    def _change(self, i: int) -> Logs:
        """Return a healthy record's difference to the mean of the others."""
        return self.readings[i].minus(Logs.mean(self.readings[:i] + self.readings[i + 1 :]))

    def _estimate(self, reading: RigReading, change: Logs, level: float) -> RigEstimate:
        check_number("level", level, above=0, below=1)
        ratios = {name: self._value(change, a, level) for name, a in RATIOS.items()}
        limits = self.rig.known_limits
        severities = {name: ratios[name].severity(limits[name]) for name in limits}
        values = self._values(reading, level)
        return RigEstimate(ratios, values, severities, level, reading.bare_misfit)

    def _values(self, logs: Logs, level: float, share: float = 1.0) -> dict[str, Value]:
        return {n: self._value(logs, a, level, f, share) for n, (a, f) in ABSOLUTE.items()}

    def _value(
        self,
        logs: Logs,
        direction: FloatArray,
        level: float,
        factor: float = 1.0,
        share: float = 1.0,
    ) -> Value:
        """Return the number of a direction; `share` is that of the scatter which it has."""
        log, variance = logs.along(direction)
        quantile = t.ppf((1 + level) / 2, min(len(self.readings), BANDS) - 1)
        half = quantile * math.hypot(math.sqrt(variance), share * self.scatter(direction))
        ends = (math.exp(min(end, LARGEST_LOG)) for end in (log, log - half, log + half))
        return Value(*(factor * end for end in ends))


def check_enough(n_records: int) -> None:
    """Raise ValueError if there are too few healthy records."""
    if n_records < LEAST_TRIPS:
        raise ValueError(
            f"{n_records} healthy records are given, at least {LEAST_TRIPS} are needed"
        )
