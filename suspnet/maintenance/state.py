"""State of a suspension, from its history and its fleet's: alarms and remaining lives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from suspnet.history import Series
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.car_sisters import Key, alarms_of_sisters
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.fleet_lives import unjudged, unknown_lives
from suspnet.maintenance.life import Life
from suspnet.maintenance.limits import Limits, Severity
from suspnet.maintenance.sisters import SisterSettings
from suspnet.maintenance.trend import PAYLOAD
from suspnet.maintenance.watch import Watched, watch


@dataclass(frozen=True, eq=False)
class State:
    """What is known of one suspension.

    Attributes
    ----------
    series : Series
        All its trips.
    watched : Watched
    lives : dict of Life
        Of each parameter with limits, until its act limit; without those of too few trips.
    limited : tuple of str
        Parameters with limits.
    """

    series: Series
    watched: Watched = field(default_factory=Watched)
    lives: dict[str, Life] = field(default_factory=dict)
    limited: tuple[str, ...] = ()

    @property
    def key(self) -> Key:
        """Vehicle and place."""
        return self.series.vehicle, self.series.place

    @cached_property
    def alarms(self) -> list[Alarm]:
        """Alarms that stand, the most severe first."""
        standing = [one for one in self.watched.alarms if one.is_open]
        return sorted(standing, key=lambda one: (-one.severity, one.begin_km))

    @cached_property
    def severity(self) -> Severity:
        """The worst of its alarms; unknown without one if it cannot be judged."""
        least = Severity.UNKNOWN if self.unjudged else Severity.NONE
        return max((one.severity for one in self.alarms), default=least)

    @property
    def unjudged(self) -> str:
        """Why it cannot be judged by its last trips; empty if it can be."""
        return unjudged(self.series)

    @cached_property
    def unknown(self) -> dict[str, str]:
        """Parameters with limits whose remaining life is unknown, and why (``unknown_lives``)."""
        passed = self.watched.passed
        return unknown_lives(self.series, [name for name in self.limited if name not in passed])

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


def watched(series: Series, limits: Mapping[str, Limits], settings: ChangeSettings) -> State:
    """Return a suspension with its own alarms, of the trips since its last commissioning."""
    era = series.one_healthy
    names = [name for name in series.estimates if name != PAYLOAD]
    covariates = {
        "pay-load": series.estimates[PAYLOAD],
        "speed": series.speed_m_per_s,
        "temperature": series.temperature_c,
    }
    found = watch(
        series.mileage_km[era],
        {name: series.estimates[name][era] for name in names},
        {name: series.half_widths[name][era] for name in names},
        series.flagged[era],
        {name: column[era] for name, column in covariates.items()},
        limits,
        settings,
        maintenance_km=[event.mileage_km for event in series.events],
    )
    return State(series, found, limited=tuple(name for name in limits if name in names))


def sister_alarms(car: Sequence[State], settings: SisterSettings) -> dict[Key, list[Alarm]]:
    """Return the alarms of the suspensions of a car that differ from their sisters.

    Where one of the car has an alarm of its own of that parameter, that explains the difference.
    """
    told = {alarm.parameter for state in car for alarm in state.alarms}
    odd = alarms_of_sisters([state.series for state in car], settings)
    kept = {key: [one for one in own if one.parameter not in told] for key, own in odd.items()}
    return {key: alarms for key, alarms in kept.items() if alarms}


def with_alarms(state: State, more: Sequence[Alarm]) -> State:
    """Return a suspension with more alarms than its own."""
    alarms = [*state.watched.alarms, *more]
    alarms.sort(key=lambda one: (one.begin_km, one.parameter))
    return replace(state, watched=replace(state.watched, alarms=alarms))


def worst_first(state: State) -> tuple[int, float, str, str]:
    """Return the place of a suspension in the list: worst first, then the shortest life."""
    shortest = state.shortest
    life = shortest[1].quantile_km(0.1) if shortest else np.inf
    return -state.severity, life, state.series.vehicle, str(state.series.place)
