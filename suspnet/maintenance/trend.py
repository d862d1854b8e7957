"""Statistical tests of whether a parameter changes along the mileage."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from suspnet.ground.parameters import PAYLOAD
from suspnet.ground.types import FloatArray

LEVEL = 0.01
"""False-alarm rate of the tests: the share of unchanged parameters that are said to change."""
MULTIPLE = 2.0
"""A change counts only if it is larger than this multiple of the spread."""
LEAST_PERCENT = 0.1
"""A change counts only if it is larger than this, in % of healthy."""
N_ENDS = 5
"""Number of trips at the beginning, and at the end, whose medians are compared."""
MIN_SIZE = 3
"""Fewest trips on each side of a step: one odd trip is no step."""


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

    Attributes
    ----------
    mileage_km, gap_km : float, [km]
        Half-way between the trips before and after, and how far these are apart.
    n_before : int
        Trips before the step.
    size_percent : float, [% of healthy]
        Median after minus median before.
    p_value : float, [-]
        That independent, equally distributed trips give a step as clear as this one anywhere.
    significant : bool
    """

    mileage_km: float
    gap_km: float
    n_before: int
    size_percent: float
    p_value: float
    significant: bool


@dataclass(frozen=True)
class Trend:
    """How one parameter develops along the mileage.

    Attributes
    ----------
    parameter : str
    n_trips : int
        Trips with an estimate.
    n_needed : int
        Fewest trips for the tests.
    first_median, last_median : float, [-]
        Of the first and of the last trips, relative to healthy.
    change_percent : float, [% of healthy]
        Last minus first median.
    spread_percent : float, [% of healthy]
        Robust standard deviation of the trips about the local trend.
    p_value : float, [-]
        That trips without change give a difference of the ends, or a step, as clear as this.
    shape : Shape
    step : Step or None
        Where the shape is one with a step.
    n_ends : int
        Trips behind each of the medians.
    flagged_first, flagged_last : int
        Of these, flagged ones.
    without_flagged : bool
        Flagged trips were left out.
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
        """Whether there is a change; never of the car-body mass, which is payload."""
        return self.shape not in (Shape.TOO_FEW, Shape.NONE) and self.parameter != PAYLOAD


def trend(
    parameter: str,
    mileage_km: ArrayLike,
    values: ArrayLike,
    least_percent: float = LEAST_PERCENT,
) -> Trend:
    """Return whether a parameter at the end differs from the beginning, or has a step.

    Two tests share ``LEVEL``: Welch's t test of the last ``N_ENDS`` trips against the first ones,
    and that of ``steps``, which also sees what started fewer than ``N_ENDS`` trips ago. Whichever
    is significant, its difference of medians must also exceed ``MULTIPLE`` times the spread, so
    that single odd trips and clear but tiny changes do not count. Trips are taken as independent;
    what lasts for many trips (another line, season, load) counts as a change. With fewer than twice
    ``N_ENDS`` trips there is no test.

    Parameters
    ----------
    parameter : str
        "M_s" is payload, and never said to have changed.
    mileage_km : array of shape (n_trips,), [km]
        In any order.
    values : array of shape (n_trips,), [-]
        Relative to healthy; NaN: no estimate.
    least_percent : float, [% of healthy]
        No smaller change counts.

    Raises
    ------
    ValueError
        If shapes differ.

    Examples
    --------
    >>> mileage_km = 10_000 * np.arange(30)
    >>> ratios = np.where(mileage_km < 245_000, 1.0, 0.99) + 1e-3 * np.sin(mileage_km)
    >>> found = trend("k_p", mileage_km, ratios)
    >>> found.shape.name, found.step.mileage_km, round(found.change_percent, 1)
    ('STEP', 245000.0, -1.0)
    """
    km, known = known_trips(mileage_km, values)
    n = len(known)
    n_compared = min(N_ENDS, n // 2)
    first, last = known[:n_compared], known[n - n_compared :]
    start, end = (float(np.median(part)) if n_compared else np.nan for part in (first, last))
    change, spread = 100 * (end - start), 100 * _spread(known)
    found = Trend(parameter, n, 2 * N_ENDS, start, end, change, spread, n_ends=n_compared)
    if n < 2 * N_ENDS:
        return found
    threshold = max(MULTIPLE * spread, least_percent)
    step = steps(km, known, LEVEL / 2)
    p_ends = _welch(first, last)
    has_step = step is not None and step.significant and abs(step.size_percent) > threshold
    shape = Shape.NONE
    if step is not None and has_step:
        shape = _shape(known, change, threshold, step)
    elif p_ends < LEVEL / 2 and abs(change) > threshold:
        shape = Shape.ENDS
    p_value = min(1.0, 2 * p_ends, 2 * (step.p_value if step else 1.0))
    return replace(found, p_value=p_value, shape=shape, step=step if has_step else None)


def flagged_trend(
    parameter: str,
    mileage_km: ArrayLike,
    values: ArrayLike,
    flagged: ArrayLike,
    least_percent: float = LEAST_PERCENT,
) -> Trend:
    """Return the trend of trips of which some are flagged: their estimates may be wrong.

    They count like the others, because a badly worn part lies outside what a model was trained for;
    the trend says how many the ends rest on. But one odd trip can hide a change of all others: if
    nothing changes with the flagged trips and something does without, it is the trend without.

    Parameters
    ----------
    parameter, mileage_km, values, least_percent
        Of ``trend``.
    flagged : bool array of shape (n_trips,)
    """
    doubtful = np.asarray(flagged, dtype=bool)
    whole = trend(parameter, mileage_km, values, least_percent)
    if not doubtful.any():
        return whole
    rest = np.where(doubtful, np.nan, np.asarray(values, dtype=float))
    alone = trend(parameter, mileage_km, rest, least_percent)
    if alone.changed and not whole.changed:
        return replace(alone, without_flagged=True)
    known = np.where(np.isfinite(values), doubtful.astype(float), np.nan)
    marks = known_trips(mileage_km, known)[1]
    first, last = marks[: whole.n_ends], marks[len(marks) - whole.n_ends :]
    return replace(whole, flagged_first=int(first.sum()), flagged_last=int(last.sum()))


def steps(mileage_km: ArrayLike, values: ArrayLike, level: float = LEVEL) -> Step | None:
    """Return the split into two levels with the least sum of squares; None with too few trips.

    Its significance is that of Student's t test between the two sides, with Bonferroni's
    correction for the number of splits.

    Parameters
    ----------
    mileage_km : array of shape (n_trips,), [km]
        In any order.
    values : array of shape (n_trips,), [-]
        Relative to healthy; NaN: no estimate.
    level : float, [-]
        Largest probability of a significant step where there is none.

    Raises
    ------
    ValueError
        If shapes differ.
    """
    km, known = known_trips(mileage_km, values)
    n = len(known)
    if n < 2 * MIN_SIZE:
        return None
    centred = known - known.mean()
    before = np.arange(MIN_SIZE, n - MIN_SIZE + 1)
    between = np.cumsum(centred)[before - 1] ** 2 * n / (before * (n - before))
    best = int(np.argmax(between))
    size = int(before[best])
    within = max(float(centred @ centred - between[best]), 0.0)
    scale = math.sqrt(within / (n - 2))
    t = math.sqrt(between[best]) / scale if scale > 0 else math.inf * bool(np.ptp(known) > 0)
    p_value = min(1.0, float(2 * stats.t.sf(t, n - 2)) * len(before))
    change = 100 * float(np.median(known[size:]) - np.median(known[:size]))
    middle, gap = (km[size - 1] + km[size]) / 2, km[size] - km[size - 1]
    return Step(float(middle), float(gap), size, change, p_value, p_value < level)


def known_trips(mileage_km: ArrayLike, values: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return mileage and values in the order of the mileage, without what is not finite.

    Parameters
    ----------
    mileage_km : array of shape (n_trips,), [km]
    values : array of shape (n_trips,), [-]

    Raises
    ------
    ValueError
        If shapes differ.
    """
    km, known = np.asarray(mileage_km, dtype=float), np.asarray(values, dtype=float)
    if km.shape != known.shape or km.ndim != 1:
        raise ValueError(
            "`mileage_km` and `values` must be two lists of one number for each trip, got shapes "
            f"{km.shape} and {known.shape}"
        )
    finite = np.isfinite(km) & np.isfinite(known)
    order = np.argsort(km[finite], kind="stable")
    return km[finite][order], known[finite][order]


def _spread(values: FloatArray) -> float:
    """Return the robust standard deviation about the line through each trip's neighbours.

    The deviation from the mean of both neighbours has 1.5 times the variance of a trip, and a
    step or a slow fade hardly changes its median magnitude (Gasser, Sroka and Jennen-Steinmetz,
    Biometrika 73, 1986).
    """
    if len(values) < 3:
        return math.nan
    deviations = values[1:-1] - (values[:-2] + values[2:]) / 2
    return float(np.median(np.abs(deviations)) / stats.norm.ppf(0.75) / math.sqrt(1.5))


def _welch(first: FloatArray, last: FloatArray) -> float:
    """Return the p value of Welch's t test; 1 for constant, equal samples."""
    moments = [(part.mean(), part.std(ddof=1), len(part)) for part in (first, last)]
    with np.errstate(divide="ignore", invalid="ignore"):
        test = stats.ttest_ind_from_stats(*moments[0], *moments[1], equal_var=False)
    return float(np.nan_to_num(test.pvalue, nan=float(moments[0][0] == moments[1][0])))


def _shape(values: FloatArray, change: float, threshold: float, step: Step) -> Shape:
    """Return which shape a series with a step of more than `threshold` percent has."""
    if abs(change) <= threshold:
        return Shape.RETURNED
    after = values[step.n_before :]
    slopes = [_slope(side, change, threshold) for side in (values[: step.n_before], after)]
    if slopes[0] > 0.5 * slopes[1] > 0 and _is_line(values, threshold):
        return Shape.STEADY
    if _slope(after[-max(5, len(after) // 2) :], change, threshold) > 0:
        return Shape.GRADUAL
    return Shape.STEP


def _slope(values: FloatArray, change: float, threshold: float) -> float:
    """Return how fast one side of a step itself goes the way of the change, in % for each trip.

    Zero, if it goes the other way, by less than `threshold` in all, or not significantly.
    """
    if len(values) < 5 or np.ptp(values) == 0:
        return 0.0
    line = stats.linregress(np.arange(len(values)), values)
    slope = 100 * float(np.copysign(line.slope, line.slope * change))
    return slope if line.pvalue < LEVEL and slope * (len(values) - 1) > threshold else 0.0


def _is_line(values: FloatArray, threshold: float) -> bool:
    trips = np.arange(len(values))
    line = stats.linregress(trips, values)
    deviations = values - line.intercept - line.slope * trips
    return 100 * float(np.median(np.abs(deviations))) < threshold
