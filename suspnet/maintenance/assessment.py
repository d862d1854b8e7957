"""Assessment of a parameter from its trips, for maintenance: its severity and the reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspnet.ground.parameters import BODY_MASS, Cause, Limits, Severity
from suspnet.ground.wording import kilometres
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.judge import (
    N_CONFIRMING,
    N_LAST,
    Judged,
    LastTrips,
    judge_last,
    level_words,
)
from suspnet.maintenance.life import Life
from suspnet.maintenance.trend import Shape, Step, Trend

ONE_FLAGGED = "the only trip is flagged"
LARGE_PERCENT = 10.0
"""Least change, in % of healthy, for which the text gives the new level instead of the change."""
REPORTED_PERCENT = 2.0
"""Least deviation of the last trip from the median of the last trips, in % of healthy, for which
the text gives its value."""
FLAGGED = "flagged and may be wrong"
ALL_FLAGGED = "all trips are flagged"
INSPECT = ": inspect before work is ordered"
"""End of the reason of a parameter beyond a limit where all of the last trips are flagged. Flags
silence no verdict, as a badly worn part is flagged too, but the numbers may be off: they are a
reason to look, no measurement."""


@dataclass(frozen=True)
class Assessment:
    """Assessment of one parameter from its trips; `words` is the reason of the severity.

    `limited` is whether the parameter has limits; `alarms` are the active ones; `life` is the
    mileage until the act limit, None if unknown; `now` [-] is the median of the last trips.
    `unknown_life` is why the remaining life is unknown or unreliable, empty if it is known.
    """

    trend: Trend
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
    trend: Trend,
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
    worst = max(alarms, key=lambda one: (one.severity, -one.begin_km), default=None)
    if worst is not None and worst.severity > judge_last(last, limits)[0]:
        since = f"alarm since {kilometres(worst.begin_km)}"
        is_named = worst.cause == Cause.CHANGE and trend.changed
        words = f"{words} ({since})" if is_named else f"{worst.words} ({since}); {words}"
    if doubt and limits is not None:
        words = f"{doubt}; {words}"
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
    return max(least, by_limits, *(one.severity for one in alarms))


def _words(trend: Trend, last: LastTrips, limits: Limits | None) -> str:
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
    parts = [_level(judged, last, limits), *_development(trend, judged, limits)]
    return _joined(parts, trend, last, severity)


def joined(assessments: Sequence[Assessment]) -> list[list[Assessment]]:
    """Return assessments grouped by severity and reason, in order of first occurrence."""
    found: dict[tuple[Severity, str], list[Assessment]] = {}
    for one in assessments:
        found.setdefault((one.severity, one.words), []).append(one)
    return list(found.values())


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
    of = f"of {len(judged)} parameters"
    quiet = "No parameter is beyond its limits"
    if not any(a.limited for a in judged):
        quiet = "No parameter has limits"
    if severity == Severity.ACT:
        more = f", {n[Severity.NOTICE]} more to be looked at" if n[Severity.NOTICE] else ""
        return severity, f"Act: {n[severity]} {of} {_is(n[severity])} beyond the act limit{more}:"
    if severity == Severity.NOTICE:
        return severity, f"Notice: {n[severity]} {of} {_is(n[severity])} to be looked at:"
    if n_known == 0:
        return severity, "No trip has an estimate, so that nothing is known."
    if severity == Severity.UNKNOWN:
        return severity, f"No alarm, but {n[severity]} {of} cannot be judged:"
    if n_changed:
        return severity, f"{quiet}; {n_changed} {of} changed:"
    if n_tested < len(judged):
        which = "there are" if n_tested == 0 else "some parameters have"
        return severity, f"{quiet}; {which} too few trips to find a change."
    return (
        severity,
        f"Nothing stands out. {quiet}, and none changed by more than its trips scatter.",
    )


def _level(judged: Judged, last: LastTrips, limits: Limits) -> str:
    """Return the level of the last trips as text, for a severity above none."""
    side, run, count = (int(part) for part in (judged.side, judged.run, judged.count))
    severity, n_last = Severity(int(judged.severity)), len(last.values)
    name = "act" if severity == Severity.ACT else "notice"
    limit = getattr(limits, name)[(side + 1) // 2]
    beyond = f"{'above' if side > 0 else 'below'} the {name} limit of {100 * limit:g} %"
    newest = f"the last trip is {level_words(last.values[-1], limit)}"
    if count >= N_CONFIRMING and run < count and severity != Severity.UNKNOWN:
        trips = f"{count} of the last {n_last} trips are"
        if run:
            return f"{newest} of healthy; {trips} {beyond}"
        out = last.values[side * (last.values - limit) > 0]
        return f"{trips} {level_words(np.median(out), limit)} of healthy, {beyond}; {newest}"
    it, are, its = ("it", "is", "its interval reaches")
    words = f"{newest} of healthy, {beyond}"
    if run > 1:
        it, are, its = ("they", "are", "their intervals reach")
        words = f"{newest} of healthy; the last {run} trips are {beyond}"
    if judged.weak and last.flagged[n_last - run :].any():
        return words if last.all_flagged else f"{words}, but {it} {are} {FLAGGED}"
    if judged.weak:
        return f"{words}, but without an interval that would make it sure"
    if severity == Severity.UNKNOWN:
        return f"{words}, but {its} back within it: too uncertain to judge"
    return words


def _development(trend: Trend, judged: Judged, limits: Limits) -> list[str]:
    """Return how the parameter reached its level, for a severity above none."""
    if trend.shape == Shape.RETURNED and trend.step is not None:
        if trend.n_trips - trend.step.n_before <= N_LAST:
            return [f"the change began at about {_km(trend.step)}"]
        size = _percent(trend.step.size_percent)
        return [f"earlier, it differed by {size} before and after about {_km(trend.step)}"]
    if trend.changed:
        return [_change(trend)]
    side, is_short = int(judged.side), trend.shape == Shape.TOO_FEW
    if side * (trend.first_median - limits.notice[(side + 1) // 2]) > 0:
        return ["it has been so since the first trips"]
    if is_short and trend.n_ends:
        return [_first_trips(trend)]
    if is_short or judged.severity == Severity.UNKNOWN:
        return []
    if judged.run and judged.count < N_CONFIRMING:
        return ["too few trips so far to call it a lasting change"]
    return [f"not clear against the spread of {_percent(trend.spread_percent)}"]


def _not_judged(trend: Trend, last: LastTrips) -> str:
    """Return why nothing is judged if all of the last trips are flagged and within the limits."""
    why = (
        ALL_FLAGGED if last.all_flagged else f"all of the last {len(last.values)} trips are flagged"
    )
    if last.all_flagged and len(last.values) == 1:
        why = ONE_FLAGGED
    return "; ".join([f"not judged, as {why}", *([_change(trend)] if trend.changed else [])])


def _calm(trend: Trend, last: LastTrips, limits: Limits | None = None) -> list[str]:
    """Return how the parameter develops if no limit is crossed or there are no limits."""
    change, median = _change(trend), float(np.median(last.values))
    if trend.parameter == BODY_MASS:
        return [f"{change} (payload: varies by nature, no fault)"]
    scatter = 3 * float(np.nan_to_num(trend.spread_percent))
    level = f"at {100 * median:.0f} % of healthy"
    if trend.changed:
        parts = [f"{change}, within its limits" if limits else change]
    elif abs(100 * (median - 1)) > max(LARGE_PERCENT, scatter):
        parts = [f"{level}, within its limits" if limits else level, change]
    elif trend.shape == Shape.TOO_FEW and limits:
        parts = ["within its limits", change]
    else:
        parts = [change]
    if abs(100 * (last.values[-1] - median)) > max(REPORTED_PERCENT, scatter):
        parts.append(f"the last trip is at {100 * last.values[-1]:.0f} %")
    if limits:
        n = int(np.sum((last.values < limits.notice[0]) | (last.values > limits.notice[1])))
        if n:
            lie = "lies" if n == 1 else "lie"
            parts.append(
                f"{n} of the last {len(last.values)} trips {lie} beyond a limit, the newest not"
            )
    return parts


def _change(trend: Trend) -> str:
    without = ", without the flagged trips" if trend.without_flagged else ""
    return f"{_change_words(trend)}{without}"


def _change_words(trend: Trend) -> str:
    if trend.shape == Shape.TOO_FEW:
        if abs(trend.change_percent) >= LARGE_PERCENT and trend.parameter != BODY_MASS:
            return _first_trips(trend)
        return f"too few trips ({trend.n_trips} of {trend.n_needed}) to find a change"
    if trend.shape == Shape.NONE:
        return f"no change beyond the spread of {_percent(trend.spread_percent)}"
    if trend.shape == Shape.RETURNED and trend.step is not None:
        size = _percent(trend.step.size_percent)
        return f"differs by {size} before and after about {_km(trend.step)}, but ends as it began"
    change = trend.change_percent
    verb, going_on = ("falls", "falling") if change < 0 else ("rises", "rising")
    amount = f"{verb} by {_percent(change)}"
    if abs(change) >= LARGE_PERCENT:
        level = f"{100 * trend.last_median:.0f} % of healthy"
        amount = f"{verb} to {level} (median of the last {trend.n_ends} trips)"
    if trend.shape == Shape.STEADY:
        return f"{amount}, steadily along the mileage"
    if trend.step is None:
        return f"{amount} from the first to the last trips"
    if trend.shape == Shape.GRADUAL:
        return f"{amount}, gradually around {_km(trend.step)}, and was still {going_on} at the end"
    return f"{amount} at about {_km(trend.step)}"


def _first_trips(trend: Trend) -> str:
    """Return where the first trips were, for a difference that too few trips can test."""
    trips = "trip was" if trend.n_ends == 1 else f"{trend.n_ends} trips were"
    return f"the first {trips} at {100 * trend.first_median:.0f} % of healthy"


def _joined(
    parts: Sequence[str], trend: Trend, last: LastTrips, severity: Severity = Severity.NONE
) -> str:
    """Return all parts as one sentence, followed by the number of flagged trips."""
    flags = []
    if last.all_flagged:
        flags.append(ALL_FLAGGED)
    elif trend.flagged_first or trend.flagged_last:
        ends = {"first": trend.flagged_first, "last": trend.flagged_last}
        if any(FLAGGED in part for part in parts) and trend.flagged_last == 1:
            ends["last"] = 0
        words = [f"{n} of the {end} {trend.n_ends}" for end, n in ends.items() if n]
        if words:
            flags.append(f"{' and '.join(words)} trips {_is(sum(ends.values()))} flagged")
    is_doubtful = severity >= Severity.NOTICE and bool(last.flagged.all())
    return "; ".join([*parts, *flags]) + INSPECT * (is_doubtful and bool(flags))


def _is(n: int) -> str:
    return "is" if n == 1 else "are"


def _percent(value: float) -> str:
    size = abs(value)
    digits = 0 if size >= LARGE_PERCENT else 1 if size >= 0.095 else 2
    return f"{size:.{digits}f} %"


def _km(step: Step) -> str:
    digits = math.floor(math.log10(max(step.gap_km, 1.0)))
    return kilometres(round(step.mileage_km, -digits))
