"""States of all suspensions of a fleet, recomputed only where trips changed."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from suspnet.ground.parameters import DEFAULT_LIMITS, Limits
from suspnet.ground.records import Key
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.degradation import FleetPrior
from suspnet.maintenance.forecast import remaining_lives, trips_of_life
from suspnet.maintenance.life import Life, learn_fleet
from suspnet.maintenance.series import Series, car_of
from suspnet.maintenance.sisters import SisterSettings, alarms_of_sisters
from suspnet.maintenance.state import State, by_urgency, watched, with_alarms

MOST_LEARNT = 200
"""Largest number of suspensions from which a fleet's rates of wear are learned, evenly chosen."""
NEW_SHARE = 0.1
"""Share of a vehicle's trips that must be new before its rates of wear are learned again; all its
remaining lives are then recomputed, which takes far longer than those of one suspension."""


class Fleet:
    """Alarms and remaining lives of the suspensions of a fleet.

    If trips or maintenance of a suspension change, its alarms and those of its sisters are
    recomputed. Its remaining lives use a prior of the rates of wear from all suspensions of its
    vehicle (``learn_fleet``). The prior is learned from the first trips, and again when more than
    ``NEW_SHARE`` of the vehicle's trips have changed since.

    `limits` maps vehicles to the limits of their parameters; a missing vehicle has
    ``DEFAULT_LIMITS``. `seed` is that of the predicted lives.
    """

    def __init__(
        self,
        limits: Mapping[str, Mapping[str, Limits]],
        changes: ChangeSettings,
        sisters: SisterSettings,
        seed: int = 0,
    ) -> None:
        self.limits = limits
        self.changes = changes
        self.sisters = sisters
        self.seed = seed
        self._series: dict[Key, Series] = {}
        self._own: dict[Key, State] = {}
        self._of_sisters: dict[Key, list[Alarm]] = {}
        self._lives: dict[Key, dict[str, Life]] = {}
        self._waiting: set[Key] = set()
        self._states: dict[Key, State] = {}
        self._priors: dict[str, dict[str, FleetPrior]] = {}
        self._n_new: dict[str, int] = defaultdict(int)
        self._n_learnt: dict[str, int] = {}

    def limits_of(self, vehicle: str) -> Mapping[str, Limits]:
        """Return the limits of a vehicle."""
        return self.limits.get(vehicle, DEFAULT_LIMITS)

    def keys(self) -> set[Key]:
        """Return vehicle and place of each suspension."""
        return set(self._own)

    def add(self, series: Iterable[Series]) -> None:
        """Add or replace suspensions for the rates of wear, without looking for alarms."""
        for one in series:
            before = self._series.get(one.key)
            if before is not one and (before is None or not before.equals(one)):
                self._n_new[one.vehicle] += _n_new(before, one)
                self._series[one.key] = one

    def update(self, series: Iterable[Series], gone: Collection[Key] = ()) -> set[Key]:
        """Add or replace suspensions, remove those in `gone`, and recompute alarms.

        Returns the keys of all suspensions whose alarms were recomputed: of the changed ones and of
        their cars.
        """
        cars = {car_of(self._own[key].series) for key in gone if key in self._own}
        for key in gone:
            for part in (self._series, self._own, self._lives, self._of_sisters, self._states):
                part.pop(key, None)
            self._waiting.discard(key)
        for one in series:
            self.add([one])
            known = self._series[one.key]
            if one.key not in self._own or self._own[one.key].series is not known:
                self._own[one.key] = watched(known, self.limits_of(one.vehicle), self.changes)
                self._waiting.add(one.key)
                cars.add(car_of(one))
        return self._compare(cars)

    def _compare(self, cars: Collection[tuple[str, ...]]) -> set[Key]:
        """Compare the suspensions of each of these cars with each other, and return their keys."""
        members: dict[tuple[str, ...], list[State]] = defaultdict(list)
        for state in self._sorted():
            car = car_of(state.series)
            if car in cars:
                members[car].append(state)
        for several in members.values():
            found = sister_alarms(several, self.sisters)
            for state in several:
                self._of_sisters[state.key] = found.get(state.key, [])
                self._states.pop(state.key, None)
        return {state.key for several in members.values() for state in several}

    def predict(self, seconds: float = np.inf, only: Collection[Key] | None = None) -> bool:
        """Predict the remaining lives that are out of date, of all suspensions or of `only` some.

        It stops after `seconds` [s] and continues when called again. Returns whether all are up to
        date.
        """
        end = time.monotonic() + seconds
        self._learn()
        for state in self._sorted():
            if state.key not in self._waiting or (only is not None and state.key not in only):
                continue
            one = state.recent
            self._lives[state.key] = remaining_lives(
                one.mileage_km,
                one.estimates,
                one.half_widths,
                one.flagged,
                state.limits,
                state.watched.passed,
                self._priors[state.series.vehicle],
                self.seed,
            )
            self._waiting.discard(state.key)
            self._states.pop(state.key, None)
            if time.monotonic() > end:
                break
        return not self._waiting

    def _learn(self) -> None:
        """Learn the prior of each vehicle without one, or with enough new trips."""
        of_vehicle: dict[str, list[Series]] = defaultdict(list)
        for one in sorted(self._series.values(), key=lambda one: (one.vehicle, str(one.place))):
            of_vehicle[one.vehicle].append(one)
        for vehicle, series in of_vehicle.items():
            n_trips = sum(len(one.trip) for one in series)
            if vehicle in self._priors and self._n_new[vehicle] <= NEW_SHARE * n_trips:
                continue
            self._priors[vehicle] = learn_priors(series, self.limits_of(vehicle))
            self._n_learnt[vehicle] = len(series) if self._priors[vehicle] else 0
            self._n_new[vehicle] = 0
            self._waiting |= {key for key in self._own if key[0] == vehicle}

    def n_learnt(self, vehicle: str) -> int:
        """Return the number of suspensions behind a vehicle's prior; 0: the default prior."""
        return self._n_learnt.get(vehicle, 0)

    def of_sisters(self, key: Key) -> list[Alarm]:
        """Return the alarms of a suspension that differs from its sisters."""
        return self._of_sisters.get(key, [])

    def states(self) -> list[State]:
        """Return the state of each suspension, by severity, then by remaining life."""
        return by_urgency(self.state(key) for key in self._own)

    def state(self, key: Key) -> State:
        """Return the state of a suspension, with the alarms and lives found so far."""
        if key not in self._states:
            state = with_alarms(self._own[key], self.of_sisters(key))
            self._states[key] = replace(state, lives=self._lives.get(key, {}))
        return self._states[key]

    def state_of(self, series: Series) -> State:
        """Return the state of one suspension, compared with those sisters that were added.

        To save time, only its own lives are predicted and only its car's alarms are found.
        """
        self.add([series])
        car = car_of(series)
        self.update([one for one in self._series.values() if car_of(one) == car])
        self.predict(only=[series.key])
        return self.state(series.key)

    def _sorted(self) -> list[State]:
        return sorted(self._own.values(), key=lambda one: (one.key[0], str(one.key[1])))


def fleet_state(
    fleet: Sequence[Series],
    limits: Mapping[str, Mapping[str, Limits]],
    settings: ChangeSettings,
    sisters: SisterSettings,
    seed: int = 0,
) -> list[State]:
    """Return the state of each suspension, by severity, then by remaining life; see ``Fleet``."""
    found = Fleet(limits, settings, sisters, seed)
    found.update(fleet)
    found.predict()
    return found.states()


def learn_priors(fleet: Sequence[Series], limits: Iterable[str]) -> dict[str, FleetPrior]:
    """Return the prior of each parameter in `limits` from all suspensions of one vehicle."""
    found = {}
    recent = [one.part(one.recent) for one in fleet]
    for name in limits:
        trips = [
            trips_of_life(one.mileage_km, one.estimates[name], one.half_widths[name], one.flagged)
            for one in recent
        ]
        known = [one for one in trips if one is not None]
        if len(known) > 1:
            every = -(-len(known) // MOST_LEARNT)
            found[name] = learn_fleet(known[::every])
    return found


def sister_alarms(car: Sequence[State], settings: SisterSettings) -> dict[Key, list[Alarm]]:
    """Return the alarms of the suspensions of a car that differ from their sisters.

    A parameter is left out if any suspension of the car has its own alarm of it: that explains the
    difference.
    """
    explained = {alarm.parameter for state in car for alarm in state.alarms}
    odd = alarms_of_sisters([state.series for state in car], settings)
    rest = {key: [one for one in own if one.parameter not in explained] for key, own in odd.items()}
    return {key: alarms for key, alarms in rest.items() if alarms}


def _n_new(before: Series | None, series: Series) -> int:
    """Return the number of new or changed trips of a suspension."""
    known = set() if before is None else _rows(before)
    return len(_rows(series) - known)


def _rows(series: Series) -> set[bytes]:
    columns = np.column_stack([series.mileage_km, *series.estimates.values()])
    return {row.tobytes() for row in columns}
