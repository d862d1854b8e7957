"""State of each suspension of a fleet, from its history alone: alarms and remaining life."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from suspnet.depot.sisters import alarms_of_sisters, of_same_car
from suspnet.history import Series
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.degradation import FleetPrior
from suspnet.maintenance.forecast import remaining_lives, trips_of_life
from suspnet.maintenance.life import Life, learn_fleet
from suspnet.maintenance.limits import DEFAULT_LIMITS, Limits, Severity
from suspnet.maintenance.sisters import SisterSettings
from suspnet.maintenance.watch import Watched, watch
from suspnet.recordings.manifest import Place
from suspnet.trips.trend import PAYLOAD

MOST_LEARNT = 200
"""Largest number of suspensions from which a fleet's rates of wear are learnt, evenly chosen."""


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
    """

    series: Series
    watched: Watched = field(default_factory=Watched)
    lives: dict[str, Life] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, Place]:
        """Vehicle and place."""
        return self.series.vehicle, self.series.place

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that stand, the most severe first."""
        standing = [one for one in self.watched.alarms if one.is_open]
        return sorted(standing, key=lambda one: (-one.severity, one.begin_km))

    @property
    def severity(self) -> Severity:
        """The worst of its alarms; unknown if no trip has an estimate."""
        if not (self.series.recent & self.series.done).any():
            return Severity.UNKNOWN
        return max((one.severity for one in self.alarms), default=Severity.NONE)

    @property
    def shortest(self) -> tuple[str, Life] | None:
        """The parameter that may pass its act limit first, by the 10 % quantile of its life."""
        known = [(life.quantile_km(0.1), name) for name, life in self.lives.items()]
        known = [one for one in known if np.isfinite(one[0])]
        return (min(known)[1], self.lives[min(known)[1]]) if known else None

    @property
    def last_km(self) -> float:
        """Mileage of the newest trip with an estimate, [km]; NaN if there is none."""
        km = self.series.mileage_km[self.series.done]
        return float(np.nanmax(km)) if np.isfinite(km).any() else np.nan


def fleet_state(
    fleet: Sequence[Series],
    limits: Mapping[str, Mapping[str, Limits]],
    settings: ChangeSettings,
    sisters: SisterSettings,
    seed: int = 0,
) -> list[State]:
    """Return the state of each suspension, the most severe first, then the shortest life.

    Remaining lives are learnt together from the suspensions of a vehicle (``learn_fleet``).

    Parameters
    ----------
    fleet : sequence of Series
    limits : mapping from vehicle to mapping from parameter to Limits
        A vehicle that is not there has ``DEFAULT_LIMITS``.
    settings : ChangeSettings
    sisters : SisterSettings
    seed : int
    """
    known = {one.vehicle: limits.get(one.vehicle, DEFAULT_LIMITS) for one in fleet}
    states = [_watched(one, known[one.vehicle], settings) for one in fleet]
    states = _with_sisters(states, sisters)
    priors = {vehicle: _priors(states, vehicle, limits) for vehicle, limits in known.items()}
    states = [
        _with_lives(one, known[one.series.vehicle], priors[one.series.vehicle], seed)
        for one in states
    ]
    return sorted(states, key=_order)


def _watched(series: Series, limits: Mapping[str, Limits], settings: ChangeSettings) -> State:
    """Return a suspension with its alarms, of the trips since its last commissioning."""
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
    return State(series, found)


def _with_sisters(states: Sequence[State], settings: SisterSettings) -> list[State]:
    """Return suspensions with the alarms of those that differ from their sisters.

    Where one of a car has an alarm of its own of that parameter, that explains the difference.
    """
    fleet = [one.series for one in states]
    alone: dict[int, set[str]] = {}
    for car in of_same_car(fleet):
        members = {id(one) for one in car}
        told = {a.parameter for s in states if id(s.series) in members for a in s.alarms}
        alone |= dict.fromkeys(members, told)
    odd = alarms_of_sisters(fleet, settings)
    found = []
    for state in states:
        told = alone.get(id(state.series), set())
        more = odd.get((state.series.vehicle, state.series.place), [])
        alarms = [*state.watched.alarms, *(a for a in more if a.parameter not in told)]
        alarms.sort(key=lambda one: (one.begin_km, one.parameter))
        found.append(replace(state, watched=replace(state.watched, alarms=alarms)))
    return found


def _priors(
    states: Sequence[State], vehicle: str, limits: Mapping[str, Limits]
) -> dict[str, FleetPrior]:
    """Return what the suspensions of a vehicle show together of each parameter."""
    found = {}
    for name in limits:
        trips = [
            trips_of_life(
                one.series.mileage_km[one.series.recent],
                one.series.estimates[name][one.series.recent],
                one.series.half_widths[name][one.series.recent],
                one.series.flagged[one.series.recent],
            )
            for one in states
            if one.series.vehicle == vehicle
        ]
        known = [one for one in trips if one is not None]
        if len(known) > 1:
            every = -(-len(known) // MOST_LEARNT)
            found[name] = learn_fleet(known[::every])
    return found


def _with_lives(
    state: State, limits: Mapping[str, Limits], fleet: Mapping[str, FleetPrior], seed: int
) -> State:
    """Return a suspension with the remaining life of each of its parameters."""
    series, used = state.series, state.series.recent
    values, half_widths = (
        {name: column[used] for name, column in part.items()}
        for part in (series.estimates, series.half_widths)
    )
    lives = remaining_lives(
        series.mileage_km[used],
        values,
        half_widths,
        series.flagged[used],
        limits,
        state.watched.passed,
        fleet,
        seed,
    )
    return replace(state, lives=lives)


def _order(state: State) -> tuple[int, float, str, str]:
    """Return the place of a suspension in the list: worst first, then the shortest life."""
    shortest = state.shortest
    life = shortest[1].quantile_km(0.1) if shortest else np.inf
    return -state.severity, life, state.series.vehicle, str(state.series.place)
