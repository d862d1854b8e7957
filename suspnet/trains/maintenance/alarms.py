"""Alarms that the trips of a suspension raise, and their acknowledgement by people."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import BODY_MASS, Cause, Limits, Severity
from suspnet.ground.records import interval_ends
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.trains.maintenance.change import Change, Changes, ChangeSettings, find_changes
from suspnet.trains.maintenance.judge import beyond_words, judge, level_words
from suspnet.trains.maintenance.series import N_LAST, Series

N_QUIET = 3  # trips in a row within the limits that end an alarm: an intermittent one stays active
GOES_ON = 1.5  # ratio of a change now to its size at the alarm above which the text gives both


@dataclass(frozen=True)
class Alarm:
    """An alarm of one parameter, active or cleared; ValueError if its mileages are impossible.

    `severity` is the worst one while it was active, `begin_km` and `end_km` are the mileages of the
    trips that raised and cleared it (NaN: it is active), `words` give the reason.
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

    def was_active_at(self, km: float) -> bool:
        """Return whether it was active at a mileage, [km]."""
        return self.begin_km <= km and not km > self.end_km


@dataclass(frozen=True)
class Acknowledgement:
    """A person's acknowledgement of an alarm; ValueError if name, mileage or time is missing.

    `severity` is that of the alarm when it was acknowledged, `at_km` the mileage of the newest trip
    at that time, `by` the name of the person, `at` the time, ISO 8601 with its zone, and `words`
    the person's comment.
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
            has_zone = datetime.fromisoformat(self.at).tzinfo is not None
        except ValueError:
            has_zone = False
        if not has_zone:
            raise ValueError(
                f"the time of an acknowledgement must be ISO 8601 with its zone, got {self.at!r}"
            )

    def covers(self, alarm: Alarm) -> bool:
        """Return whether it applies to an alarm; one that has become more severe is not covered."""
        is_same = (self.parameter, self.cause) == (alarm.parameter, alarm.cause)
        return is_same and alarm.was_active_at(self.at_km) and alarm.severity <= self.severity


def newest_of(alarm: Alarm, seen: Iterable[Acknowledgement]) -> Acknowledgement | None:
    """Return the newest acknowledgement that covers an alarm, or None."""
    covering = (entry for entry in seen if entry.covers(alarm))
    return max(covering, key=lambda entry: datetime.fromisoformat(entry.at), default=None)


@dataclass(frozen=True)
class Watched:
    """Result of ``watch``: alarms by the mileage where they start, and detected changes.

    `lasting` has the alarm of the last change of each parameter that still lasts, also where it is
    not among the `alarms` because a limit reported it first.
    """

    alarms: list[Alarm] = field(default_factory=list)
    changes: Changes = field(default_factory=Changes)
    lasting: Mapping[str, Alarm] = field(default_factory=dict)

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

    Trips of `series` before the last commissioning and trips without a mileage are ignored.
    Payload, speed and temperature serve as covariates where they are known. A parameter that is
    missing in `limits` has none. The `changes` of the result are those since the last maintenance.
    """
    alarms = _sensor_alarms(series)
    series = series.select(series.of_newest_reference & np.isfinite(series.mileage_km))
    watched = Watched()
    for trips, end_km in zip(series.between, [*series.repairs, np.nan], strict=True):
        era = series.select(trips)
        watched = _watch_era(era, series.outputs, limits, settings or ChangeSettings())
        alarms += [replace(a, end_km=end_km) if a.is_open else a for a in watched.alarms]
    return replace(watched, alarms=sorted(alarms, key=lambda a: (a.begin_km, a.parameter)))


def _sensor_alarms(series: Series) -> list[Alarm]:
    """Return the alarms of sensors; a trip without a mileage raises and clears none."""
    km, alarms = series.mileage_km, []
    for trend in series.sensor_trends:
        active = trend.active & np.isfinite(km)
        for begin, end in _spans(active, ~active & np.isfinite(km)):
            # the newest trip that says what is wrong, as the last ones of an alarm need not
            during = np.arange(begin, len(km) if end is None else end)
            last = next(trip for trip in during[::-1] if trend.words(trip) or trip == begin)
            words = Finding("sensor", name=trend.name, words=trend.words(last))
            end_km = np.nan if end is None else float(km[end])
            alarms.append(
                Alarm(trend.name, Cause.SENSOR, Severity.NOTICE, float(km[begin]), end_km, words)
            )
    return alarms


def _watch_era(
    era: Series, outputs: Iterable[str], limits: Mapping[str, Limits], settings: ChangeSettings
) -> Watched:
    """Return the alarms of the trips between two maintenances."""
    values = {name: era.estimates[name] for name in outputs if name != BODY_MASS}
    if not values:
        return Watched()
    covariates = {
        "payload": era.estimates[BODY_MASS],
        "speed": era.speed_m_per_s,
        "temperature": era.temperature_c,
    }
    km, widths = era.mileage_km, {name: era.half_widths[name] for name in values}
    changes = find_changes(km, values, covariates, settings, usable=~era.flagged, widths=widths)
    alarms, lasting = [], {}
    for name, column in values.items():
        of_limits = _limit_alarms(name, era, limits.get(name))
        alarms += of_limits
        for change in changes.by_parameter.get(name, []):
            alarm = _change_alarm(name, km, column, change)
            # a change that a limit has reported already is redundant
            if not any(limit.was_active_at(alarm.begin_km) for limit in of_limits):
                alarms.append(alarm)
            if alarm.is_open:
                lasting[name] = alarm
    return Watched(alarms, changes, lasting)


def _limit_alarms(name: str, era: Series, limits: Limits | None) -> list[Alarm]:
    """Return the limit alarms of one parameter; none if it has no limits."""
    done = np.flatnonzero(np.isfinite(era.estimates[name]))
    if limits is None or len(done) == 0:
        return []
    # judge each trip together with those just before it
    km, centre, doubtful = era.mileage_km[done], era.estimates[name][done], era.flagged[done]
    low, high = interval_ends(centre, era.half_widths[name][done])
    last, lowest, highest = (_windows(column, np.nan) for column in (centre, low, high))
    judged = judge(last, lowest, highest, _windows(doubtful, False), limits)
    severity, newest = judged.severity, len(done) - 1
    quiet = np.asarray(_windows(severity == Severity.NONE, False, N_QUIET).all(axis=-1))
    alarms = []
    for begin, end in _spans(np.asarray(severity >= Severity.NOTICE), quiet):
        worst = begin + int(severity[begin:end].argmax())
        # an active alarm is described by the newest trip if that is as severe as the worst one
        at = newest if end is None and severity[newest] == severity[worst] else worst
        side, level = int(judged.side[at]), Severity(int(severity[at]))
        limit = (limits.act if level == Severity.ACT else limits.notice)[(side + 1) // 2]
        is_out = side * (centre - limit) > 0
        now, beyond = level_words(centre[newest], limit), beyond_words(side, level, limit)
        words = [Finding("last-trip-beyond", level=now, beyond=beyond)]
        if end is not None or not is_out[newest]:  # the parameter has come back
            out = np.flatnonzero(is_out[: (newest if end is None else at) + 1])[-1]
            then = level_words(centre[out], limit)
            words = [Finding("was-beyond", level=then, beyond=beyond, km=km[out])]
            words += [Finding("last-trip-level", level=now)] * (end is None)
        if worst > begin:  # it began as a notice
            words.append(Finding("act-since", km=km[worst]))
        end_km = np.nan if end is None else float(km[end])
        alarms.append(Alarm(name, Cause.LIMIT, level, float(km[begin]), end_km, together(words)))
    return alarms


def _change_alarm(name: str, km: FloatArray, values: FloatArray, change: Change) -> Alarm:
    about = km[max(change.onset - 1, 0) : change.onset + 1].mean()
    words = Finding("fell" if change.percent < 0 else "rose", percent=abs(change.percent), km=about)
    before = float(np.nanmedian(values[: max(change.onset, 1)]))
    now = 100 * (float(np.nanmedian(values[-N_LAST:])) / before - 1)
    if change.end is None and abs(now) > GOES_ON * abs(change.percent):
        words = Finding("change-goes-on", change=words, percent=abs(now), n_last=N_LAST)
    end_km = np.nan if change.end is None else float(km[change.end])
    return Alarm(name, Cause.CHANGE, Severity.NOTICE, float(km[change.begin]), end_km, words)


def _spans(raised: BoolArray, cleared: BoolArray) -> list[tuple[int, int | None]]:
    """Return the trips at which each alarm starts and ends; None: it is active."""
    pairs: list[tuple[int, int | None]] = []
    begin = None
    for trip in np.flatnonzero(raised | cleared).tolist():
        if begin is None and raised[trip]:
            begin = trip
        elif begin is not None and cleared[trip]:
            pairs.append((begin, trip))
            begin = None
    return pairs if begin is None else [*pairs, (begin, None)]


def _windows(column: FloatArray | BoolArray, fill: float | bool, size: int = N_LAST) -> FloatArray:
    """Return the last `size` trips up to each trip, newest last, (n_trips, `size`)."""
    padded = np.concatenate([np.full(size - 1, fill), column])
    return np.lib.stride_tricks.sliding_window_view(padded, size)


def detector_words(changes: Changes, settings: ChangeSettings) -> str:
    """Return the state of the change detector as text."""
    if changes.why_not:
        return Finding("not-armed", why=changes.why_not)
    words = [Finding("armed", n_needed=changes.n_needed, km=settings.km_per_false_alarm)]
    if changes.covariates:
        words.append(Finding("covariates", names=together(changes.covariates, ", ")))
    if changes.n_unlike:
        words.append(Finding("unlike-first", n=changes.n_unlike))
    return together(words)
