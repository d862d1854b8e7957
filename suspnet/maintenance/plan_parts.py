"""Parts of a fleet as the plan takes them: remaining lives, and how far each train runs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from datetime import date

import numpy as np

from suspnet.dynamics import PARAMETERS
from suspnet.maintenance.limits import Severity
from suspnet.maintenance.plan_inputs import Part, Train, km_per_day
from suspnet.maintenance.state import State


def parts_of(states: Sequence[State]) -> list[Part]:
    """Return each parameter of each suspension that has an alarm or limits."""
    found = []
    for state in states:
        named = {*state.lives, *state.unknown, *(one.parameter for one in state.alarms)}
        for name in (one for one in PARAMETERS if one in named):
            life = state.lives.get(name)
            severity = max(
                (one.severity for one in state.alarms if one.parameter == name),
                default=Severity.NONE,
            )
            samples = np.array([np.inf]) if life is None else life.samples_km
            place = state.series.place
            found.append(
                Part(
                    train_of(state),
                    suspension_of(state),
                    name,
                    samples,
                    float(np.nan_to_num(state.last_km)),  # 0 counts only where nothing is known
                    severity,
                    place.car,
                    state.unknown.get(name, "" if life else "it has no limits"),
                )
            )
    return found


def trains_of(states: Sequence[State], today: date, default_km_per_day: float) -> list[Train]:
    """Return each train, with the mileage of its newest trip and how far it runs in a day.

    A trip without a start is taken as of today. A train without any mileage is at 0 km: nothing is
    known of its parts, so that it has no visits.
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
    """Return the name of a suspension's train; of the suspension itself where none is named."""
    return state.series.place.train or f"{state.series.vehicle}: {state.series.place}"


def suspension_of(state: State) -> str:
    """Return the name of a suspension within its car."""
    place = state.series.place
    where = (place.suspension, place.bogie and f"{place.bogie} bogie", place.side)
    return ", ".join(filter(None, where)) or state.series.vehicle
