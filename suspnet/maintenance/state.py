"""State of a suspension: what report, overview, fleet page, plan and exit code show of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from suspnet.ground.limits import Limits, Severity
from suspnet.ground.parameters import PAYLOAD
from suspnet.ground.records import Key
from suspnet.maintenance.alarms import Alarm, Watched, watch
from suspnet.maintenance.assessment import (
    ONE_FLAGGED,
    Assessment,
    assess,
    joined,
    overall,
    severity_of,
    worst_first,
)
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.forecast import why_unknown
from suspnet.maintenance.judge import N_LAST, LastTrips, last_trips
from suspnet.maintenance.life import Life
from suspnet.maintenance.series import Series
from suspnet.maintenance.trend import LEAST_PERCENT, flagged_trend


@dataclass(frozen=True, eq=False)
class State:
    """What is known of one suspension; all of it is of the trips of one series.

    Severities, present values and lives are of the trips since the last commissioning and
    maintenance; alarms are of those since the last commissioning.

    Attributes
    ----------
    series : Series
        All its trips.
    limits : mapping of Limits
        A parameter that is not there has none.
    watched : Watched
        Alarms of its trips and, where they were compared, of its sisters.
    lives : dict of Life
        Of each parameter with limits, until its act limit; without those of too few trips.
    least_percent : mapping of float, [% of healthy]
        Smallest change of each parameter that counts, ``LEAST_PERCENT`` by default.
    doubt : str
        Why no parameter can be judged by its limits; empty if they can be.
    """

    series: Series
    limits: Mapping[str, Limits] = field(default_factory=dict)
    watched: Watched = field(default_factory=Watched)
    lives: dict[str, Life] = field(default_factory=dict)
    least_percent: Mapping[str, float] = field(default_factory=dict)
    doubt: str = ""

    @property
    def key(self) -> Key:
        """Vehicle and place."""
        return self.series.key

    @cached_property
    def recent(self) -> Series:
        """The trips since the last commissioning and maintenance."""
        return self.series.part(self.series.recent)

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Parameters that are estimated."""
        return self.series.outputs

    @cached_property
    def alarms(self) -> list[Alarm]:
        """Active alarms, the most severe first."""
        active = [one for one in self.watched.alarms if one.is_open]
        return sorted(active, key=lambda one: (-one.severity, one.begin_km))

    @cached_property
    def severities(self) -> dict[str, Severity]:
        """Severity of each parameter, without the payload."""
        return {
            name: severity_of(
                self._last[name], self.limits.get(name), self.alarms_of(name), self.doubt
            )
            for name in self.outputs
            if name != PAYLOAD
        }

    @cached_property
    def severity(self) -> Severity:
        """The worst of its parameters."""
        return max(self.severities.values(), default=Severity.UNKNOWN)

    @cached_property
    def assessments(self) -> list[Assessment]:
        """Assessment of each parameter, in words."""
        return [self._assessment(name) for name in self.outputs]

    @property
    def worst(self) -> list[Assessment]:
        """The assessments of the worst severity and of one reason; empty if nothing is found."""
        return next(iter(joined(worst_first(self.assessments))), [])

    @property
    def parameters(self) -> str:
        """The parameters that the severity is of."""
        return ", ".join(one.parameter for one in self.worst)

    @property
    def reason(self) -> str:
        """Why it has its severity, or a sentence on all parameters."""
        return self.worst[0].words if self.worst else overall(self.assessments)[1]

    @cached_property
    def unjudged(self) -> str:
        """Why it cannot be judged by its last trips; empty if it can be."""
        flagged = self.recent.flagged[self.recent.done][-N_LAST:]
        if not len(flagged):
            return "no trip with an estimate"
        if not flagged.all():
            return ""
        n = len(flagged)
        return f"all of the last {n} trips are flagged" if n > 1 else ONE_FLAGGED

    @cached_property
    def unknown(self) -> dict[str, str]:
        """Parameters with limits whose remaining life is unknown, or not to be relied on, and why.

        That is so if there are too few trips, or if the suspension cannot be judged now.
        """
        one, passed = self.recent, self.watched.passed
        reasons = {
            name: self.unjudged
            or why_unknown(one.mileage_km, one.estimates[name], one.half_widths[name], one.flagged)
            for name in self.limits
            if name in one.estimates and name not in passed
        }
        return {name: why for name, why in reasons.items() if why}

    @cached_property
    def shortest(self) -> tuple[str, Life] | None:
        """The parameter that may pass its act limit first, by the 10 % quantile of its life."""
        known = [(life.quantile_km(0.1), name) for name, life in self.lives.items()]
        first = min((one for one in known if np.isfinite(one[0])), default=None)
        return first and (first[1], self.lives[first[1]])

    @cached_property
    def last_km(self) -> float:
        """Mileage of the newest trip with an estimate, [km]; NaN if there is none."""
        km = self.series.mileage_km[self.series.done]
        return float(np.nanmax(km)) if np.isfinite(km).any() else np.nan

    def now(self, name: str) -> float:
        """Return a parameter now, [-]: the median of the last ``N_LAST`` trips; NaN: none."""
        values = self._last[name].values
        return float(np.median(values)) if len(values) else np.nan

    def alarms_of(self, name: str) -> list[Alarm]:
        """Return the active alarms of a parameter, by the mileage where they start."""
        return [one for one in self.watched.alarms if one.parameter == name and one.is_open]

    @cached_property
    def _last(self) -> dict[str, LastTrips]:
        return {name: last_trips(self.recent, name) for name in self.series.estimates}

    def _assessment(self, name: str) -> Assessment:
        one, least = self.recent, self.least_percent.get(name, LEAST_PERCENT)
        values = one.estimates[name]
        trend = flagged_trend(name, one.mileage_km, values, one.flagged, least)
        limits, alarms = self.limits.get(name), self.alarms_of(name)
        found = assess(trend, self._last[name], limits, alarms, self.doubt)
        unknown = self.unknown.get(name, "")
        return replace(found, now=self.now(name), life=self.lives.get(name), unknown_life=unknown)


def watched(series: Series, limits: Mapping[str, Limits], changes: ChangeSettings) -> State:
    """Return a suspension with its own alarms, of the trips since its last commissioning."""
    return State(series, limits, watch(series.part(series.one_healthy), limits, changes))


def with_alarms(state: State, more: Sequence[Alarm]) -> State:
    """Return a suspension with more alarms than its own."""
    alarms = sorted([*state.watched.alarms, *more], key=lambda one: (one.begin_km, one.parameter))
    return replace(state, watched=replace(state.watched, alarms=alarms))


def by_urgency(states: Iterable[State]) -> list[State]:
    """Return suspensions with the worst first, then those of the shortest life."""

    def order(state: State) -> tuple[int, float, str, str]:
        life = state.shortest[1].quantile_km(0.1) if state.shortest else np.inf
        return -state.severity, life, state.series.vehicle, str(state.series.place)

    return sorted(states, key=order)
