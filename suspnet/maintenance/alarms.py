"""Alarms that the trips of a suspension raise, and their acknowledgement by people."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime

import numpy as np
from tabulate import tabulate

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import BODY_MASS, Cause, Limits, Severity
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.ground.wording import kilometres
from suspnet.maintenance.change import Change, Changes, ChangeSettings, find_changes
from suspnet.maintenance.judge import N_LAST, beyond_words, judge, level_words
from suspnet.maintenance.series import Series

N_QUIET = 3
"""Trips in a row within the limits that end an alarm: an intermittent one stays active."""
GOES_ON = 1.5
"""Ratio of a change now to its size at the alarm above which the text gives both."""


OWN_CAUSES = (Cause.LIMIT, Cause.CHANGE, Cause.SENSOR)
"""Causes that need only the trips of the suspension itself."""


@dataclass(frozen=True)
class Alarm:
    """An alarm of one parameter, active or cleared.

    Parameters
    ----------
    parameter : str
    cause : Cause
    severity : Severity
        The worst severity while it was active.
    begin_km : float, [km]
        Mileage of the trip that raised it.
    end_km : float, [km]
        Mileage of the trip that cleared it; NaN: it is active.
    words : str
        The reason.

    Raises
    ------
    ValueError
        If `begin_km` is not finite or larger than `end_km`.
    """

    parameter: str
    cause: Cause
    severity: Severity
    begin_km: float
    end_km: float = np.nan
    words: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cause", Cause(self.cause))
        object.__setattr__(self, "severity", Severity(self.severity))
        if not math.isfinite(self.begin_km):
            raise ValueError(f"an alarm needs a mileage in km, got {self.begin_km}")
        if self.end_km < self.begin_km:
            raise ValueError(
                f"an alarm must not end before it starts, got {self.begin_km} to {self.end_km} km"
            )

    @property
    def is_open(self) -> bool:
        """Whether the alarm is active."""
        return math.isnan(self.end_km)


@dataclass(frozen=True)
class Acknowledgement:
    """A person's acknowledgement of an alarm.

    Parameters
    ----------
    parameter : str
    cause : Cause
    severity : Severity
        Severity of the alarm when it was acknowledged.
    at_km : float, [km]
        Mileage of the newest trip at that time.
    by : str
        Name of the person.
    at : str
        Time, ISO 8601 with its zone.
    words : str
        Comment of the person.

    Raises
    ------
    ValueError
        If a name, a mileage or a time is missing.
    """

    parameter: str
    cause: Cause
    severity: Severity
    at_km: float
    by: str
    at: str
    words: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cause", Cause(self.cause))
        object.__setattr__(self, "severity", Severity(self.severity))
        if not math.isfinite(self.at_km):
            raise ValueError(f"an acknowledgement needs a mileage in km, got {self.at_km}")
        if not self.by.strip():
            raise ValueError("an acknowledgement needs the name of a person")
        try:
            zoned = datetime.fromisoformat(self.at).tzinfo is not None
        except ValueError:
            zoned = False
        if not zoned:
            raise ValueError(
                f"the time of an acknowledgement must be ISO 8601 with its zone, got {self.at!r}"
            )

    def covers(self, alarm: Alarm) -> bool:
        """Return whether it applies to an alarm; one that has become more severe is not covered."""
        there = alarm.begin_km <= self.at_km and not self.at_km > alarm.end_km
        same = (self.parameter, self.cause) == (alarm.parameter, alarm.cause)
        return same and there and alarm.severity <= self.severity


def newest_of(alarm: Alarm, seen: Iterable[Acknowledgement]) -> Acknowledgement | None:
    """Return the newest acknowledgement that covers an alarm, or None."""
    covering = (one for one in seen if one.covers(alarm))
    return max(covering, key=lambda one: datetime.fromisoformat(one.at), default=None)


@dataclass(frozen=True)
class Watched:
    """Result of ``watch``: alarms by the mileage where they start, and detected changes."""

    alarms: list[Alarm] = field(default_factory=list)
    changes: Changes = field(default_factory=Changes)

    @property
    def passed(self) -> set[str]:
        """Parameters that are beyond their act limit."""
        return {a.parameter for a in self.alarms if a.is_open and a.severity == Severity.ACT}


def watch(
    series: Series, limits: Mapping[str, Limits], settings: ChangeSettings | None = None
) -> Watched:
    """Return the alarms that the trips of a suspension raise, in order of mileage.

    Each trip is judged together with earlier ones only, by ``judge`` against the limits and by
    ``find_changes``; later trips do not change past alarms. A sensor that differs from its first
    trips raises a notice, and trips that it `misled` are not used. An alarm of a limit is active
    until ``N_QUIET`` trips in a row are within the limits, and retains its worst severity. A change
    raises a notice unless an alarm of a limit is already active. Maintenance ends all alarms, and
    the reference starts again after it.

    Parameters
    ----------
    series : Series
        Trips before the last commissioning and trips without a mileage are ignored. Payload, speed
        and temperature serve as covariates where they are known.
    limits : mapping from parameter to Limits
        A missing parameter has no limits.
    settings : ChangeSettings, optional

    Returns
    -------
    Watched
        `alarms`, a list of Alarm by the mileage where they start, and `changes`, the result of
        ``find_changes`` for the trips since the last maintenance.
    """
    of_sensors = _sensor_alarms(series)
    series = series.part(series.one_healthy & np.isfinite(series.mileage_km))
    alarms, ends = of_sensors, series.repairs
    found = Watched()
    for part, end in zip(series.between, [*ends, np.nan], strict=True):
        found = _watch(series.part(part), series.outputs, limits, settings or ChangeSettings())
        alarms += [replace(one, end_km=end) if one.is_open else one for one in found.alarms]
    return replace(found, alarms=sorted(alarms, key=lambda one: (one.begin_km, one.parameter)))


def _sensor_alarms(series: Series) -> list[Alarm]:
    """Return the alarms of sensors; a trip without a mileage raises and clears none."""
    km, found = series.mileage_km, []
    for one in series.sensor_trends:
        active = one.active & np.isfinite(km)
        for begin, end in spans(active, ~active & np.isfinite(km)):
            during = np.arange(begin, len(km) if end is None else end)
            last = next(trip for trip in during[::-1] if one.words(trip) or trip == begin)
            words = Finding("sensor", name=one.name, words=one.words(last))
            until = np.nan if end is None else float(km[end])
            found.append(
                Alarm(one.name, Cause.SENSOR, Severity.NOTICE, float(km[begin]), until, words)
            )
    return found


def _watch(
    one: Series, outputs: Iterable[str], limits: Mapping[str, Limits], settings: ChangeSettings
) -> Watched:
    values = {name: one.estimates[name] for name in outputs if name != BODY_MASS}
    if not values:
        return Watched()
    covariates = {
        "payload": one.estimates[BODY_MASS],
        "speed": one.speed_m_per_s,
        "temperature": one.temperature_c,
    }
    km, widths = one.mileage_km, {name: one.half_widths[name] for name in values}
    changes = find_changes(km, values, covariates, settings, usable=~one.flagged, widths=widths)
    alarms = []
    for name, column in values.items():
        beyond = _beyond(name, one, limits.get(name))
        changed = [_changed(name, km, column, change) for change in changes.found.get(name, [])]
        alarms += beyond + [
            late for late in changed if not any(_was_active(b, late) for b in beyond)
        ]
    return Watched(sorted(alarms, key=lambda one: (one.begin_km, one.parameter)), changes)


def alarm_table(alarms: list[Alarm]) -> str:
    """Return alarms as a table for a terminal."""
    rows = [
        [
            str(one.severity),
            one.parameter,
            one.cause,
            kilometres(one.begin_km),
            "now" if one.is_open else kilometres(one.end_km),
            one.words,
        ]
        for one in alarms
    ]
    return tabulate(rows, ["severity", "of", "cause", "since", "until", "why"], tablefmt="github")


def detector_words(changes: Changes, settings: ChangeSettings) -> str:
    """Return the state of the change detector as text."""
    if changes.why_not:
        return Finding("not-armed", why=changes.why_not)
    parts = [Finding("armed", n_needed=changes.n_needed, km=settings.km_per_false_alarm)]
    if changes.covariates:
        parts.append(Finding("covariates", names=together(changes.covariates, ", ")))
    if changes.n_unlike:
        parts.append(Finding("unlike-first", n=changes.n_unlike))
    return together(parts)


def _beyond(name: str, one: Series, limits: Limits | None) -> list[Alarm]:
    """Return the limit alarms of one parameter; none if it has no limits."""
    there = np.flatnonzero(np.isfinite(one.estimates[name]))
    if limits is None or len(there) == 0:
        return []
    km, centre, doubtful = one.mileage_km[there], one.estimates[name][there], one.flagged[there]
    with np.errstate(over="ignore"):
        low, high = (centre * np.exp(sign * one.half_widths[name][there]) for sign in (-1, 1))
    last, lowest, highest = (_windows(part, np.nan) for part in (centre, low, high))
    judged = judge(last, lowest, highest, _windows(doubtful, False), limits)
    severity = judged.severity
    quiet = np.asarray(_windows(severity == Severity.NONE, False, N_QUIET).all(axis=-1))
    found = []
    for begin, end in spans(np.asarray(severity >= Severity.NOTICE), quiet):
        worst = begin + int(severity[begin:end].argmax())
        newest = len(severity) - 1
        # an active alarm is described by the newest trip if that is as severe as the worst one
        at = newest if end is None and severity[newest] == severity[worst] else worst
        side, level = int(judged.side[at]), Severity(int(severity[at]))
        limit = (limits.act if level == Severity.ACT else limits.notice)[(side + 1) // 2]
        is_out = side * (centre - limit) > 0
        now, beyond = level_words(centre[newest], limit), beyond_words(side, level, limit)
        parts = [Finding("last-trip-beyond", level=now, beyond=beyond)]
        if end is not None or not is_out[newest]:  # the parameter has come back
            out = np.flatnonzero(is_out[: (newest if end is None else at) + 1])[-1]
            then = level_words(centre[out], limit)
            parts = [Finding("was-beyond", level=then, beyond=beyond, km=km[out])]
            parts += [Finding("last-trip-level", level=now)] * (end is None)
        if worst > begin:  # it began as a notice
            parts.append(Finding("act-since", km=km[worst]))
        until = np.nan if end is None else float(km[end])
        found.append(Alarm(name, Cause.LIMIT, level, float(km[begin]), until, together(parts)))
    return found


def _changed(name: str, km: FloatArray, values: FloatArray, change: Change) -> Alarm:
    about = km[max(change.onset - 1, 0) : change.onset + 1].mean()
    words = Finding("fell" if change.percent < 0 else "rose", percent=abs(change.percent), km=about)
    before = float(np.nanmedian(values[: max(change.onset, 1)]))
    now = 100 * (float(np.nanmedian(values[-N_LAST:])) / before - 1)
    if change.end is None and abs(now) > GOES_ON * abs(change.percent):
        words = Finding("change-goes-on", change=words, percent=abs(now), n_last=N_LAST)
    end = np.nan if change.end is None else float(km[change.end])
    return Alarm(name, Cause.CHANGE, Severity.NOTICE, float(km[change.begin]), end, words)


def _was_active(alarm: Alarm, later: Alarm) -> bool:
    """Return whether `alarm` was active when `later` started, which is then redundant."""
    return alarm.begin_km <= later.begin_km and not later.begin_km > alarm.end_km


def spans(raised: BoolArray, cleared: BoolArray) -> list[tuple[int, int | None]]:
    """Return the trips at which each alarm starts and ends; None: it is active."""
    found: list[tuple[int, int | None]] = []
    begin = None
    for trip in np.flatnonzero(raised | cleared).tolist():
        if begin is None and raised[trip]:
            begin = trip
        elif begin is not None and cleared[trip]:
            found.append((begin, trip))
            begin = None
    return found if begin is None else [*found, (begin, None)]


def _windows(column: FloatArray | BoolArray, fill: float | bool, size: int = N_LAST) -> FloatArray:
    """Return the last `size` trips up to each trip, newest last, (n_trips, `size`)."""
    padded = np.concatenate([np.full(size - 1, fill), column])
    return np.lib.stride_tricks.sliding_window_view(padded, size)
