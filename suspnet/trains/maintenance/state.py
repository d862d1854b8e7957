"""State of a suspension, of which all outputs are made: alarms, assessments, remaining lives."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.findings import Finding, parts_of, restored
from suspnet.ground.parameters import BODY_MASS, Limits, Severity, kind_of
from suspnet.ground.records import Key, Place
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.trains.maintenance.alarms import Alarm, Watched, watch
from suspnet.trains.maintenance.assessment import (
    ONE_FLAGGED,
    Assessment,
    Evidence,
    assess,
    joined,
    overall,
    step_words,
    trend_of,
    worst_first,
)
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.maintenance.judge import LastTrips, judge_last, last_trips
from suspnet.trains.maintenance.life import MIN_TRIPS, Life, predict_life
from suspnet.trains.maintenance.sensors import IN_A_ROW
from suspnet.trains.maintenance.series import N_LAST, Series

WINDOW_DAYS = 180
"""Number of latest days whose trips determine the mileage per day of a train; if its newest trip is
older, its wear and mileage count as unknown."""
SENSOR_FAILED = "a sensor has failed, see its alarm"
"""Doubt about limits while a sensor misleads the newest trips."""


@dataclass(frozen=True, eq=False)
class State:
    """Alarms, lives and assessments of one suspension, all from the trips of `series`.

    Severities, present values and lives use the trips since the last commissioning and maintenance;
    alarms use those since the last commissioning. A parameter that is missing in `limits` has none.
    `lives` are those of ``with_lives``; empty until they are predicted.
    """

    series: Series
    limits: Mapping[str, Limits] = field(default_factory=dict)
    watched: Watched = field(default_factory=Watched)
    lives: dict[str, Life] = field(default_factory=dict)

    @cached_property
    def key(self) -> Key:
        """Vehicle and place."""
        return self.series.key

    @property
    def place(self) -> Place:
        """Place of the suspension in its fleet."""
        return self.key[1]

    @cached_property
    def recent(self) -> Series:
        """Trips since the last commissioning and maintenance."""
        return self.series.select(self.series.recent)

    @cached_property
    def doubt(self) -> str:
        """Why the limits cannot be applied; empty if they can."""
        newest = self.series.misled[-IN_A_ROW:]
        return SENSOR_FAILED if len(newest) == IN_A_ROW and newest.all() else ""

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Parameters that are estimated."""
        return self.series.outputs

    @cached_property
    def alarms(self) -> list[Alarm]:
        """Active alarms, the most severe first."""
        active = [alarm for alarm in self.watched.alarms if alarm.is_open]
        return sorted(active, key=lambda alarm: (-alarm.severity, alarm.begin_km))

    def alarms_of(self, name: str) -> list[Alarm]:
        """Return the active alarms of a parameter by the mileage where they start."""
        return [a for a in self.watched.alarms if a.parameter == name and a.is_open]

    @cached_property
    def severities(self) -> dict[str, Severity]:
        """Severity of each parameter except the car-body mass."""
        return {a.parameter: a.severity for a in self.assessments if a.parameter != BODY_MASS}

    @cached_property
    def severity(self) -> Severity:
        """Worst severity of the parameters."""
        return max(self.severities.values(), default=Severity.UNKNOWN)

    @cached_property
    def assessments(self) -> list[Assessment]:
        """Assessment of each parameter."""
        return [self._assessment(name) for name in self.outputs]

    @property
    def worst(self) -> list[Assessment]:
        """Assessments of the worst severity that share one reason; empty without findings."""
        return next(iter(joined(worst_first(self.assessments))), [])

    @property
    def parameters(self) -> str:
        """Names of the parameters with the worst severity, as text."""
        return ", ".join(assessment.parameter for assessment in self.worst)

    @property
    def reason(self) -> str:
        """Reason of the severity, or a sentence on all parameters."""
        return self.worst[0].words if self.worst else overall(self.assessments)[1]

    @cached_property
    def unjudged(self) -> str:
        """Why the last trips cannot be judged; empty if they can."""
        flagged = self.recent.flagged[self.recent.done][-N_LAST:]
        if not len(flagged):
            return "no trip with an estimate"
        if not flagged.all():
            return ""
        n = len(flagged)
        return Finding("all-last-flagged", n=n) if n > 1 else ONE_FLAGGED

    @cached_property
    def unknown(self) -> dict[str, str]:
        """Parameters with limits whose remaining life is unknown or unreliable, with the reason.

        There are too few trips, or the last trips cannot be judged.
        """
        recent, passed = self.recent, self.watched.passed
        reasons = {
            name: self.unjudged or why_unknown(recent, name)
            for name in self.limits
            if name in self.outputs and name not in passed
        }
        return {name: why for name, why in reasons.items() if why}

    @cached_property
    def shortest(self) -> tuple[str, Life] | None:
        """Parameter that may pass its act limit first, by the 10 % quantile, and its life."""
        ends = [(life.quantile_km(0.1), name) for name, life in self.lives.items()]
        km, name = min(ends, default=(math.inf, ""))
        return (name, self.lives[name]) if np.isfinite(km) else None

    @cached_property
    def last_km(self) -> float:
        """Mileage of the newest trip with an estimate, [km]; NaN if there is none."""
        km = self.series.mileage_km[self.series.done]
        return float(np.nanmax(km)) if np.isfinite(km).any() else np.nan

    @cached_property
    def newest_trips(self) -> tuple[NDArray[np.datetime64], FloatArray]:
        """Starts and mileages [km] of the trips that determine mileage and mileage per day.

        They are the trips of the last ``WINDOW_DAYS`` and those of the largest mileage.
        """
        km, start = self.series.mileage_km, self.series.start.astype("datetime64[D]")
        has_mileage = np.isfinite(km)
        is_dated = has_mileage & ~np.isnat(start)
        is_used: BoolArray = has_mileage & (km == np.max(km, where=has_mileage, initial=0.0))
        if is_dated.any():
            is_used |= is_dated & (start >= start[is_dated].max() - WINDOW_DAYS)
        return self.series.start[is_used], km[is_used]

    @cached_property
    def _last(self) -> dict[str, LastTrips]:
        return {name: last_trips(self.recent, name) for name in self.series.estimates}

    def last_of(self, name: str) -> LastTrips:
        """Return the last ``N_LAST`` trips with an estimate of a parameter."""
        return self._last[name]

    def leading(self, name: str) -> LastTrips:
        """Return the trips behind the present value of a parameter: the newest, or the last ones.

        It is the newest alone if the verdict rests on it: it is beyond a limit, or names the part
        as worn, which may have failed since the trips before.
        """
        last = self.last_of(name)
        severity, judged = judge_last(last, self.limits.get(name))
        is_beyond = severity >= Severity.NOTICE and judged is not None and judged.run > 0
        findings = (f for f in parts_of(self.worn) if isinstance(f, Finding))
        is_named = any(name in finding.values.get("names", ()) for finding in findings)
        return last.newest if is_beyond or is_named else last

    @cached_property
    def worn(self) -> str:
        """Which parts have worn on the newest trip with an estimate, as text."""
        newest = self.recent.worn[self.recent.done][-1:]
        return restored(newest[0]) if len(newest) else ""

    def now(self, name: str) -> float:
        """Return the present value of a parameter, [-]: the median of its ``leading`` trips.

        NaN if there is no estimate.
        """
        values = self.leading(name).values
        return float(np.median(values)) if len(values) else np.nan

    def furthest(self, name: str) -> float:
        """Return the present value of a parameter, or of that of its parts furthest from 1, [-]."""
        parts = [part for part in self.outputs if part != name and kind_of(part) == name]
        values = [self.now(part) for part in parts] or [self.now(name)]
        return max(values, key=lambda value: abs(math.log(value)) if value > 0 else -1.0)

    def _assessment(self, name: str) -> Assessment:
        trend, lasting = trend_of(self.recent, name), ""
        if name in self.watched.lasting:
            lasting = self.watched.lasting[name].words
        elif name != BODY_MASS and not self.watched.changes.by_parameter:
            values = self.recent.estimates[name]
            lasting = step_words(self.recent.mileage_km, values, trend.spread_percent)
        evidence = Evidence(
            replace(trend, changed=bool(lasting)),
            self.last_of(name),
            self.limits.get(name),
            self.alarms_of(name),
            lasting,
            self.watched.changes,
            self.doubt,
        )
        life, why = self.lives.get(name), self.unknown.get(name, "")
        return replace(assess(evidence), now=self.now(name), life=life, unknown_life=why)


def by_urgency(states: Iterable[State]) -> list[State]:
    """Return states by severity, the worst first, then by remaining life."""

    def order(state: State) -> tuple[int, float, str, str]:
        life = state.shortest[1].quantile_km(0.1) if state.shortest else np.inf
        vehicle, place = state.key
        return -state.severity, life, vehicle, str(place)

    return sorted(states, key=order)


MOST_RATIO = 100.0
MOST_WIDTH = 1.0
"""Factor from healthy, and half-width in logarithms, beyond which a trip is not used."""


def with_lives(state: State, seed: int = 0) -> State:
    """Return a state with the remaining life of each parameter that has limits and enough trips.

    That of a parameter with an alarm of its act limit is 0.
    """
    lives = {}
    for name, limit in state.limits.items():
        if name not in state.series.estimates:
            continue
        trips = trips_of_life(state.recent, name)
        if name in state.watched.passed:
            lives[name] = Life("no trend", np.zeros(1))
        elif trips is not None:
            lives[name] = predict_life(*trips, limit.act, seed=seed)
    return replace(state, lives=lives)


def why_unknown(recent: Series, name: str) -> str:
    """Return why these trips do not determine a remaining life; empty if they do."""
    if trips_of_life(recent, name) is not None:
        return ""
    done, doubtful = np.isfinite(recent.estimates[name]), recent.flagged
    n_clear = int((done & ~doubtful).sum())
    if not done.any():
        return "no trip with an estimate"
    if n_clear < MIN_TRIPS:
        kind = "too-few-unflagged" if doubtful.any() else "too-few-of"
        return Finding(kind, n=n_clear, n_needed=MIN_TRIPS)
    return "too few trips with a mileage and an estimate that is certain enough"


def trips_of_life(recent: Series, name: str) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return mileage, estimates and half-widths of the trips from which a life is predicted.

    None if there are too few. Flagged trips, estimates beyond a factor of ``MOST_RATIO`` and
    half-widths above ``MOST_WIDTH`` are left out.
    """
    km, centre, width = recent.mileage_km, recent.estimates[name], recent.half_widths[name]
    with np.errstate(divide="ignore", invalid="ignore"):
        is_certain = (np.abs(np.log(centre)) <= np.log(MOST_RATIO)) & ~(width > MOST_WIDTH)
    used = np.flatnonzero(np.isfinite(km) & is_certain & ~recent.flagged)
    if len(used) < MIN_TRIPS or km[used[-1]] <= km[used[0]]:
        return None
    return km[used], centre[used], np.where(np.isfinite(width), width, np.nan)[used]


def state_of(
    series: Series, limits: Mapping[str, Limits], changes: ChangeSettings, seed: int = 0
) -> State:
    """Return alarms and remaining lives of a suspension; `seed` is that of the lives."""
    return with_lives(State(series, limits, watch(series, limits, changes)), seed)
