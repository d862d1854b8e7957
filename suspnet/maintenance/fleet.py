"""States of all suspensions of a fleet; only what changed is worked out again."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from suspnet.history import Series
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.car_sisters import Key, car_of
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.degradation import FleetPrior
from suspnet.maintenance.fleet_lives import learn_priors, lives_of
from suspnet.maintenance.life import Life
from suspnet.maintenance.limits import DEFAULT_LIMITS, Limits
from suspnet.maintenance.sisters import SisterSettings
from suspnet.maintenance.state import State, sister_alarms, watched, with_alarms, worst_first

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
        self._own: dict[Key, State] = {}
        self._of_sisters: dict[Key, list[Alarm]] = {}
        self._lives: dict[Key, dict[str, Life]] = {}
        self._waiting: set[Key] = set()
        self._states: dict[Key, State] = {}
        self._priors: dict[str, dict[str, FleetPrior]] = {}
        self._n_new: dict[str, int] = defaultdict(int)

    def limits_of(self, vehicle: str) -> Mapping[str, Limits]:
        """Return the limits of a vehicle."""
        return self.limits.get(vehicle, DEFAULT_LIMITS)

    def keys(self) -> set[Key]:
        """Return vehicle and place of each suspension."""
        return set(self._own)

    def update(self, series: Iterable[Series], gone: Collection[Key] = ()) -> set[Key]:
        """Take suspensions as they are now, and find the alarms of those that are not as before.

        Parameters
        ----------
        series : iterable of Series
            New suspensions, and known ones that may have changed.
        gone : collection of vehicle and place
            Suspensions that are no longer there.

        Returns
        -------
        set of vehicle and place
            Suspensions whose alarms were found anew.
        """
        cars = {car_of(self._own.pop(key).series) for key in gone if key in self._own}
        for key in gone:
            for part in (self._lives, self._of_sisters, self._states):
                part.pop(key, None)
            self._waiting.discard(key)
        for one in series:
            key = one.vehicle, one.place
            before = self._own.get(key)
            if before is None or not before.series.equals(one):
                self._n_new[one.vehicle] += _n_new(before, one)
                self._own[key] = watched(one, self.limits_of(one.vehicle), self.changes)
                self._waiting.add(key)
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

    def predict(self, seconds: float = np.inf) -> bool:
        """Predict the remaining lives that are not as of all trips yet.

        Parameters
        ----------
        seconds : float, [s]
            Time after which it stops; called again it goes on.

        Returns
        -------
        bool
            Whether all are predicted.
        """
        end = time.monotonic() + seconds
        self._learn()
        for state in [one for one in self._sorted() if one.key in self._waiting]:
            vehicle = state.series.vehicle
            prior = self._priors[vehicle]
            limits, passed = self.limits_of(vehicle), state.watched.passed
            self._lives[state.key] = lives_of(state.series, limits, passed, prior, self.seed)
            self._waiting.discard(state.key)
            self._states.pop(state.key, None)
            if time.monotonic() > end:
                break
        return not self._waiting

    def _learn(self) -> None:
        """Learn what the suspensions of each vehicle show together, where that may have changed."""
        of_vehicle: dict[str, list[State]] = defaultdict(list)
        for state in self._sorted():
            of_vehicle[state.series.vehicle].append(state)
        for vehicle, states in of_vehicle.items():
            n_trips = sum(len(state.series.trip) for state in states)
            if vehicle in self._priors and self._n_new[vehicle] <= NEW_SHARE * n_trips:
                continue
            series = [state.series for state in states]
            self._priors[vehicle] = learn_priors(series, self.limits_of(vehicle))
            self._n_new[vehicle] = 0
            self._waiting |= {state.key for state in states}

    def of_sisters(self, key: Key) -> list[Alarm]:
        """Return the alarms of a suspension that differs from its sisters."""
        return self._of_sisters.get(key, [])

    def states(self) -> list[State]:
        """Return the state of each suspension, the most severe first, then the shortest life."""
        for key in self._own.keys() - self._states.keys():
            state = with_alarms(self._own[key], self.of_sisters(key))
            self._states[key] = replace(state, lives=self._lives.get(key, {}))
        return sorted(self._states.values(), key=worst_first)

    def _sorted(self) -> list[State]:
        """Return the suspensions with their own alarms, by vehicle and place."""
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


def _n_new(before: State | None, series: Series) -> int:
    """Return how many trips of a suspension are not as they were."""
    known = set() if before is None else _rows(before.series)
    return len(_rows(series) - known)


def _rows(series: Series) -> set[bytes]:
    """Return mileage and estimates of each trip."""
    columns = np.column_stack([series.mileage_km, *series.estimates.values()])
    return {row.tobytes() for row in columns}
