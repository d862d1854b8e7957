"""The plan for a fleet, kept so that only trains whose suspensions changed are planned again."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from datetime import date

from suspnet.maintenance.plan import join_plans, make_plan
from suspnet.maintenance.plan_inputs import PlanSettings
from suspnet.maintenance.plan_parts import parts_of, train_of, trains_of
from suspnet.maintenance.schedule import Plan
from suspnet.maintenance.state import State


class Planner:
    """Plans visits, each train by itself.

    Parameters
    ----------
    settings : PlanSettings
    """

    def __init__(self, settings: PlanSettings) -> None:
        self.settings = settings
        self._made: dict[str, tuple[list[State], Plan]] = {}

    def plan(self, states: Sequence[State], today: date) -> Plan:
        """Return the plan for a fleet; it is that of ``make_plan``.

        A train is planned again if one of its states is another object than the last time, or the
        day is another.
        """
        of_train: dict[str, list[State]] = {}
        for state in states:
            of_train.setdefault(train_of(state), []).append(state)
        self._made = {name: self._of(name, own, today) for name, own in sorted(of_train.items())}
        nothing = make_plan([], [], self.settings, today)
        return join_plans([nothing, *(plan for _, plan in self._made.values())])

    def _of(self, name: str, states: list[State], today: date) -> tuple[list[State], Plan]:
        """Return the states of a train, and their plan."""
        known = self._made.get(name)
        if known is not None and known[1].today == today and _are(states, known[0]):
            return known
        trains = trains_of(states, today, self.settings.km_per_day)
        return states, make_plan(parts_of(states), trains, self.settings, today)


def _are(states: Sequence[State], others: Sequence[State]) -> bool:
    """Return whether states are the same objects, in the same order."""
    return len(states) == len(others) and all(map(operator.is_, states, others))
