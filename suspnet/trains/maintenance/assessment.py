"""Assessment of a parameter from its trips, for maintenance: its severity and the reason."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import stdtr

from suspnet.ground.findings import Finding, kind_is, percent, together
from suspnet.ground.parameters import BODY_MASS, Cause, Limits, Severity
from suspnet.ground.types import FloatArray
from suspnet.trains.maintenance import judge
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.maintenance.change import Changes
from suspnet.trains.maintenance.life import Life
from suspnet.trains.maintenance.noise import robust_spread
from suspnet.trains.maintenance.series import N_LAST, Series

LEVEL, MULTIPLE, LEAST_PERCENT = 0.01, 2.0, 0.1
"""A step counts at this level, if it exceeds this multiple of the spread and this size [%]."""
LEAST_SIDE = 3  # fewest trips on each side of a step: one outlier is none
ONE_FLAGGED = "the only trip is flagged"
LARGE_PERCENT = 10.0  # least difference from healthy, in %, for which the text gives the level
REPORTED_PERCENT = 2.0
"""Least deviation of the last trip from the median of the last trips, in % of healthy, for which
the text gives its value."""
FLAGGED = "flagged-trip", "flagged-trips"
"""Kinds of the level of one trip, or of several, of which a flag is set."""
ALL_FLAGGED = "all trips are flagged"


@dataclass(frozen=True)
class ParameterTrend:
    """How one parameter develops along the mileage.

    `first_median` and `last_median` are those of the first and of the last `n_ends` of the
    `n_trips` with an estimate, relative to healthy, `change_percent` their difference, which counts
    from `n_needed` trips on, `spread_percent` the robust standard deviation of the trips about the
    local trend, both in % of healthy. `flagged_last` of the last `n_ends` trips are flagged.
    `changed` is whether a change has been found that lasts; always false for the car-body mass.
    """

    parameter: str
    n_trips: int
    first_median: float
    last_median: float
    change_percent: float
    spread_percent: float
    n_ends: int = 0
    n_needed: int = 2 * N_LAST
    flagged_last: int = 0
    changed: bool = False


def trend_of(series: Series, name: str) -> ParameterTrend:
    """Return the trend of a parameter from the trips with a mileage.

    The spread is about the mean of each trip's neighbours, a deviation with 1.5 times the variance
    of a trip; a step or a slow drift hardly changes its median magnitude (Gasser, Sroka and
    Jennen-Steinmetz, Biometrika 73, 1986).
    """
    done = np.isfinite(series.mileage_km) & np.isfinite(series.estimates[name])
    values, flagged = series.estimates[name][done], series.flagged[done]
    n_ends = min(N_LAST, len(values) // 2)
    first, last = values[:n_ends], values[len(values) - n_ends :]
    start, end = (float(np.median(side)) if n_ends else np.nan for side in (first, last))
    return ParameterTrend(
        name,
        len(values),
        start,
        end,
        100 * (end - start),
        100 * robust_spread(values[1:-1] - (values[:-2] + values[2:]) / 2, 1.5),
        n_ends,
        flagged_last=int(flagged[len(values) - n_ends :].sum()),
    )


def step_words(mileage_km: FloatArray, values: FloatArray, spread_percent: float) -> str:
    """Return where trips that are too few for ``find_changes`` have a step; empty without one.

    It is the split into two levels with the least sum of squares, significant by Student's t test
    with Bonferroni's correction for the number of splits. Trips are by mileage; NaN: no estimate.
    """
    done = np.isfinite(mileage_km) & np.isfinite(values)
    km, values = mileage_km[done], values[done]
    n, splits = len(values), np.arange(LEAST_SIDE, len(values) - LEAST_SIDE + 1)
    if n < 2 * N_LAST:
        return ""
    centred = values - values.mean()
    between = np.cumsum(centred)[splits - 1] ** 2 * n / (splits * (n - splits))
    at, within = int(splits[between.argmax()]), max(centred @ centred - between.max(), 1e-300)
    t = math.sqrt(between.max() / within * (n - 2))
    percent = 100 * (float(np.median(values[at:]) / np.median(values[:at])) - 1)
    is_large = abs(percent) > max(MULTIPLE * spread_percent, LEAST_PERCENT)
    if not is_large or 2 * stdtr(n - 2, -t) * len(splits) >= LEVEL:
        return ""
    kind, about = "fell" if percent < 0 else "rose", round((km[at - 1] + km[at]) / 2, -3)
    return Finding(kind, percent=abs(percent), km=about)


@dataclass(frozen=True)
class Assessment:
    """Assessment of one parameter from its trips; `words` is the reason of the severity.

    `limited` is whether the parameter has limits, `tested` whether there are enough trips to find a
    change; `life` is the mileage until the act limit, None if unknown; `now` [-] is the median of
    the last trips. `unknown_life` is why the remaining life is unknown or unreliable, empty if it
    is known.
    """

    trend: ParameterTrend
    severity: Severity
    words: str
    limited: bool = True
    tested: bool = True
    life: Life | None = None
    now: float = math.nan
    unknown_life: str = ""

    @property
    def parameter(self) -> str:
        """Name of the parameter."""
        return self.trend.parameter

    @property
    def is_named(self) -> bool:
        """Whether the parameter is named at the top of a report."""
        return self.severity > Severity.NONE or self.trend.changed


@dataclass(frozen=True)
class Evidence:
    """What the assessment of one parameter rests on.

    `limits` None means that no value is alarming, as for M_s. `alarms` are the active ones of the
    parameter, `lasting` says how it has changed for good, `changes` is the state of the detector.
    `doubt` is why the limits cannot be applied, empty if they can.
    """

    trend: ParameterTrend
    last: judge.LastTrips
    limits: Limits | None
    alarms: Sequence[Alarm] = ()
    lasting: str = ""
    changes: Changes = field(default_factory=Changes)
    doubt: str = ""

    @property
    def is_short(self) -> bool:
        """Whether the trips are too few to find a change, or the detector has not looked yet."""
        is_unseen = not self.changes.n_needed and self.trend.n_trips < self.trend.n_needed
        return bool(self.changes.why_not) or is_unseen


def assess(of: Evidence) -> Assessment:
    """Return the assessment of one parameter; all reports use this rule.

    Its severity is the worst of the last trips' (``judge_last``) and of the active alarms'. A doubt
    about a parameter with limits makes it unknown at least.
    """
    by_limits, words = judge.judge_last(of.last, of.limits)[0], _words(of)
    least = Severity.UNKNOWN if of.doubt and of.limits is not None else Severity.NONE
    severity = max(least, by_limits, *(alarm.severity for alarm in of.alarms))
    # an alarm that the last trips alone do not explain comes first
    worst = max(of.alarms, key=lambda alarm: (alarm.severity, -alarm.begin_km), default=None)
    if worst is not None and worst.severity > by_limits:
        is_said = worst.cause == Cause.CHANGE and bool(of.lasting)
        since = Finding("alarm-since", words=words if is_said else worst.words, km=worst.begin_km)
        words = since if is_said else together((since, words))
    if of.doubt and of.limits is not None:
        words = together((of.doubt, words))
    return Assessment(of.trend, severity, words, of.limits is not None, not of.is_short)


def joined(assessments: Sequence[Assessment]) -> list[list[Assessment]]:
    """Return assessments grouped by severity and reason, in order of first occurrence."""
    groups: dict[tuple[Severity, str], list[Assessment]] = {}
    for assessment in assessments:
        groups.setdefault((assessment.severity, assessment.words), []).append(assessment)
    return list(groups.values())


def worst_first(assessments: Sequence[Assessment]) -> list[Assessment]:
    """Return the assessments named at the top of a report, the most severe first."""
    return sorted((a for a in assessments if a.is_named), key=lambda a: -a.severity)


def spoken(assessments: Sequence[Assessment]) -> str:
    """Return severity, sentence and reasons as lines for a terminal."""
    lines = [
        f"  {group[0].severity!s:7s}  {', '.join(a.parameter for a in group)}: {group[0].words}"
        for group in joined(worst_first(assessments))
    ]
    return "\n".join([overall(assessments)[1], *lines])


def overall(assessments: Sequence[Assessment]) -> tuple[Severity, str]:
    """Return the largest severity of all parameters, and a sentence on them."""
    judged = [a for a in assessments if a.parameter != BODY_MASS]
    severity = max((a.severity for a in judged), default=Severity.UNKNOWN)
    n = {level: sum(a.severity == level for a in judged) for level in Severity}
    n_changed = sum(a.trend.changed for a in judged)
    n_all, quiet = len(judged), "No parameter is beyond its limits"
    if not any(a.limited for a in judged):
        quiet = "No parameter has limits"
    # the most severe first; without an alarm, what is not known comes before what is quiet
    if severity == Severity.ACT:
        kind, n_notice = "act-and-notice" if n[Severity.NOTICE] else "act", n[Severity.NOTICE]
        sentence = Finding(kind, n=n[severity], n_all=n_all, n_notice=n_notice)
    elif severity == Severity.NOTICE:
        sentence = Finding("notice", n=n[severity], n_all=n_all)
    elif not any(a.trend.n_trips for a in judged):
        sentence = Finding("nothing-known")
    elif severity == Severity.UNKNOWN:
        sentence = Finding("not-all-judged", n=n[severity], n_all=n_all)
    elif n_changed:
        sentence = Finding("some-changed", quiet=quiet, n=n_changed, n_all=n_all)
    elif not all(a.tested for a in judged):
        sentence = Finding("all-too-few", quiet=quiet)
    else:
        sentence = Finding("nothing-stands-out", quiet=quiet)
    return severity, sentence


def _words(of: Evidence) -> str:
    """Return the reason from the trips alone, without alarms."""
    severity, judged = judge.judge_last(of.last, of.limits)
    if len(of.last.values) == 0:
        return "no trip with an estimate"
    if of.limits is None or judged is None:
        clauses = _calm(of)
    elif judged.severity > Severity.NONE:
        clauses = [_level(judged, of.last, of.limits), *_development(of, judged, of.limits)]
    elif severity == Severity.UNKNOWN:  # all of the last trips are flagged
        n_last = len(of.last.values)
        why = ALL_FLAGGED if of.last.all_flagged else Finding("all-last-flagged", n=n_last)
        if of.last.all_flagged and n_last == 1:
            why = ONE_FLAGGED
        return together([Finding("not-judged", why=why), of.lasting])
    else:
        clauses = _calm(of)
    flags = []
    if of.last.all_flagged:
        flags = [ALL_FLAGGED]
    elif n_flagged := of.trend.flagged_last:
        is_said = any(kind_is(clause, kind) for clause in clauses for kind in FLAGGED)
        if n_flagged > 1 or not is_said:
            flags = [Finding("flagged-last", n=n_flagged, n_ends=of.trend.n_ends)]
    words = together([*clauses, *flags])
    # flags silence no verdict, as a badly worn part is flagged too, but its numbers may be off
    is_doubtful = severity >= Severity.NOTICE and bool(of.last.flagged.all())
    return Finding("inspect-first", words=words) if is_doubtful and flags else words


def _level(judged: judge.Judged, last: judge.LastTrips, limits: Limits) -> str:
    """Return the level of the last trips as text, for a severity above none."""
    side, run, count = (int(number) for number in (judged.side, judged.run, judged.count))
    severity, n_last = Severity(int(judged.severity)), len(last.values)
    limit = (limits.act if severity == Severity.ACT else limits.notice)[(side + 1) // 2]
    beyond = judge.beyond_words(side, severity, limit)
    newest = judge.level_words(last.values[-1], limit)
    of_healthy = Finding("last-trip-of-healthy", level=newest)
    # several of the last trips, not all of them the newest
    if count >= judge.N_CONFIRMING and run < count and severity != Severity.UNKNOWN:
        trips = {"count": count, "n_last": n_last, "beyond": beyond}
        if run:
            return together((of_healthy, Finding("trips-beyond", **trips)))
        out = judge.level_words(np.median(last.values[side * (last.values - limit) > 0]), limit)
        several = Finding("trips-level-beyond", level=out, **trips)
        return together((several, Finding("last-trip-level", level=newest)))
    # the newest trips in a row, and what makes them uncertain
    words: str = Finding("last-trip-beyond", level=newest, beyond=beyond)
    if run > 1:
        words = together((of_healthy, Finding("last-trips-beyond", run=run, beyond=beyond)))
    if judged.weak and last.flagged[n_last - run :].any():
        return words if last.all_flagged else Finding(FLAGGED[run > 1], words=words)
    if judged.weak:
        return Finding("without-interval", words=words)
    if severity == Severity.UNKNOWN:
        kind = "intervals-reach-back" if run > 1 else "interval-reaches-back"
        return Finding(kind, words=words)
    return words


def _development(of: Evidence, judged: judge.Judged, limits: Limits) -> list[str]:
    """Return how the parameter reached its level, for a severity above none."""
    trend, side = of.trend, int(judged.side)
    if of.lasting:
        return [of.lasting]
    if side * (trend.first_median - limits.notice[(side + 1) // 2]) > 0:
        return [Finding("since-first-trips")]
    if of.is_short and trend.n_ends:
        return [Finding("first-trips", n=trend.n_ends, percent=100 * trend.first_median)]
    if of.is_short or judged.severity == Severity.UNKNOWN:
        return []
    if judged.run and judged.count < judge.N_CONFIRMING:
        return [Finding("too-few-lasting")]
    return [Finding("not-clear", percent=_percent(trend.spread_percent))]


def _calm(of: Evidence) -> list[str]:
    """Return how the parameter develops if no limit is crossed or there are no limits."""
    trend, values, limits = of.trend, of.last.values, of.limits
    median, scatter = float(np.median(values)), 3 * float(np.nan_to_num(trend.spread_percent))
    if of.lasting:
        change = of.lasting
    elif of.is_short:
        n_trips = of.changes.n_reference if of.changes.n_needed else trend.n_trips
        n_needed = of.changes.n_needed or trend.n_needed
        change = Finding("too-few-to-find", n_trips=n_trips, n_needed=n_needed)
    else:
        change = Finding("no-change", percent=_percent(trend.spread_percent))
    if trend.parameter == BODY_MASS:
        return [Finding("payload", change=change)]
    # a change, or else the level if it is far from healthy
    words: list[str] = [change]
    level = Finding("of-healthy", percent=100 * median)
    if of.lasting:
        words = [Finding("within-limits-words", words=change) if limits else change]
    elif abs(100 * (median - 1)) > max(LARGE_PERCENT, scatter):
        words = [Finding("within-limits-words", words=level) if limits else level, change]
    elif of.is_short and limits:
        words = ["within its limits", change]
    # single trips that the median hides
    if abs(100 * (values[-1] - median)) > max(REPORTED_PERCENT, scatter):
        words.append(Finding("last-trip-at", percent=100 * values[-1]))
    if limits:
        n = int(np.sum((values < limits.notice[0]) | (values > limits.notice[1])))
        if n:
            words.append(Finding("some-beyond", n=n, n_last=len(values)))
    return words


def _percent(value: float) -> Finding:
    size = abs(value)
    return percent(size, 0 if size >= LARGE_PERCENT else 1 if size >= 0.095 else 2)
