"""Watch over a suspension: which alarms its trips raise, from the first to the last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from tabulate import tabulate

from suspnet.ground.types import BoolArray, FloatArray
from suspnet.ground.wording import kilometres
from suspnet.maintenance.alarms import Alarm, Cause
from suspnet.maintenance.change import Change, Changes, ChangeSettings, find_changes
from suspnet.maintenance.limits import N_LAST, Limits, Severity, judge

N_QUIET = 3
"""Trips in a row within the limits that end an alarm: one that comes and goes stands."""
ABSURD = 10.0
"""Level over healthy beyond which words give no number: no suspension has it."""
GOES_ON = 1.5
"""Ratio of a change now to what it was at its alarm from which words give both."""


@dataclass(frozen=True)
class Watched:
    """What the trips of a suspension raised.

    Attributes
    ----------
    alarms : list of Alarm
        By the mileage of their begin.
    changes : Changes
        What the detector found, and whether it could.
    """

    alarms: list[Alarm] = field(default_factory=list)
    changes: Changes = field(default_factory=Changes)

    def standing(self, parameter: str) -> list[Alarm]:
        """Return the alarms of a parameter that stand still."""
        return [one for one in self.alarms if one.parameter == parameter and one.is_open]

    @property
    def passed(self) -> set[str]:
        """The parameters that are beyond their act limit."""
        standing = [one for one in self.alarms if one.is_open]
        return {one.parameter for one in standing if one.severity == Severity.ACT}


def watch(
    mileage_km: ArrayLike,
    values: Mapping[str, ArrayLike],
    half_widths: Mapping[str, ArrayLike],
    flagged: ArrayLike,
    covariates: Mapping[str, ArrayLike],
    limits: Mapping[str, Limits],
    settings: ChangeSettings,
    maintenance_km: Sequence[float] = (),
) -> Watched:
    """Return the alarms that the trips of a suspension raise, one after the other.

    Each trip is judged with those before it, by ``judge`` against the limits and by
    ``find_changes``, so that the alarms of a history are the same however often it is read. An
    alarm of a limit stands until ``N_QUIET`` trips in a row are within the limits, and keeps its
    worst severity. A change is a notice, and none where an alarm of a limit stands already.
    Maintenance ends all alarms, and reference trips are those since the last.

    Parameters
    ----------
    mileage_km : array of shape (n_trips,), [km]
        In any order; NaN: not used.
    values, half_widths : mapping from parameter to array of shape (n_trips,), [-]
        Relative to healthy, and half widths of their intervals in logarithms; NaN: none.
    flagged : bool array of shape (n_trips,)
    covariates : mapping from name to array of shape (n_trips,)
        Of ``find_changes``.
    limits : mapping from parameter to Limits
        A parameter that is not there has none.
    settings : ChangeSettings
    maintenance_km : sequence of float, [km]
        The first trips of this mileage or more are after it.

    Raises
    ------
    ValueError
        If shapes differ.
    """
    km = np.asarray(mileage_km, dtype=float)
    order = np.argsort(km, kind="stable")[: int(np.isfinite(km).sum())]
    ends = sorted(maintenance_km)
    alarms: list[Alarm] = []
    found = Watched()
    for part, end in zip(
        np.split(order, np.searchsorted(km[order], ends)), [*ends, np.nan], strict=True
    ):
        known, widths, beside = (
            {name: np.asarray(column, dtype=float)[part] for name, column in given.items()}
            for given in (values, half_widths, covariates)
        )
        doubtful = np.asarray(flagged, dtype=bool)[part]
        found = _watch(km[part], known, widths, doubtful, beside, limits, settings)
        alarms += [replace(one, end_km=end) if one.is_open else one for one in found.alarms]
    return replace(found, alarms=alarms)


def _watch(
    km: FloatArray,
    values: Mapping[str, FloatArray],
    widths: Mapping[str, FloatArray],
    flagged: BoolArray,
    covariates: Mapping[str, FloatArray],
    limits: Mapping[str, Limits],
    settings: ChangeSettings,
) -> Watched:
    """Return the alarms of trips in the order of the mileage, between maintenance."""
    if not values:
        return Watched()
    changes = find_changes(km, values, covariates, settings, usable=~flagged, widths=widths)
    alarms = []
    for name, column in values.items():
        width = widths.get(name, np.full(len(km), np.nan))
        beyond = _beyond(name, km, column, width, flagged, limits.get(name))
        changed = [_changed(name, km, column, one) for one in changes.found.get(name, [])]
        alarms += beyond + [one for one in changed if not any(_stood(b, one) for b in beyond)]
    return Watched(sorted(alarms, key=lambda one: (one.begin_km, one.parameter)), changes)


def alarm_table(alarms: list[Alarm]) -> str:
    """Return alarms as a table for a terminal."""
    rows = [
        [
            str(one.severity),
            one.parameter,
            one.cause,
            kilometres(one.begin_km),
            _end(one),
            one.words,
        ]
        for one in alarms
    ]
    return tabulate(rows, ["severity", "of", "cause", "since", "until", "why"], tablefmt="github")


def detector_words(changes: Changes, settings: ChangeSettings) -> str:
    """Return in words what the detector of changes can do."""
    if changes.why_not:
        return f"not armed yet, {changes.why_not}"
    beside = f"; {', '.join(changes.covariates)} taken into account" if changes.covariates else ""
    unlike = f"; {changes.n_unlike} trips too unlike the first to be judged"
    return (
        f"armed by {changes.n_needed} trips, at most one false alarm in "
        f"{kilometres(settings.km_per_false_alarm)}{beside}{unlike if changes.n_unlike else ''}"
    )


def _beyond(
    name: str,
    km: FloatArray,
    values: FloatArray,
    widths: FloatArray,
    flagged: BoolArray,
    limits: Limits | None,
) -> list[Alarm]:
    """Return the alarms of one parameter's limits; none if it has no limits."""
    there = np.flatnonzero(np.isfinite(values))
    if limits is None or len(there) == 0:
        return []
    km, centre, doubtful = km[there], values[there], flagged[there]
    with np.errstate(over="ignore"):
        low, high = (centre * np.exp(sign * widths[there]) for sign in (-1, 1))
    last, lowest, highest = (_windows(part, np.nan) for part in (centre, low, high))
    judged = judge(last, lowest, highest, _windows(doubtful, False), limits)
    severity = np.where(
        np.logical_and.accumulate(doubtful),
        np.minimum(judged.severity, Severity.NOTICE),
        judged.severity,
    )
    found = []
    for begin, worst, end in _spans(severity.tolist()):
        newest = len(severity) - 1
        at = newest if end is None and severity[newest] == severity[worst] else worst
        side, level = int(judged.side[at]), Severity(int(severity[at]))
        limit = (limits.act if level == Severity.ACT else limits.notice)[(side + 1) // 2]
        is_out = side * (centre - limit) > 0
        beyond = f"{'above' if side > 0 else 'below'} the {level} limit of {100 * limit:g} %"
        words = f"the last trip is {beside(centre[newest], limit)} of healthy, {beyond}"
        if end is not None or not is_out[newest]:  # it is elsewhere now
            out = np.flatnonzero(is_out[: (newest if end is None else at) + 1])[-1]
            words = (
                f"was {beside(centre[out], limit)} of healthy, {beyond}, at {kilometres(km[out])}"
            )
            if end is None:
                words += f"; the last trip is {beside(centre[newest], limit)}"
        until = np.nan if end is None else float(km[end])
        found.append(Alarm(name, Cause.LIMIT, level, float(km[begin]), until, words))
    return found


def beside(value: float, limit: float) -> str:
    """Return a level in %, with as many digits as tell it from a limit, or that it is absurd."""
    if value > ABSURD > limit:
        return f"at over {100 * ABSURD:.0f} %"
    digits = 0
    while digits < 3 and round(100 * value, digits) == round(100 * limit, digits):
        digits += 1
    return f"at {100 * value:.{digits}f} %"


def _changed(name: str, km: FloatArray, values: FloatArray, change: Change) -> Alarm:
    """Return the alarm of a change, with the level it has led to if it goes on."""
    about = km[max(change.onset - 1, 0) : change.onset + 1].mean()
    verb = "fell" if change.percent < 0 else "rose"
    words = f"{verb} by {abs(change.percent):.2g} % at about {kilometres(about)}"
    before = float(np.nanmedian(values[: max(change.onset, 1)]))
    now = 100 * (float(np.nanmedian(values[-N_LAST:])) / before - 1)
    if change.end is None and abs(now) > GOES_ON * abs(change.percent):
        words += f", by {abs(now):.2g} % on the last {N_LAST} trips"
    end = np.nan if change.end is None else float(km[change.end])
    return Alarm(name, Cause.CHANGE, Severity.NOTICE, float(km[change.begin]), end, words)


def _stood(alarm: Alarm, later: Alarm) -> bool:
    """Return whether an alarm stood when another one began, which says nothing new then."""
    return alarm.begin_km <= later.begin_km and not later.begin_km > alarm.end_km


def _spans(severity: list[int]) -> list[tuple[int, int, int | None]]:
    """Return the trips that began, were the worst of, and ended each alarm; None: it stands."""
    found: list[tuple[int, int, int | None]] = []
    begin, worst, quiet = -1, 0, 0
    for trip, level in enumerate(severity):
        if begin < 0:
            if level >= Severity.NOTICE:
                begin, worst, quiet = trip, trip, 0
            continue
        worst = trip if level > severity[worst] else worst
        quiet = quiet + 1 if level == Severity.NONE else 0
        if quiet == N_QUIET:
            found.append((begin, worst, trip))
            begin = -1
    return found if begin < 0 else [*found, (begin, worst, None)]


def _windows(column: FloatArray | BoolArray, fill: float | bool) -> FloatArray:
    """Return the last ``N_LAST`` trips as they were at each trip, the newest last."""
    padded = np.concatenate([np.full(N_LAST - 1, fill), column])
    return np.lib.stride_tricks.sliding_window_view(padded, N_LAST)


def _end(alarm: Alarm) -> str:
    """Return the mileage at which an alarm ended, in words."""
    return "now" if alarm.is_open else kilometres(alarm.end_km)
