"""Whether a parameter changes along the mileage, in numbers and in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

FloatArray = NDArray[np.float64]
LEVEL = 0.01
"""How often a parameter that does not change may stand out."""
MULTIPLE = 2.0
"""A change stands out only if it is larger than this multiple of the spread,"""
LEAST_PERCENT = 0.1
"""and larger than this, in % of healthy."""
N_ENDS = 5
MIN_SIZE = 3
"""Fewest trips on each side of a step: one odd trip is no step."""
LARGE_PERCENT = 10.0
"""From here on, words say what is left instead of what has changed."""
TOLD_PERCENT = 2.0
"""If the last trip is this far from the last trips' median, the verdict names it."""
PAYLOAD = "M_s"


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
    first_median, last_median : float, [-]
        Of the first and of the last trips, relative to healthy.
    change_percent : float, [% of healthy]
        Last minus first median.
    spread_percent : float, [% of healthy]
        Robust standard deviation of the trips about the local trend.
    p_value : float, [-]
        That trips without change give a difference of the ends, or a step, as clear as this.
    stands_out : bool
        Because of a change, or because the last trips are more than ``LARGE_PERCENT`` off healthy.
        Never for the car-body mass, which is pay-load.
    verdict : str
        In words.
    """

    parameter: str
    n_trips: int
    first_median: float
    last_median: float
    change_percent: float
    spread_percent: float
    p_value: float
    stands_out: bool
    verdict: str


def trend(
    parameter: str,
    mileage_km: ArrayLike,
    values: ArrayLike,
    n_ends: int = N_ENDS,
    *,
    level: float = LEVEL,
    multiple: float = MULTIPLE,
    least_percent: float = LEAST_PERCENT,
) -> Trend:
    """Return whether a parameter at the end differs from the beginning, or has a step.

    Two tests share `level`: Welch's t test of the last `n_ends` trips against the first ones,
    and that of ``steps``, which also sees what began fewer than `n_ends` trips ago. Whichever is
    significant, its difference of medians must also exceed `multiple` times the spread, so that
    single odd trips and clear but tiny changes do not stand out. Trips are taken as independent;
    what lasts for many trips (another line, season, load) counts as a change.

    Parameters
    ----------
    parameter : str
        "M_s" is pay-load and never stands out.
    mileage_km : array of shape (n_trips,), [km]
        In any order.
    values : array of shape (n_trips,), [-]
        Relative to healthy; NaN: no estimate.
    n_ends : int
        With fewer than twice as many trips there is no test.
    level : float, [-]
        Largest share of unchanged parameters that stand out.
    multiple : float, [-]
    least_percent : float, [% of healthy]
        No smaller change stands out.

    Raises
    ------
    ValueError
        If shapes differ or `n_ends` is below 2.

    Examples
    --------
    >>> mileage_km = 10_000 * np.arange(30)
    >>> ratios = np.where(mileage_km < 245_000, 1.0, 0.99) + 1e-3 * np.sin(mileage_km)
    >>> trend("k_p", mileage_km, ratios).verdict
    'falls by 1.0 % at about 240 000 km'
    """
    if n_ends < 2:
        raise ValueError(f"`n_ends` must be at least 2 trips, got {n_ends}")
    km, known = _known(mileage_km, values)
    n = len(known)
    n_compared = min(n_ends, n // 2)
    first, last = known[:n_compared], known[n - n_compared :]
    ends = [float(np.median(part)) if n_compared else np.nan for part in (first, last)]
    change, spread = 100 * (ends[1] - ends[0]), 100 * _spread(known)
    head = (parameter, n, ends[0], ends[1], change, spread)
    level_now = ends[1] if n >= 2 * n_ends or n == 0 else float(np.median(known))
    off = parameter != PAYLOAD and abs(100 * (level_now - 1)) > max(LARGE_PERCENT, least_percent)
    if n < 2 * n_ends:
        verdict = f"too few trips ({n} of {2 * n_ends}) to tell of a change"
        if off:
            verdict += f"; at {100 * level_now:.0f} % of healthy"
        return Trend(*head, np.nan, off, verdict)
    limit = max(multiple * spread, least_percent)
    step = steps(km, known, level=level / 2)
    p_ends = _welch(first, last)
    ends_differ = p_ends < level / 2 and abs(change) > limit
    has_step = step is not None and step.significant and abs(step.size_percent) > limit
    if ends_differ or has_step:
        verdict = _verdict(known, ends[1], change, limit, step if has_step else None)
    else:
        verdict = _no_change(known, spread)
    if parameter == PAYLOAD:
        verdict += " (pay-load: varies by nature, no fault)"
    p_value = min(1.0, 2 * p_ends, 2 * (step.p_value if step else 1.0))
    stands_out = (ends_differ or has_step) and parameter != PAYLOAD
    if stands_out and abs(100 * (known[-1] - ends[1])) > TOLD_PERCENT:
        verdict += f"; the last trip is at {100 * known[-1]:.0f} %"
    return Trend(*head, p_value, stands_out or off, verdict)


def flagged_trend(
    parameter: str, mileage_km: ArrayLike, values: ArrayLike, flagged: ArrayLike, **options: Any
) -> Trend:
    """Return the trend of trips of which some are flagged: their estimates may be wrong.

    They count like the others, because a badly worn part lies outside what a model was trained for;
    the verdict says how many the ends rest on. But one odd trip can hide a change of all others: if
    nothing stands out with the flagged trips and something does without, it is the trend without.

    Parameters
    ----------
    parameter, mileage_km, values, **options
        Of ``trend``.
    flagged : bool array of shape (n_trips,)
    """
    doubtful = np.asarray(flagged, dtype=bool)
    whole = trend(parameter, mileage_km, values, **options)
    if not doubtful.any():
        return whole
    rest = np.where(doubtful, np.nan, np.asarray(values, dtype=float))
    alone = trend(parameter, mileage_km, rest, **options)
    if alone.stands_out and not whole.stands_out:
        return replace(alone, verdict=f"{alone.verdict}; without the flagged trips")
    known = np.where(np.isfinite(values), doubtful.astype(float), np.nan)
    return replace(whole, verdict=whole.verdict + _doubts(_known(mileage_km, known)[1]))


def steps(
    mileage_km: ArrayLike, values: ArrayLike, *, min_size: int = MIN_SIZE, level: float = LEVEL
) -> Step | None:
    """Return the split into two levels with the least sum of squares; None with too few trips.

    Its significance is that of Student's t test between the two sides, with Bonferroni's
    correction for the number of splits.

    Parameters
    ----------
    mileage_km : array of shape (n_trips,), [km]
        In any order.
    values : array of shape (n_trips,), [-]
        Relative to healthy; NaN: no estimate.
    min_size : int
        Fewest trips on each side.
    level : float, [-]
        Largest probability of a significant step where there is none.

    Raises
    ------
    ValueError
        If shapes differ or `min_size` is below 2.
    """
    if min_size < 2:
        raise ValueError(f"`min_size` must be at least 2 trips, got {min_size}")
    km, known = _known(mileage_km, values)
    n = len(known)
    if n < 2 * min_size:
        return None
    centred = known - known.mean()
    before = np.arange(min_size, n - min_size + 1)
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


def _doubts(flagged: FloatArray) -> str:
    """Return how many of the first and of the last trips are flagged; empty if none is."""
    n_compared = min(N_ENDS, len(flagged) // 2)
    ends = {"first": flagged[:n_compared], "last": flagged[len(flagged) - n_compared :]}
    words = [
        f"{part.sum():.0f} of the {end} {len(part)}" for end, part in ends.items() if part.any()
    ]
    verb = "is" if sum(part.sum() for part in ends.values()) == 1 else "are"
    return f"; {' and '.join(words)} trips {verb} flagged" if words else ""


def _known(mileage_km: ArrayLike, values: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return both in the order of the mileage, without what is not finite."""
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


def _verdict(
    values: FloatArray, last_median: float, change: float, limit: float, step: Step | None
) -> str:
    if step is not None and abs(change) <= limit:
        return (
            f"differs by {_percent(step.size_percent)} before and after about {_km(step)}, but "
            "ends as it began"
        )
    verb, going_on = ("falls", "falling") if change < 0 else ("rises", "rising")
    if abs(change) < LARGE_PERCENT:
        amount = f"{verb} by {_percent(change)}"
    else:
        amount = f"{verb} to {100 * last_median:.0f} % of healthy"
    if step is None:
        return f"{amount} from the first to the last trips"
    after = values[step.n_before :]
    slopes = [_slope(side, change, limit) for side in (values[: step.n_before], after)]
    if slopes[0] > 0.5 * slopes[1] > 0 and _is_line(values, limit):
        return f"{amount}, steadily along the mileage"
    if _slope(after[-max(5, len(after) // 2) :], change, limit) > 0:
        return f"{amount}, gradually around {_km(step)}, and was still {going_on} at the end"
    return f"{amount} at about {_km(step)}"


def _no_change(values: FloatArray, spread: float) -> str:
    verdict = f"no change beyond the spread of {_percent(spread)}"
    level = float(np.median(values))
    if abs(100 * (level - 1)) > max(LARGE_PERCENT, 3 * spread):
        verdict += f", at {100 * level:.0f} % of healthy from the first trip on"
    return verdict


def _slope(values: FloatArray, change: float, limit: float) -> float:
    """Return how fast one side of a step itself goes the way of the change, in % for each trip.

    Zero, if it goes the other way, by less than `limit` in all, or not significantly.
    """
    if len(values) < 5 or np.ptp(values) == 0:
        return 0.0
    line = stats.linregress(np.arange(len(values)), values)
    slope = 100 * float(np.copysign(line.slope, line.slope * change))
    return slope if line.pvalue < LEVEL and slope * (len(values) - 1) > limit else 0.0


def _is_line(values: FloatArray, limit: float) -> bool:
    """Tell whether most trips lie within `limit` percent of one straight line."""
    trips = np.arange(len(values))
    line = stats.linregress(trips, values)
    deviations = values - line.intercept - line.slope * trips
    return 100 * float(np.median(np.abs(deviations))) < limit


def _percent(value: float) -> str:
    size = abs(value)
    digits = 0 if size >= LARGE_PERCENT else 1 if size >= 0.095 else 2
    return f"{size:.{digits}f} %"


def _km(step: Step) -> str:
    """Return the mileage, rounded to the power of ten below the distance between the trips."""
    digits = math.floor(math.log10(max(step.gap_km, 1.0)))
    return f"{round(step.mileage_km, -digits):,.0f} km".replace(",", " ")
