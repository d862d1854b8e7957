"""State of a suspension, from which report, overview, fleet page, plan and exit code are made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from suspnet.ground.parameters import PAYLOAD, Limits, Severity
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
    """Alarms, lives and assessments of one suspension, all from the trips of `series`.

    Severities, present values and lives use the trips since the last commissioning and maintenance;
    alarms use those since the last commissioning.

    Attributes
    ----------
    series : Series
        All trips of the suspension.
    limits : mapping of Limits
        A missing parameter has no limits.
    watched : Watched
        Alarms from its trips and, if compared, from its sisters.
    lives : dict of Life
        Life until the act limit of each parameter with limits and enough trips.
    least_percent : mapping of float, [% of healthy]
        Smallest change of each parameter that counts; ``LEAST_PERCENT`` by default.
    doubt : str
        Why the limits cannot be applied; empty if they can.
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
        """Trips since the last commissioning and maintenance."""
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
        """Severity of each parameter except the payload."""
        return {
            name: severity_of(
                self._last[name], self.limits.get(name), self.alarms_of(name), self.doubt
            )
            for name in self.outputs
            if name != PAYLOAD
        }

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
        return ", ".join(one.parameter for one in self.worst)

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
        return f"all of the last {n} trips are flagged" if n > 1 else ONE_FLAGGED

    @cached_property
    def unknown(self) -> dict[str, str]:
        """Parameters with limits whose remaining life is unknown or unreliable, with the reason.

        There are too few trips, or the last trips cannot be judged.
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
        """Parameter that may pass its act limit first, by the 10 % quantile, and its life."""
        known = [(life.quantile_km(0.1), name) for name, life in self.lives.items()]
        first = min((one for one in known if np.isfinite(one[0])), default=None)
        return first and (first[1], self.lives[first[1]])

    @cached_property
    def last_km(self) -> float:
        """Mileage of the newest trip with an estimate, [km]; NaN if there is none."""
        km = self.series.mileage_km[self.series.done]
        return float(np.nanmax(km)) if np.isfinite(km).any() else np.nan

    def now(self, name: str) -> float:
        """Return the present value of a parameter, [-]: the median of the last ``N_LAST`` trips.

        NaN if there is no estimate.
        """
        values = self._last[name].values
        return float(np.median(values)) if len(values) else np.nan

    def alarms_of(self, name: str) -> list[Alarm]:
        """Return the active alarms of a parameter by the mileage where they start."""
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
    """Return the state with the suspension's own alarms, from trips since its commissioning."""
    return State(series, limits, watch(series.part(series.one_healthy), limits, changes))


def with_alarms(state: State, more: Sequence[Alarm]) -> State:
    """Return a state with additional alarms."""
    alarms = sorted([*state.watched.alarms, *more], key=lambda one: (one.begin_km, one.parameter))
    return replace(state, watched=replace(state.watched, alarms=alarms))


def by_urgency(states: Iterable[State]) -> list[State]:
    """Return states by severity, the worst first, then by remaining life."""

    def order(state: State) -> tuple[int, float, str, str]:
        life = state.shortest[1].quantile_km(0.1) if state.shortest else np.inf
        return -state.severity, life, state.series.vehicle, str(state.series.place)

    return sorted(states, key=order)
