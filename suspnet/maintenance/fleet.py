"""States of all suspensions of a fleet; only what changed is worked out again."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from suspnet.ground.limits import DEFAULT_LIMITS, Limits
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
"""Largest number of suspensions from which a fleet's rates of wear are learnt, evenly chosen."""
NEW_SHARE = 0.1
"""Share of a vehicle's trips that must be new before its rates of wear are learnt again: then all
of its remaining lives are worked out again too, which takes far longer than those of one."""


class Fleet:
    """Alarms and remaining lives of the suspensions of a fleet.

    A suspension whose trips or maintenance changed is watched again, and compared with its sisters,
    as these are with it. Its remaining lives are predicted with the rates of wear that all
    suspensions of its vehicle show together (``learn_fleet``). These are learnt with the first
    trips, and again when more than ``NEW_SHARE`` of the vehicle's trips are others than then; until
    then, lives are as with the rates learnt last.

    Parameters
    ----------
    limits : mapping from vehicle to mapping from parameter to Limits
        A vehicle that is not there has ``DEFAULT_LIMITS``.
    changes : ChangeSettings
    sisters : SisterSettings
    seed : int
        Of the predicted lives.
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
        """Take suspensions as they are now; their trips count for the rates of wear."""
        for one in series:
            before = self._series.get(one.key)
            if before is not one and (before is None or not before.equals(one)):
                self._n_new[one.vehicle] += _n_new(before, one)
                self._series[one.key] = one

    def update(self, series: Iterable[Series], gone: Collection[Key] = ()) -> set[Key]:
        """Take suspensions as they are now, and find the alarms of those that changed.

        Parameters
        ----------
        series : iterable of Series
            New suspensions, and known ones that may have changed.
        gone : collection of vehicle and place
            Suspensions that are no longer there.

        Returns
        -------
        set of vehicle and place
            Suspensions whose alarms were found again.
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
        """Compare the suspensions of cars with each other, and return which they are."""
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
        """Predict the remaining lives that are not as of all trips yet.

        Parameters
        ----------
        seconds : float, [s]
            Time after which it stops; called again it goes on.
        only : collection of vehicle and place, optional
            Of these suspensions alone.

        Returns
        -------
        bool
            Whether all are predicted.
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
        """Learn what the suspensions of each vehicle show together, where that may have changed."""
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
        """Return with how many suspensions' rates of wear lives are predicted; 0: each alone."""
        return self._n_learnt.get(vehicle, 0)

    def of_sisters(self, key: Key) -> list[Alarm]:
        """Return the alarms of a suspension that differs from its sisters."""
        return self._of_sisters.get(key, [])

    def states(self) -> list[State]:
        """Return the state of each suspension, the most severe first, then the shortest life."""
        return by_urgency(self.state(key) for key in self._own)

    def state(self, key: Key) -> State:
        """Return the state of a suspension, with the alarms and lives that were found."""
        if key not in self._states:
            state = with_alarms(self._own[key], self.of_sisters(key))
            self._states[key] = replace(state, lives=self._lives.get(key, {}))
        return self._states[key]

    def state_of(self, series: Series) -> State:
        """Return the state of one suspension, compared with its sisters as far as they were added.

        Only its own remaining lives are predicted, and only its car's alarms are found.
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
    """Return the state of each suspension, the most severe first, then the shortest life.

    Parameters
    ----------
    fleet : sequence of Series
    limits, settings, sisters, seed
        Of ``Fleet``.
    """
    found = Fleet(limits, settings, sisters, seed)
    found.update(fleet)
    found.predict()
    return found.states()


def learn_priors(fleet: Sequence[Series], limits: Iterable[str]) -> dict[str, FleetPrior]:
    """Return what the suspensions of one vehicle show together of each parameter with limits."""
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

    Where one of the car has an alarm of its own of that parameter, that explains the difference.
    """
    explained = {alarm.parameter for state in car for alarm in state.alarms}
    odd = alarms_of_sisters([state.series for state in car], settings)
    rest = {key: [one for one in own if one.parameter not in explained] for key, own in odd.items()}
    return {key: alarms for key, alarms in rest.items() if alarms}


def _n_new(before: Series | None, series: Series) -> int:
    """Return how many trips of a suspension are not as they were."""
    known = set() if before is None else _rows(before)
    return len(_rows(series) - known)


def _rows(series: Series) -> set[bytes]:
    columns = np.column_stack([series.mileage_km, *series.estimates.values()])
    return {row.tobytes() for row in columns}
