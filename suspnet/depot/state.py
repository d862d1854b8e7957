"""State of each suspension of a fleet, from its history alone: alarms and remaining life."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from suspnet.history import Series
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.life import MIN_TRIPS, FleetPrior, Life, learn_fleet, predict_life
from suspnet.maintenance.limits import DEFAULT_LIMITS, Limits, Severity
from suspnet.maintenance.watch import Watched, watch
from suspnet.types import BoolArray, FloatArray

PAYLOAD = "M_s"


@dataclass(frozen=True, eq=False)
class State:
    """What is known of one suspension.

    Attributes
    ----------
    series : Series
        All its trips.
    recent : bool array of shape (n_trips,)
        Trips since the last commissioning and the last maintenance.
    watched : Watched
    lives : dict of Life
        Of each parameter with limits, until its act limit; without those of too few trips.
    """

    series: Series
    recent: BoolArray
    watched: Watched = field(default_factory=Watched)
    lives: dict[str, Life] = field(default_factory=dict)

    @property
    def alarms(self) -> list[Alarm]:
        """Alarms that stand, the most severe first."""
        standing = [one for one in self.watched.alarms if one.is_open]
        return sorted(standing, key=lambda one: (-one.severity, one.begin_km))

    @property
    def severity(self) -> Severity:
        """The worst of its alarms; unknown if no trip has an estimate."""
        if not (self.recent & self.series.done).any():
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
    seed: int = 0,
) -> list[State]:
    """Return the state of each suspension, the most severe first, then the shortest life.

    Remaining lives are learnt together from the suspensions of one vehicle (``learn_fleet``).

    Parameters
    ----------
    fleet : sequence of Series
    limits : mapping from vehicle to mapping from parameter to Limits
        A vehicle that is not there has ``DEFAULT_LIMITS``.
    settings : ChangeSettings
    seed : int
    """
    known = {one.vehicle: limits.get(one.vehicle, DEFAULT_LIMITS) for one in fleet}
    states = [_watched(one, known[one.vehicle], settings) for one in fleet]
    priors = _priors(states, known)
    states = [_with_lives(one, known[one.series.vehicle], priors, seed) for one in states]
    return sorted(states, key=_order)


def _watched(series: Series, limits: Mapping[str, Limits], settings: ChangeSettings) -> State:
    """Return a suspension with its alarms, of the trips since its last commissioning."""
    km, since = series.mileage_km, series.healthy_since_km
    newest = since[np.flatnonzero(series.done)[-1:]]
    era = np.isin(since, newest) | (np.isnan(since) & np.isnan(newest).any())
    ends = [event.mileage_km for event in series.events]
    recent = era & ~(km < max(ends, default=-np.inf))
    names = [name for name in series.estimates if name != PAYLOAD]
    covariates = {
        "pay-load": series.estimates[PAYLOAD],
        "speed": series.speed_m_per_s,
        "temperature": series.temperature_c,
    }
    found = watch(
        km[era],
        {name: series.estimates[name][era] for name in names},
        {name: series.half_widths[name][era] for name in names},
        series.flagged[era],
        {name: column[era] for name, column in covariates.items()},
        limits,
        settings,
        maintenance_km=ends,
    )
    return State(series, recent, found)


def _with_lives(
    state: State,
    limits: Mapping[str, Limits],
    priors: Mapping[tuple[str, str], FleetPrior],
    seed: int,
) -> State:
    """Return a suspension with the remaining life of each of its parameters."""
    lives = {}
    for name, limit in limits.items():
        trips = _trips(state, name)
        if len(trips[0]) >= MIN_TRIPS and trips[0][-1] > trips[0][0]:
            prior = priors.get((state.series.vehicle, name))
            lives[name] = predict_life(*trips, limit.act, fleet=prior, seed=seed)
    return replace(state, lives=lives)


def _priors(
    states: Sequence[State], limits: Mapping[str, Mapping[str, Limits]]
) -> dict[tuple[str, str], FleetPrior]:
    """Return what the suspensions of each vehicle show together of each parameter."""
    trips = defaultdict(list)
    for state in states:
        for name in limits[state.series.vehicle]:
            found = _trips(state, name)
            if len(found[0]) >= MIN_TRIPS and found[0][-1] > found[0][0]:
                trips[state.series.vehicle, name].append(found)
    return {key: learn_fleet(found) for key, found in trips.items() if len(found) > 1}


def _trips(state: State, name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mileage, estimates and half widths of the recent trips that are not flagged."""
    series = state.series
    values = series.estimates[name]
    used = state.recent & np.isfinite(values) & np.isfinite(series.mileage_km) & ~series.flagged
    return series.mileage_km[used], values[used], series.half_widths[name][used]


def _order(state: State) -> tuple[int, float, str, str]:
    """Return the place of a suspension in the list: worst first, then the shortest life."""
    shortest = state.shortest
    life = shortest[1].quantile_km(0.1) if shortest else np.inf
    return -state.severity, life, state.series.vehicle, str(state.series.place)
