"""Comparison of the last trips with the limits, to decide on inspection or work."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from suspnet.ground.findings import Finding, percent
from suspnet.ground.parameters import Limits, Severity
from suspnet.ground.records import interval_ends
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.trains.maintenance.series import N_LAST, Series

N_CONFIRMING = 3  # number of the last trips beyond a limit that together confirm a crossing
Z = 1.645  # half width of a normal 90 % interval, in standard deviations
SMALLEST = 1e-6
"""Ratio to healthy to which values and ends of intervals are raised, so that they have a logarithm.
"""
ABSURD = 10.0  # ratio to healthy above which texts give no number, as no suspension reaches it


@dataclass(frozen=True)
class LastTrips:
    """The last trips with an estimate of one parameter, the newest last; (n_last,).

    `low` and `high` are the ends of the intervals, NaN if unknown. `all_flagged` is whether all
    trips with an estimate are flagged, including earlier ones.
    """

    values: FloatArray
    low: FloatArray
    high: FloatArray
    flagged: BoolArray
    all_flagged: bool = False

    @property
    def newest(self) -> Self:
        """The newest of these trips alone."""
        arrays = "values", "low", "high", "flagged"
        return replace(self, **{name: getattr(self, name)[-1:] for name in arrays})


@dataclass(frozen=True)
class Judged:
    """Result of ``judge``; all arrays have the shape of the cases.

    `side` is -1 below, 1 above, 0 within the limits. `run` is the number of newest trips in a row
    beyond the limit that determines the severity, `count` that of all last trips beyond it. `weak`
    marks a notice that is due to newest trips which are flagged or have no interval.
    """

    severity: IntArray
    side: IntArray
    run: IntArray
    count: IntArray
    weak: BoolArray


def judge(
    values: ArrayLike, low: ArrayLike, high: ArrayLike, flagged: ArrayLike, limits: Limits
) -> Judged:
    """Return the severity of the last trips, independently of earlier ones.

    A limit is crossed if

    - the newest trips in a row are beyond it, and the whole interval of one of them is; or
    - ``N_CONFIRMING`` of the last trips are beyond it, and the interval of their mean is. A trip
      counts for this if its interval reaches towards healthy by at most the distance of the limit
      from healthy, or if it is flagged or has no interval.

    The interval of a mean: with h the mean half width of its n trips, s the standard deviation of
    their logarithms and z = 1.645, z s of h is noise of single trips and the rest the error that
    they have in common, such as that of the vehicle::

        (half width)^2 = max(h^2 - (z s)^2, 0) + (z s)^2 / n

    h is of the trips with an interval that are not flagged. If ``N_CONFIRMING`` of the trips beyond
    are flagged or have no interval, these are taken at their word. A flagged trip, or one without
    an interval, raises at most a notice by itself. If the newest trip is beyond the notice limit,
    but not with certainty, the severity is unknown.

    False alarms of a healthy suspension, with intervals of 90 %, are 0.1 % of cases with
    independent errors and a half width of the distance of the limit from healthy, and 6 % at four
    times the half width; a test holds the rates.

    `values`, `low`, `high` and `flagged`: (..., n_last), the newest last; NaN: none. The result has
    the shape (...).
    """
    centre, lower, upper = (np.asarray(column, dtype=float) for column in (values, low, high))
    unsure = np.asarray(flagged, dtype=bool) | ~(np.isfinite(lower) & np.isfinite(upper))
    shape = centre.shape[:-1]
    severity, side, run, count = (np.zeros(shape, dtype=np.int64) for _ in range(4))
    weak = np.zeros(shape, dtype=bool)
    # most suspensions are healthy: nothing to compare costs a fleet of 1000 most of its seconds
    bounds = (*limits.notice, *limits.act)
    if not ((centre < max(bounds[::2])) | (centre > min(bounds[1::2]))).any():
        return Judged(severity, side, run, count, weak)
    for sign in (-1, 1):
        for level, pair in ((Severity.NOTICE, limits.notice), (Severity.ACT, limits.act)):
            limit = pair[(sign + 1) // 2]
            out = sign * (centre - limit) > 0
            # first rule: the newest trips in a row, one of them with its whole interval
            wholly = out & ~unsure & (sign * ((lower if sign > 0 else upper) - limit) > 0)
            newest = np.logical_and.accumulate(out[..., ::-1], axis=-1)[..., ::-1]
            # second rule: several trips and the interval of their mean
            reach = np.where(sign > 0, centre - lower, upper - centre)
            telling = out & (unsure | (reach <= abs(limit - 1)))
            inner = _inner_end(centre, reach, telling, unsure, sign)
            confirmed = (telling.sum(axis=-1) >= N_CONFIRMING) & (sign * (inner - limit) > 0)
            confirmed |= (telling & unsure).sum(axis=-1) >= N_CONFIRMING
            sure = (newest & wholly).any(axis=-1) | confirmed
            now, alone = np.where(sure, level, Severity.NONE), np.zeros(shape, dtype=bool)
            if level == Severity.NOTICE:  # what is not sure is at most this
                maybe = newest.any(axis=-1) & ~sure
                alone = maybe & (newest & unsure).any(axis=-1)
                now = np.where(maybe, Severity.UNKNOWN, now)
                now = np.where(alone, Severity.NOTICE, now)
            # of two sides that are equally severe, that of the newest trip counts
            worse = (now > severity) | ((now == severity) & (now > 0) & newest[..., -1])
            severity = np.where(worse, now, severity)
            side = np.where(worse, sign, side)
            run = np.where(worse, newest.sum(axis=-1), run)
            count = np.where(worse, out.sum(axis=-1), count)
            weak = np.where(worse, alone, weak)
    return Judged(severity, side, run, count, weak)


def _inner_end(
    centre: FloatArray, reach: FloatArray, chosen: BoolArray, unsure: BoolArray, sign: int
) -> FloatArray:
    """Return the end towards healthy of the interval of the mean of chosen trips; see `judge`.

    `reach` is how far the interval of each trip reaches towards healthy; the result lacks the last
    axis.
    """
    n, has_interval = np.maximum(chosen.sum(axis=-1), 1), chosen & ~unsure
    logs = np.log(np.where(chosen, np.maximum(centre, SMALLEST), 1.0))
    mean = logs.sum(axis=-1) / n
    squares = np.where(chosen, logs - mean[..., None], 0.0) ** 2
    noise = Z**2 * squares.sum(axis=-1) / np.maximum(n - 1, 1)
    ends = np.where(has_interval, np.maximum(centre - sign * reach, SMALLEST), 1.0)
    halves = np.where(has_interval, np.abs(logs - np.log(ends)), 0.0)
    half = halves.sum(axis=-1) / np.maximum(has_interval.sum(axis=-1), 1)
    common = np.maximum(half**2 - noise, 0.0)
    return np.asarray(np.exp(mean - sign * np.sqrt(common + noise / n)))


def last_trips(series: Series, name: str) -> LastTrips:
    """Return the last ``N_LAST`` trips with mileage and an estimate of a parameter."""
    done = np.flatnonzero(np.isfinite(series.mileage_km) & np.isfinite(series.estimates[name]))
    last = done[-N_LAST:]
    centre, half = series.estimates[name][last], series.half_widths[name][last]
    all_flagged = bool(len(done)) and bool(series.flagged[done].all())
    return LastTrips(centre, *interval_ends(centre, half), series.flagged[last], all_flagged)


def judge_last(last: LastTrips, limits: Limits | None) -> tuple[Severity, Judged | None]:
    """Return the severity of the last trips of a parameter, and the result of ``judge``.

    It is unknown without an estimate, and if all of the last trips are flagged and within the
    limits. Without limits, as for the car-body mass, it is none.
    """
    if limits is None:
        return Severity.NONE, None
    if len(last.values) == 0:
        return Severity.UNKNOWN, None
    judged = judge(last.values, last.low, last.high, last.flagged, limits)
    severity = Severity(int(judged.severity))
    if severity == Severity.NONE and last.flagged.all():
        return Severity.UNKNOWN, judged
    return severity, judged


def level_words(value: float, limit: float) -> str:
    """Return a level in %, with digits that distinguish it from a limit; see ``ABSURD``."""
    if value > ABSURD > limit:
        return Finding("over-percent-of", percent=100 * ABSURD)
    digits = 0
    while digits < 3 and round(100 * value, digits) == round(100 * limit, digits):
        digits += 1
    return Finding("level", percent=percent(100 * value, digits))


def beyond_words(side: int, severity: Severity, limit: float) -> Finding:
    """Return which limit is passed; `side` is 1 above healthy, -1 below."""
    kind = "act" if severity == Severity.ACT else "notice"
    return Finding(f"{'above' if side > 0 else 'below'}-{kind}-limit", limit=100 * limit)
