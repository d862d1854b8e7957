"""States of all suspensions of a fleet, recomputed only where trips changed."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from suspnet.ground.parameters import DEFAULT_LIMITS, Limits
from suspnet.ground.records import Key
from suspnet.trains.maintenance.alarms import watch
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.maintenance.series import Series
from suspnet.trains.maintenance.state import State, by_urgency, with_lives


class FleetStates:
    """Alarms and remaining lives of the suspensions of a fleet, each by its own trips.

    `limits` maps vehicles to the limits of their parameters; a missing vehicle has
    ``DEFAULT_LIMITS``. `seed` is that of the predicted lives.
    """

    def __init__(
        self, limits: Mapping[str, Mapping[str, Limits]], changes: ChangeSettings, seed: int = 0
    ) -> None:
        self.limits = limits
        self.changes = changes
        self.seed = seed
        self._states: dict[Key, State] = {}
        self._waiting: set[Key] = set()

    def keys(self) -> set[Key]:
        """Return vehicle and place of each suspension."""
        return set(self._states)

    def update(self, several: Iterable[Series], gone: Collection[Key] = ()) -> set[Key]:
        """Add or replace suspensions, remove those in `gone`, and recompute alarms.

        Returns the keys of the suspensions whose alarms were recomputed, which are those whose
        trips or maintenance changed.
        """
        for key in gone:
            self._states.pop(key, None)
            self._waiting.discard(key)
        changed = set()
        for series in several:
            before = self._states.get(series.key)
            if before is None or not before.series.equals(series):
                limits = self.limits.get(series.vehicle, DEFAULT_LIMITS)
                watched = watch(series, limits, self.changes)
                self._states[series.key] = State(series, limits, watched)
                changed.add(series.key)
        self._waiting |= changed
        return changed

    def predict(self, seconds: float = np.inf) -> bool:
        """Predict the remaining lives that are out of date.

        It stops after `seconds` [s] and continues when called again. Returns whether all are up to
        date.
        """
        end = time.monotonic() + seconds
        for key in sorted(self._waiting, key=lambda key: (key[0], str(key[1]))):
            self._states[key] = with_lives(self._states[key], self.seed)
            self._waiting.discard(key)
            if time.monotonic() > end:
                break
        return not self._waiting

    def states(self) -> list[State]:
        """Return the state of each suspension, by severity, then by remaining life."""
        return by_urgency(self._states.values())


def fleet_state(
    several: Sequence[Series],
    limits: Mapping[str, Mapping[str, Limits]],
    settings: ChangeSettings,
    seed: int = 0,
) -> list[State]:
    """Return the state of each suspension, most severe first; see ``FleetStates``."""
    fleet = FleetStates(limits, settings, seed)
    fleet.update(several)
    fleet.predict()
    return fleet.states()
