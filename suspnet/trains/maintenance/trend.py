"""Statistical tests of whether a parameter changes along the mileage."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from suspnet.ground.parameters import BODY_MASS
from suspnet.ground.types import FloatArray
from suspnet.trains.maintenance.noise import robust_spread

LEVEL = 0.01
"""False-alarm rate of the tests: the share of unchanged parameters reported as changed."""
MULTIPLE = 2.0
"""A change counts only if it is larger than this multiple of the spread."""
LEAST_PERCENT = 0.1
"""A change counts only if it is larger than this, in % of healthy."""
N_ENDS = 5
"""Number of trips at each end of the history whose medians are compared."""
MIN_SIZE = 3
"""Fewest trips on each side of a step: one outlier is not a step."""
N_RECENT, FAR_BETTER = 20, 0.3
"""Number of trips in which a change that began lately is distinguished from a step, and the share
of a step's sum of squares that a steady change leaves at most."""


class Shape(StrEnum):
    """Shape of the change along the mileage."""

    TOO_FEW = "too few trips"
    NONE = "no change"
    ENDS = "first and last trips differ"
    STEP = "a step"
    STEADY = "along the whole mileage"
    GRADUAL = "around a mileage, and still going on"
    RETURNED = "a step, but the last trips are like the first"


@dataclass(frozen=True)
class Step:
    """The most likely single change point of a series.

    `mileage_km` is half-way between the trips before and after it, `gap_km` their distance.
    `size_percent` is the median after minus that before, in % of healthy. `p_value` is the
    probability that independent, equally distributed trips show a step as clear as this one.
    """

    mileage_km: float
    gap_km: float
    n_before: int
    size_percent: float
    p_value: float
    significant: bool


@dataclass(frozen=True)
class ParameterTrend:
    """How one parameter develops along the mileage.

    `n_trips` have an estimate, the tests need `n_needed`. `first_median` and `last_median` are
    those of the first and of the last `n_ends` trips, relative to healthy, `change_percent` their
    difference, `spread_percent` the robust standard deviation of the trips about the local trend,
    both in % of healthy. `p_value` is the probability that unchanged trips show ends as different,
    or a step as clear, as these; `step` is None unless the shape has one. Of the first and the last
    `n_ends` trips, `flagged_first` and `flagged_last` are flagged; `without_flagged`: flagged trips
    were left out.
    """

    parameter: str
    n_trips: int
    n_needed: int
    first_median: float
    last_median: float
    change_percent: float
    spread_percent: float
    p_value: float = math.nan
    shape: Shape = Shape.TOO_FEW
    step: Step | None = None
    n_ends: int = 0
    flagged_first: int = 0
    flagged_last: int = 0
    without_flagged: bool = False

    @property
    def changed(self) -> bool:
        """Whether the parameter changed; always false for the car-body mass."""
        return self.shape not in (Shape.TOO_FEW, Shape.NONE) and self.parameter != BODY_MASS


def trend(
    parameter: str, mileage_km: ArrayLike, values: ArrayLike, least_percent: float = LEAST_PERCENT
) -> ParameterTrend:
    """Return whether the last trips of a parameter differ from the first, or it has a step.

    Two tests share ``LEVEL``: Welch's t test of the last ``N_ENDS`` trips against the first ones,
    and that of ``steps``, which also finds changes fewer than ``N_ENDS`` trips ago. The difference
    of medians of a significant test must also exceed ``MULTIPLE`` times the spread, so that single
    outliers and significant but tiny changes do not count. Trips are assumed independent; an effect
    of many trips (another line, season, load) counts as a change. There is no test with fewer than
    twice ``N_ENDS`` trips.

    `mileage_km` (in any order), `values` (relative to healthy; NaN: no estimate): (n_trips,).
    `least_percent` is the smallest change that counts, in % of healthy.

    Examples
    --------
    >>> mileage_km = 10_000 * np.arange(30)
    >>> ratios = np.where(mileage_km < 245_000, 1.0, 0.99) + 1e-3 * np.sin(mileage_km)
    >>> fallen = trend("k_p", mileage_km, ratios)
    >>> fallen.shape.name, fallen.step.mileage_km, round(fallen.change_percent, 1)
    ('STEP', 245000.0, -1.0)
    """
    km, ratios = usable_trips(mileage_km, values)
    n = len(ratios)
    n_compared = min(N_ENDS, n // 2)
    first, last = ratios[:n_compared], ratios[n - n_compared :]
    start, end = (float(np.median(side)) if n_compared else np.nan for side in (first, last))
    change, spread = 100 * (end - start), 100 * _spread(ratios)
    untested = ParameterTrend(
        parameter, n, 2 * N_ENDS, start, end, change, spread, n_ends=n_compared
    )
    if n < 2 * N_ENDS:
        return untested
    # both tests, and a size that matters
    threshold = max(MULTIPLE * spread, least_percent)
    step, p_ends = steps(km, ratios, LEVEL / 2), _welch(first, last)
    has_step = step is not None and step.significant and abs(step.size_percent) > threshold
    shape = Shape.NONE
    if step is not None and has_step:
        shape = _shape(ratios, change, threshold, step)
    elif p_ends < LEVEL / 2 and abs(change) > threshold:
        shape = Shape.ENDS
    p_value = min(1.0, 2 * p_ends, 2 * (step.p_value if step else 1.0))
    return replace(untested, p_value=p_value, shape=shape, step=step if has_step else None)


def flagged_trend(
    parameter: str,
    mileage_km: ArrayLike,
    values: ArrayLike,
    flagged: ArrayLike,
    least_percent: float = LEAST_PERCENT,
) -> ParameterTrend:
    """Return the ``trend`` of trips of which some are flagged: their estimates may be wrong.

    Flagged trips count, because a badly worn part is outside the range of the trained model; the
    trend states how many there are at its ends. But one outlier can hide a change of all other
    trips: if only the trend without flagged trips shows a change, that one is returned.
    """
    doubtful = np.asarray(flagged, dtype=bool)
    whole = trend(parameter, mileage_km, values, least_percent)
    if not doubtful.any():
        return whole
    rest = np.where(doubtful, np.nan, np.asarray(values, dtype=float))
    alone = trend(parameter, mileage_km, rest, least_percent)
    if alone.changed and not whole.changed:
        return replace(alone, without_flagged=True)
    marks = np.where(np.isfinite(values), doubtful.astype(float), np.nan)
    marks = usable_trips(mileage_km, marks)[1]
    first, last = marks[: whole.n_ends], marks[len(marks) - whole.n_ends :]
    return replace(whole, flagged_first=int(first.sum()), flagged_last=int(last.sum()))


def steps(mileage_km: ArrayLike, values: ArrayLike, level: float = LEVEL) -> Step | None:
    """Return the split into two levels with the least sum of squares; None with too few trips.

    Its significance at `level` is that of Student's t test between the two sides, with Bonferroni's
    correction for the number of splits. Arrays are as in ``trend``.
    """
    km, ratios = usable_trips(mileage_km, values)
    n = len(ratios)
    if n < 2 * MIN_SIZE:
        return None
    centred = ratios - ratios.mean()
    before = np.arange(MIN_SIZE, n - MIN_SIZE + 1)
    between = np.cumsum(centred)[before - 1] ** 2 * n / (before * (n - before))
    best = int(np.argmax(between))
    size = int(before[best])
    within = max(float(centred @ centred - between[best]), 0.0)
    scale = math.sqrt(within / (n - 2))
    t = math.sqrt(between[best]) / scale if scale > 0 else math.inf * bool(np.ptp(ratios) > 0)
    p_value = min(1.0, float(2 * stats.t.sf(t, n - 2)) * len(before))
    change = 100 * float(np.median(ratios[size:]) - np.median(ratios[:size]))
    middle, gap = (km[size - 1] + km[size]) / 2, km[size] - km[size - 1]
    return Step(float(middle), float(gap), size, change, p_value, p_value < level)


def usable_trips(mileage_km: ArrayLike, values: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the trips with finite mileage and value, sorted by mileage."""
    km, ratios = np.asarray(mileage_km, dtype=float), np.asarray(values, dtype=float)
    if km.shape != ratios.shape or km.ndim != 1:
        raise ValueError(
            "`mileage_km` and `values` must have one number for each trip, got shapes "
            f"{km.shape} and {ratios.shape}"
        )
    finite = np.isfinite(km) & np.isfinite(ratios)
    order = np.argsort(km[finite], kind="stable")
    return km[finite][order], ratios[finite][order]


def _spread(values: FloatArray) -> float:
    """Return the robust standard deviation about the mean of each trip's neighbours.

    That deviation has 1.5 times the variance of a trip; a step or a slow drift hardly changes its
    median magnitude (Gasser, Sroka and Jennen-Steinmetz, Biometrika 73, 1986).
    """
    return robust_spread(values[1:-1] - (values[:-2] + values[2:]) / 2, 1.5)


def _welch(first: FloatArray, last: FloatArray) -> float:
    """Return the p value of Welch's t test; 1 for constant, equal samples."""
    moments = [(side.mean(), side.std(ddof=1), len(side)) for side in (first, last)]
    with np.errstate(divide="ignore", invalid="ignore"):
        test = stats.ttest_ind_from_stats(*moments[0], *moments[1], equal_var=False)
    return float(np.nan_to_num(test.pvalue, nan=float(moments[0][0] == moments[1][0])))


def _shape(values: FloatArray, change: float, threshold: float, step: Step) -> Shape:
    """Return the shape of a series whose step is larger than `threshold` percent."""
    if abs(change) <= threshold:
        return Shape.RETURNED
    after = values[step.n_before :]
    slopes = [_slope(side, change, threshold) for side in (values[: step.n_before], after)]
    if slopes[0] > 0.5 * slopes[1] > 0 and _is_line(values, threshold):
        return Shape.STEADY
    if _slope(after[-max(5, len(after) // 2) :], change, threshold) > 0:
        return Shape.GRADUAL
    return Shape.GRADUAL if len(after) < 5 and _is_ramp(values[-N_RECENT:]) else Shape.STEP


def _slope(values: FloatArray, change: float, threshold: float) -> float:
    """Return the slope of one side of a step in the direction of the change, in % per trip.

    0 if its direction is opposite, its total below `threshold`, or it is not significant.
    """
    if len(values) < 5 or np.ptp(values) == 0:
        return 0.0
    line = stats.linregress(np.arange(len(values)), values)
    slope = 100 * float(np.copysign(line.slope, line.slope * change))
    return slope if line.pvalue < LEVEL and slope * (len(values) - 1) > threshold else 0.0


def _is_ramp(values: FloatArray) -> bool:
    """Return whether a level and a line from a bend on fit far better than two levels.

    Both have three numbers: where it changes, and two for the values.
    """
    trips = np.arange(len(values))
    every = trips - trips[:-1, None]
    left = []
    for shape in (np.maximum(every, 0.0), (every > 0) * 1.0):
        shape = shape - shape.mean(axis=1, keepdims=True)
        explained = np.square(shape @ values) / np.square(shape).sum(axis=1)
        left.append(np.square(values - values.mean()).sum() - explained.max())
    return bool(left[0] < FAR_BETTER * left[1])


def _is_line(values: FloatArray, threshold: float) -> bool:
    trips = np.arange(len(values))
    line = stats.linregress(trips, values)
    deviations = values - line.intercept - line.slope * trips
    return 100 * float(np.median(np.abs(deviations))) < threshold
