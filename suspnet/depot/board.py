"""The fleet as it is now, kept up to date from a history."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any

from suspnet.depot.sisters import Key
from suspnet.depot.state import State, fleet_state
from suspnet.depot.view import FleetView, fleet_view, plan_of
from suspnet.dynamics import Vehicle
from suspnet.history import History, HistoryError
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.limits import DEFAULT_LIMITS, Limits, read_limits
from suspnet.maintenance.plan_inputs import PlanSettings
from suspnet.maintenance.sisters import SisterSettings
from suspnet.maintenance.watch import Watched

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BoardSettings:
    """What the states of a fleet and its plan depend on, besides its history.

    Parameters
    ----------
    vehicles : mapping of Vehicle
        Those whose limits are known; others have ``DEFAULT_LIMITS``.
    limits : mapping, optional
        In place of the vehicles': from a parameter to `notice` and `act`.
    changes : ChangeSettings
    sisters : SisterSettings
    plan : PlanSettings
    today : str, optional
        ISO 8601; the day of the computer's clock by default.
    seed : int
        Of the predicted lives.

    Raises
    ------
    ValueError
        If `today` is not a day.
    """

    vehicles: Mapping[str, Vehicle] = field(default_factory=dict)
    limits: Mapping[str, Any] | None = None
    changes: ChangeSettings = field(default_factory=ChangeSettings)
    sisters: SisterSettings = field(default_factory=SisterSettings)
    plan: PlanSettings = field(default_factory=PlanSettings)
    today: str | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        try:
            self.day()
        except ValueError:
            raise ValueError(f"`today` must be a day like 2026-03-31, got {self.today!r}") from None

    def day(self) -> date:
        """Return the day from which on is planned."""
        return date.fromisoformat(str(self.today)) if self.today else date.today()

    def limits_of(self, vehicle: str) -> Mapping[str, Limits]:
        """Return the limits of a vehicle by its name.

        Raises
        ------
        ValueError
            If `limits` cannot be read.
        """
        known = {one.name: one.known_limits for one in self.vehicles.values()}
        return read_limits(self.limits or {}, known.get(vehicle, DEFAULT_LIMITS))


class Board:
    """The fleet as it is now, kept up to date from a history.

    Parameters
    ----------
    store : str
        File or URL of the history.
    settings : BoardSettings
    """

    def __init__(self, store: str, settings: BoardSettings) -> None:
        self.store = store
        self.settings = settings
        self._view = FleetView()
        self._revisions: dict[Key, int] = {}
        self._lock = threading.Lock()

    @property
    def view(self) -> FleetView:
        """The last view."""
        return self._view

    def refresh(self) -> bool:
        """Work out what changed in the store since the last time; return whether anything did."""
        with self._lock:
            before = self._view
            try:
                self._refresh()
            except HistoryError as error:
                log.warning("%s", error)
                self._view = replace(before, version=before.version + 1, trouble=str(error))
            return self._view is not before

    def _refresh(self) -> None:
        """Make the view anew."""
        if "://" not in self.store and not Path(self.store).is_file():
            raise HistoryError(f"{self.store}: there is no such store")
        with History(self.store) as history:
            revisions = history.revisions()
            if revisions == self._revisions and not self._view.trouble:
                return
            fleet = history.series()
            kept = history.all_alarms()
            seen = history.all_acknowledgements()
        limits = {one.vehicle: self.settings.limits_of(one.vehicle) for one in fleet}
        early = [State(s, Watched(kept.get((s.vehicle, s.place), []))) for s in fleet]
        early.sort(key=lambda one: -one.severity)
        version = self._view.version
        self._view = fleet_view(early, limits, seen, None, version=version + 1, is_complete=False)
        options = self.settings.changes, self.settings.sisters, self.settings.seed
        states = fleet_state(fleet, limits, *options)
        plan = plan_of(states, self.settings.plan, self.settings.day())
        self._view = fleet_view(states, limits, seen, plan, version=version + 2)
        self._revisions = revisions
