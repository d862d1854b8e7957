"""States of all suspensions of a fleet, recomputed only where trips changed."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from suspnet.ground.parameters import BOGIE_PARTS, DEFAULT_LIMITS, Limits, kind_of
from suspnet.ground.records import INTERVAL_LEVEL, Key
from suspnet.ground.types import FloatArray
from suspnet.trains.maintenance.alarms import Alarm, by_mileage, watch
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.maintenance.degradation import TINY, FleetPrior
from suspnet.trains.maintenance.life import DEFAULT_PRIOR, Life, fit_trips
from suspnet.trains.maintenance.series import Series, car_of
from suspnet.trains.maintenance.sisters import SisterSettings, alarms_of_sisters
from suspnet.trains.maintenance.state import State, by_urgency, remaining_lives, trips_of_life

MOST_LEARNT = 200
"""Largest number of suspensions from which a fleet's rates of wear are learned, evenly chosen."""
NEW_SHARE = 0.1
"""Share of a vehicle's trips that must be new before its rates of wear are learned again; all its
remaining lives are then recomputed, which takes far longer than those of one suspension."""
FLEET_RATES = np.geomspace(0.005, 0.3, 10)
"""Mean rates of the components that ``learn_fleet`` adds, with either sign, [1 / UNIT_KM]."""
FLEET_SPREAD = 0.35
"""Standard deviation of the components at ``FLEET_RATES``, relative to their means."""
PRIOR_SERIES = 3.0
"""Weight of the default prior when a fleet's prior is learned, as a number of series."""
MAX_STEPS = 200
"""Largest number of expectation-maximisation steps for a fleet."""


class FleetStates:
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

    def add(self, several: Iterable[Series]) -> None:
        """Add or replace suspensions for the rates of wear, without looking for alarms."""
        for series in several:
            before = self._series.get(series.key)
            if before is not series and (before is None or not before.equals(series)):
                old_trips = _rows(before) if before else set()
                self._n_new[series.vehicle] += len(_rows(series) - old_trips)
                self._series[series.key] = series

    def update(self, several: Iterable[Series], gone: Collection[Key] = ()) -> set[Key]:
        """Add or replace suspensions, remove those in `gone`, and recompute alarms.

        Returns the keys of all suspensions whose alarms were recomputed: of the changed ones and of
        their cars.
        """
        cars = {car_of(self._own[key].series) for key in gone if key in self._own}
        for key in gone:
            for column in (self._series, self._own, self._lives, self._of_sisters, self._states):
                column.pop(key, None)
            self._waiting.discard(key)
        for updated in several:
            self.add([updated])
            series = self._series[updated.key]  # that of before, if both are equal
            if series.key not in self._own or self._own[series.key].series is not series:
                limits = self.limits_of(series.vehicle)
                self._own[series.key] = State(series, limits, watch(series, limits, self.changes))
                self._waiting.add(series.key)
                cars.add(car_of(series))
        return self._compare(cars)

    def _compare(self, cars: Collection[tuple[str, ...]]) -> set[Key]:
        """Compare the suspensions of each of these cars with each other, and return their keys."""
        members: dict[tuple[str, ...], list[State]] = defaultdict(list)
        for state in self._sorted():
            car = car_of(state.series)
            if car in cars:
                members[car].append(state)
        for sisters in members.values():
            # an alarm of its own of any suspension of the car explains a difference
            explained = {alarm.parameter for state in sisters for alarm in state.alarms}
            odd = alarms_of_sisters([state.series for state in sisters], self.sisters)
            for state in sisters:
                alarms = [a for a in odd.get(state.key, []) if a.parameter not in explained]
                self._of_sisters[state.key] = alarms
                self._states.pop(state.key, None)
        return {state.key for sisters in members.values() for state in sisters}

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
            recent = state.recent
            self._lives[state.key] = remaining_lives(
                recent.mileage_km,
                recent.estimates,
                recent.half_widths,
                recent.flagged,
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
        for _, series in sorted(self._series.items(), key=_by_name):
            of_vehicle[series.vehicle].append(series)
        for vehicle, several in of_vehicle.items():
            n_trips = sum(len(series.trip) for series in several)
            if vehicle in self._priors and self._n_new[vehicle] <= NEW_SHARE * n_trips:
                continue
            self._priors[vehicle] = learn_priors(several, self.limits_of(vehicle))
            self._n_learnt[vehicle] = len(several) if self._priors[vehicle] else 0
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
        """Return the state of a suspension, with the alarms and lives computed so far."""
        if key not in self._states:
            own = self._own[key]
            alarms = sorted([*own.watched.alarms, *self.of_sisters(key)], key=by_mileage)
            watched = replace(own.watched, alarms=alarms)
            self._states[key] = replace(own, watched=watched, lives=self._lives.get(key, {}))
        return self._states[key]

    def state_of(self, series: Series) -> State:
        """Return the state of one suspension, compared with those sisters that were added.

        To save time, only its own lives are predicted and only its car's alarms are looked for.
        """
        self.add([series])
        car = car_of(series)
        self.update([own for own in self._series.values() if car_of(own) == car])
        self.predict(only=[series.key])
        return self.state(series.key)

    def _sorted(self) -> list[State]:
        return [state for _, state in sorted(self._own.items(), key=_by_name)]


def _by_name(item: tuple[Key, object]) -> tuple[str, str]:
    (vehicle, place), _ = item
    return vehicle, str(place)


def fleet_state(
    several: Sequence[Series],
    limits: Mapping[str, Mapping[str, Limits]],
    settings: ChangeSettings,
    sisters: SisterSettings,
    seed: int = 0,
) -> list[State]:
    """Return the state of each suspension, most severe first; see ``FleetStates``."""
    fleet = FleetStates(limits, settings, sisters, seed)
    fleet.update(several)
    fleet.predict()
    return fleet.states()


def learn_priors(several: Sequence[Series], limits: Iterable[str]) -> dict[str, FleetPrior]:
    """Return the prior of each parameter in `limits` from all suspensions of one vehicle.

    All parts of a kind have one prior.
    """
    recent = [series.select(series.recent) for series in several]
    alike: dict[str, list[str]] = defaultdict(list)
    for name in limits:
        alike[f"parts {kind_of(name)}" if name in BOGIE_PARTS else name].append(name)
    priors: dict[str, FleetPrior] = {}
    for names in alike.values():
        trips = [
            trips_of_life(s.mileage_km, s.estimates[name], s.half_widths[name], s.flagged)
            for s in recent
            for name in names
            if name in s.estimates
        ]
        usable = [columns for columns in trips if columns is not None]
        if len(usable) > 1:
            every = -(-len(usable) // MOST_LEARNT)
            priors |= dict.fromkeys(names, learn_fleet(usable[::every]))
    return priors


def learn_fleet(
    series: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike]], *, level: float = INTERVAL_LEVEL
) -> FleetPrior:
    """Return the prior over models and rates of one type of suspension, by empirical Bayes.

    The rate has a mixture of fixed normal distributions: those of ``DEFAULT_PRIOR`` and narrower
    ones centred at ``FLEET_RATES`` with either sign. The weights of the components and of the
    models are maximum a posteriori (expectation maximisation with a Dirichlet prior that counts as
    ``PRIOR_SERIES`` series). Without any series the result is ``DEFAULT_PRIOR``.

    `series` are (mileage_km, values, half_widths), trips of one parameter, as in ``predict_life``;
    include series without wear. `level` is that of the intervals. TypeError or ValueError is raised
    if a series is invalid for ``predict_life``; the message gives its index.
    """
    if not series:
        return DEFAULT_PRIOR
    means = np.concatenate([DEFAULT_PRIOR.means, FLEET_RATES, -FLEET_RATES])
    spreads = np.concatenate([DEFAULT_PRIOR.spreads, np.tile(FLEET_SPREAD * FLEET_RATES, 2)])
    even = FleetPrior(DEFAULT_PRIOR.models, np.full(means.size, 1 / means.size), means, spreads)
    # evidence of each model and component, without their prior
    evidence = np.full((len(series), even.models.size, means.size), -np.inf)
    for i, trips in enumerate(series):
        try:
            fits, _ = fit_trips(*trips, level, even)
        except (TypeError, ValueError) as error:
            raise type(error)(f"series {i}: {error}") from None
        for fit in fits:
            evidence[i, fit.rows] = logsumexp(fit.log_weight, axis=(1, 2))
    evidence -= np.log(even.models)[:, None]
    evidence[:, 1:] -= np.log(even.weights)
    # expectation maximisation of the weights
    default = np.pad(DEFAULT_PRIOR.weights, (0, means.size - DEFAULT_PRIOR.weights.size))
    models, weights = even.models, (default + even.weights) / 2
    for _ in range(MAX_STEPS):
        share = evidence + np.log(models)[:, None] + np.log(np.maximum(weights, TINY))
        share = np.exp(share - logsumexp(share, axis=(1, 2), keepdims=True))
        # a series without a trend has no information about the rate: leave out the first model
        old = models, weights
        models = _counted(share.sum(axis=(0, 2)), even.models)
        weights = _counted(share[:, 1:].sum(axis=(0, 1)), default)
        if max(np.abs(models - old[0]).max(), np.abs(weights - old[1]).max()) < 1e-4:
            break
    return FleetPrior(models, weights, means, spreads)


def _counted(counts: FloatArray, default: FloatArray) -> FloatArray:
    """Return proportions from counts and a default that counts as ``PRIOR_SERIES`` series."""
    total = counts + PRIOR_SERIES * default
    return np.asarray(total / total.sum())


def _rows(series: Series) -> set[bytes]:
    columns = np.column_stack([series.mileage_km, *series.estimates.values()])
    return {row.tobytes() for row in columns}
