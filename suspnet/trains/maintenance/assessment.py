"""Assessment of a parameter from its trips, for maintenance: its severity and the reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspnet.ground.findings import Finding, kind_is, percent, together
from suspnet.ground.parameters import BODY_MASS, Cause, Limits, Severity
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.maintenance.judge import (
    N_CONFIRMING,
    Judged,
    LastTrips,
    beyond_words,
    judge_last,
    level_words,
)
from suspnet.trains.maintenance.life import Life
from suspnet.trains.maintenance.series import N_LAST
from suspnet.trains.maintenance.trend import ParameterTrend, Shape, Step

ONE_FLAGGED = "the only trip is flagged"
LARGE_PERCENT = 10.0
"""Least change, in % of healthy, for which the text gives the new level instead of the change."""
REPORTED_PERCENT = 2.0
"""Least deviation of the last trip from the median of the last trips, in % of healthy, for which
the text gives its value."""
FLAGGED = "flagged-trip", "flagged-trips"
"""Kinds of the level of one trip, or of several, of which a flag is set."""
ALL_FLAGGED = "all trips are flagged"


@dataclass(frozen=True)
class Assessment:
    """Assessment of one parameter from its trips; `words` is the reason of the severity.

    `limited` is whether the parameter has limits; `alarms` are the active ones; `life` is the
    mileage until the act limit, None if unknown; `now` [-] is the median of the last trips.
    `unknown_life` is why the remaining life is unknown or unreliable, empty if it is known.
    """

    trend: ParameterTrend
    severity: Severity
    words: str
    limited: bool = True
    alarms: tuple[Alarm, ...] = ()
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


def assess(
    trend: ParameterTrend,
    last: LastTrips,
    limits: Limits | None,
    alarms: Sequence[Alarm] = (),
    doubt: str = "",
) -> Assessment:
    """Return the assessment of one parameter, with the severity of ``severity_of``.

    `trend` is that of all trips. `limits` None means that no value is alarming, as for M_s.
    `alarms` are the active ones of the parameter. `doubt` is why the limits cannot be applied,
    empty if they can.
    """
    severity = severity_of(last, limits, alarms, doubt)
    words = _words(trend, last, limits)
    # an alarm that the last trips alone do not explain comes first
    worst = max(alarms, key=lambda alarm: (alarm.severity, -alarm.begin_km), default=None)
    if worst is not None and worst.severity > judge_last(last, limits)[0]:
        is_named = worst.cause == Cause.CHANGE and trend.changed
        since = Finding("alarm-since", words=words if is_named else worst.words, km=worst.begin_km)
        words = since if is_named else together((since, words))
    if doubt and limits is not None:
        words = together((doubt, words))
    return Assessment(trend, severity, words, limits is not None, tuple(alarms))


def severity_of(
    last: LastTrips, limits: Limits | None, alarms: Sequence[Alarm], doubt: str = ""
) -> Severity:
    """Return the severity of a parameter; all reports use this rule.

    It is the worst of the last trips' (``judge_last``) and of the active alarms'. A `doubt` about a
    parameter with limits makes it unknown at least.
    """
    least = Severity.UNKNOWN if doubt and limits is not None else Severity.NONE
    by_limits = judge_last(last, limits)[0]
    return max(least, by_limits, *(alarm.severity for alarm in alarms))


def _words(trend: ParameterTrend, last: LastTrips, limits: Limits | None) -> str:
    """Return the reason from the trips alone, without alarms."""
    severity, judged = judge_last(last, limits)
    if len(last.values) == 0:
        return "no trip with an estimate"
    if limits is None or judged is None:
        return _joined(_calm(trend, last), trend, last)
    if judged.severity == Severity.NONE:
        if severity == Severity.UNKNOWN:
            return _not_judged(trend, last)
        return _joined(_calm(trend, last, limits), trend, last)
    words = [_level(judged, last, limits), *_development(trend, judged, limits)]
    return _joined(words, trend, last, severity)


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
    n_known = sum(a.trend.n_trips > 0 for a in judged)
    n_changed = sum(a.trend.changed for a in judged)
    n_tested = sum(a.trend.shape != Shape.TOO_FEW for a in judged)
    n_all, quiet = len(judged), "No parameter is beyond its limits"
    if not any(a.limited for a in judged):
        quiet = "No parameter has limits"
    # the most severe first; without an alarm, what is not known comes before what is quiet
    if severity == Severity.ACT:
        kind, n_notice = "act-and-notice" if n[Severity.NOTICE] else "act", n[Severity.NOTICE]
        sentence = Finding(kind, n=n[severity], n_all=n_all, n_notice=n_notice)
    elif severity == Severity.NOTICE:
        sentence = Finding("notice", n=n[severity], n_all=n_all)
    elif n_known == 0:
        sentence = Finding("nothing-known")
    elif severity == Severity.UNKNOWN:
        sentence = Finding("not-all-judged", n=n[severity], n_all=n_all)
    elif n_changed:
        sentence = Finding("some-changed", quiet=quiet, n=n_changed, n_all=n_all)
    elif n_tested < len(judged):
        sentence = Finding("some-too-few" if n_tested else "all-too-few", quiet=quiet)
    else:
        sentence = Finding("nothing-stands-out", quiet=quiet)
    return severity, sentence


def _level(judged: Judged, last: LastTrips, limits: Limits) -> str:
    """Return the level of the last trips as text, for a severity above none."""
    side, run, count = (int(number) for number in (judged.side, judged.run, judged.count))
    severity, n_last = Severity(int(judged.severity)), len(last.values)
    limit = (limits.act if severity == Severity.ACT else limits.notice)[(side + 1) // 2]
    beyond = beyond_words(side, severity, limit)
    newest = level_words(last.values[-1], limit)
    of_healthy = Finding("last-trip-of-healthy", level=newest)
    # several of the last trips, not all of them the newest
    if count >= N_CONFIRMING and run < count and severity != Severity.UNKNOWN:
        trips = {"count": count, "n_last": n_last, "beyond": beyond}
        if run:
            return together((of_healthy, Finding("trips-beyond", **trips)))
        out = level_words(np.median(last.values[side * (last.values - limit) > 0]), limit)
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


def _development(trend: ParameterTrend, judged: Judged, limits: Limits) -> list[str]:
    """Return how the parameter reached its level, for a severity above none."""
    if trend.shape == Shape.RETURNED and trend.step is not None:
        if trend.n_trips - trend.step.n_before <= N_LAST:
            return [Finding("change-began", km=_km(trend.step))]
        size = _percent(trend.step.size_percent)
        return [Finding("earlier-difference", percent=size, km=_km(trend.step))]
    if trend.changed:
        return [_change(trend)]
    side, is_short = int(judged.side), trend.shape == Shape.TOO_FEW
    if side * (trend.first_median - limits.notice[(side + 1) // 2]) > 0:
        return [Finding("since-first-trips")]
    if is_short and trend.n_ends:
        return [_first_trips(trend)]
    if is_short or judged.severity == Severity.UNKNOWN:
        return []
    if judged.run and judged.count < N_CONFIRMING:
        return [Finding("too-few-lasting")]
    return [Finding("not-clear", percent=_percent(trend.spread_percent))]


def _not_judged(trend: ParameterTrend, last: LastTrips) -> str:
    """Return why nothing is judged if all of the last trips are flagged and within the limits."""
    why = ALL_FLAGGED if last.all_flagged else Finding("all-last-flagged", n=len(last.values))
    if last.all_flagged and len(last.values) == 1:
        why = ONE_FLAGGED
    return together([Finding("not-judged", why=why), *([_change(trend)] if trend.changed else [])])


def _calm(trend: ParameterTrend, last: LastTrips, limits: Limits | None = None) -> list[str]:
    """Return how the parameter develops if no limit is crossed or there are no limits."""
    change, median = _change(trend), float(np.median(last.values))
    if trend.parameter == BODY_MASS:
        return [Finding("payload", change=change)]
    scatter = 3 * float(np.nan_to_num(trend.spread_percent))
    level = Finding("of-healthy", percent=100 * median)
    # a change, or else the level if it is far from healthy
    if trend.changed:
        words = [Finding("within-limits-words", words=change) if limits else change]
    elif abs(100 * (median - 1)) > max(LARGE_PERCENT, scatter):
        words = [Finding("within-limits-words", words=level) if limits else level, change]
    elif trend.shape == Shape.TOO_FEW and limits:
        words = ["within its limits", change]
    else:
        words = [change]
    # single trips that the median hides
    if abs(100 * (last.values[-1] - median)) > max(REPORTED_PERCENT, scatter):
        words.append(Finding("last-trip-at", percent=100 * last.values[-1]))
    if limits:
        n = int(np.sum((last.values < limits.notice[0]) | (last.values > limits.notice[1])))
        if n:
            words.append(Finding("some-beyond", n=n, n_last=len(last.values)))
    return words


def _change(trend: ParameterTrend) -> str:
    words = _change_words(trend)
    return Finding("without-flagged", words=words) if trend.without_flagged else words


def _change_words(trend: ParameterTrend) -> str:
    if trend.shape == Shape.TOO_FEW:
        if abs(trend.change_percent) >= LARGE_PERCENT and trend.parameter != BODY_MASS:
            return _first_trips(trend)
        return Finding("too-few-to-find", n_trips=trend.n_trips, n_needed=trend.n_needed)
    if trend.shape == Shape.NONE:
        return Finding("no-change", percent=_percent(trend.spread_percent))
    if trend.shape == Shape.RETURNED and trend.step is not None:
        size = _percent(trend.step.size_percent)
        return Finding("returned", percent=size, km=_km(trend.step))
    change = trend.change_percent
    verb = "falls" if change < 0 else "rises"
    amount = Finding(verb, percent=_percent(change))
    if abs(change) >= LARGE_PERCENT:
        amount = Finding(f"{verb}-to", percent=100 * trend.last_median, n_ends=trend.n_ends)
    if trend.shape == Shape.STEADY:
        return Finding("steadily", words=amount)
    if trend.step is None:
        return Finding("from-first-to-last", words=amount)
    if trend.shape == Shape.GRADUAL:
        going_on = "gradually-falling" if change < 0 else "gradually-rising"
        return Finding(going_on, words=amount, km=_km(trend.step))
    return Finding("about", words=amount, km=_km(trend.step))


def _first_trips(trend: ParameterTrend) -> str:
    """Return where the first trips were, for a difference that too few trips can test."""
    return Finding("first-trips", n=trend.n_ends, percent=100 * trend.first_median)


def _joined(
    clauses: Sequence[str],
    trend: ParameterTrend,
    last: LastTrips,
    severity: Severity = Severity.NONE,
) -> str:
    """Return all clauses as one sentence, followed by the number of flagged trips."""
    flags = []
    if last.all_flagged:
        flags.append(ALL_FLAGGED)
    elif trend.flagged_first or trend.flagged_last:
        first, newest, n_ends = trend.flagged_first, trend.flagged_last, trend.n_ends
        if any(kind_is(clause, kind) for clause in clauses for kind in FLAGGED) and newest == 1:
            newest = 0  # a clause says so already
        if first and newest:
            flags.append(Finding("flagged-both", n_first=first, n_last=newest, n_ends=n_ends))
        elif first or newest:
            kind = "flagged-first" if first else "flagged-last"
            flags.append(Finding(kind, n=first or newest, n_ends=n_ends))
    words = together([*clauses, *flags])
    # flags silence no verdict, as a badly worn part is flagged too, but its numbers may be off
    is_doubtful = severity >= Severity.NOTICE and bool(last.flagged.all())
    return Finding("inspect-first", words=words) if is_doubtful and flags else words


def _percent(value: float) -> Finding:
    size = abs(value)
    return percent(size, 0 if size >= LARGE_PERCENT else 1 if size >= 0.095 else 2)


def _km(step: Step) -> float:
    digits = math.floor(math.log10(max(step.gap_km, 1.0)))
    return round(step.mileage_km, -digits)
