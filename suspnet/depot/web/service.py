"""The fleet as pages, API and metrics read it: its state, its store, and acknowledgements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from flask import current_app

from suspnet.ground.records import TripResult
from suspnet.trains.history import History
from suspnet.trains.history.store import acknowledge_alarms
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm
from suspnet.trains.maintenance.relative import relative_results
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.board import Refresher
from suspnet.trains.pages.overview import FleetView

SERVICE = "suspnet_fleet"  # key, among an application's extensions, of the `FleetService`
READ_S, WRITE_S = 0.5, 2.0
"""Timeouts for reading from a store that other programs have locked, and for writing to it, [s]."""


class FleetService:
    """A fleet that a `refresher` follows in its thread."""

    def __init__(self, refresher: Refresher) -> None:
        self.refresher = refresher

    @property
    def view(self) -> FleetView:
        """The newest view of the fleet."""
        return self.refresher.board.view

    def opened(self, wait_s: float | None = None) -> History:
        """Return the store, without creating a missing one.

        HistoryError is raised if it cannot be used, or is locked for longer than `wait_s`, by
        default ``READ_S``.
        """
        wait_s = READ_S if wait_s is None else wait_s
        return History(self.refresher.board.store, wait_s=wait_s, must_exist=True)

    def trips(self, store: History, state: State) -> list[TripResult]:
        """Return the trips of a suspension, relative to its first ones where these are healthy."""
        n_first = self.refresher.board.settings.n_first
        return relative_results(store.read(*state.key), state.series.events, n_first)

    def acknowledge(
        self, state: State, alarms: Sequence[Alarm], by: str, words: str
    ) -> list[Acknowledgement]:
        """Store that a person acknowledges alarms, and return what is stored."""
        newest_km = float(np.nanmax(state.series.mileage_km))
        with self.opened(WRITE_S) as store:
            stored = acknowledge_alarms(store, *state.key, alarms, newest_km, by, words)
        self.refresher.soon()
        return stored


def current_service() -> FleetService:
    """Return the fleet of the current application."""
    service = current_app.extensions[SERVICE]
    assert isinstance(service, FleetService)
    return service
