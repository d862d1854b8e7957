"""The plan for a fleet from the states of its suspensions; only changed trains are replanned."""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Sequence
from datetime import date

import numpy as np

from suspnet.ground.parameters import PARAMETERS, Severity
from suspnet.maintenance.plan import join_plans, make_plan
from suspnet.maintenance.plan_inputs import Part, PlanSettings, Train, km_per_day
from suspnet.maintenance.schedule import Plan
from suspnet.maintenance.state import State


class Planner:
    """Plans the visits of a fleet, each train separately, and caches the plans of trains."""

    def __init__(self, settings: PlanSettings) -> None:
        self.settings = settings
        self._made: dict[str, tuple[list[State], Plan]] = {}

    def plan(self, states: Sequence[State], today: date) -> Plan:
        """Return the plan of ``make_plan`` for a fleet.

        A train is replanned if one of its states is another object than in the last call, or the
        day is another one.
        """
        of_train: dict[str, list[State]] = {}
        for state in states:
            of_train.setdefault(train_of(state), []).append(state)
        self._made = {name: self._of(name, own, today) for name, own in sorted(of_train.items())}
        nothing = make_plan([], [], self.settings, today)
        return join_plans([nothing, *(plan for _, plan in self._made.values())])

    def _of(self, name: str, states: list[State], today: date) -> tuple[list[State], Plan]:
        known = self._made.get(name)
        if known is not None and known[1].today == today and _are(states, known[0]):
            return known
        trains = trains_of(states, today, self.settings.km_per_day)
        return states, make_plan(parts_of(states), trains, self.settings, today)


def _are(states: Sequence[State], others: Sequence[State]) -> bool:
    return len(states) == len(others) and all(map(operator.is_, states, others))


def parts_of(states: Sequence[State]) -> list[Part]:
    """Return a part for each parameter of each suspension that has an alarm or limits."""
    found = []
    for state in states:
        named = {*state.lives, *state.unknown, *(one.parameter for one in state.alarms)}
        for name in (one for one in PARAMETERS if one in named):
            life = state.lives.get(name)
            samples = np.array([np.inf]) if life is None else life.samples_km
            place = state.series.place
            found.append(
                Part(
                    train_of(state),
                    suspension_of(state),
                    name,
                    samples,
                    float(np.nan_to_num(state.last_km)),  # NaN only if no remaining life is known
                    state.severities.get(name, Severity.NONE),
                    place.car,
                    state.unknown.get(name, "" if life else "it has no limits"),
                )
            )
    return found


def trains_of(states: Sequence[State], today: date, default_km_per_day: float) -> list[Train]:
    """Return each train, with the mileage of its newest trip and its mileage per day.

    A trip without a start is assumed to be of today. A train without any mileage is at 0 km: the
    remaining lives of its parts are unknown, so it has no visits.
    """
    of_train = defaultdict(list)
    for state in states:
        of_train[train_of(state)].append(state.series)
    found = []
    for name, several in sorted(of_train.items()):
        km = np.concatenate([one.mileage_km for one in several])
        starts = np.concatenate([one.start for one in several])
        order = np.argsort(km, kind="stable")[: int(np.isfinite(km).sum())]
        if not len(order):
            found.append(Train(name, 0.0, today, default_km_per_day))
            continue
        km, starts = km[order], starts[order]
        day = today if np.isnat(starts[-1]) else starts[-1].item().date()
        pace = km_per_day(starts, km, np.nan)
        is_assumed = bool(np.isnan(pace))
        pace = default_km_per_day if is_assumed else pace
        found.append(Train(name, float(km[-1]), min(day, today), pace, is_assumed))
    return found


def train_of(state: State) -> str:
    """Return the name of a suspension's train, or of the suspension if no train is named."""
    return state.series.place.train or f"{state.series.vehicle}: {state.series.place}"


def suspension_of(state: State) -> str:
    """Return the name of a suspension within its car."""
    place = state.series.place
    where = (place.suspension, place.bogie and f"{place.bogie} bogie", place.side)
    return ", ".join(filter(None, where)) or state.series.vehicle
