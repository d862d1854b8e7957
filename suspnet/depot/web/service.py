"""The fleet of the current application: the thread that follows its store, and the store."""

from typing import cast

from flask import abort, current_app

from suspnet.ground.records import TripResult
from suspnet.runs.language import gettext
from suspnet.trains.history import History
from suspnet.trains.maintenance.series import with_widened
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.board import Refresher

SERVICE = "suspnet_fleet"  # key, among an application's extensions, of the `Refresher`
READ_S, WRITE_S = 0.5, 2.0
"""Timeouts for reading from a store that other programs have locked, and for writing to it, [s]."""


def current_refresher() -> Refresher:
    """Return the thread behind the current application; its board has the view of the fleet."""
    return cast(Refresher, current_app.extensions[SERVICE])


def opened_store(*, to_write: bool = False) -> History:
    """Return the store, without creating a missing one.

    HistoryError is raised if it cannot be used, or is locked for longer than ``READ_S`` or
    ``WRITE_S``.
    """
    wait_s = WRITE_S if to_write else READ_S
    return History(current_refresher().board.store, wait_s=wait_s, must_exist=True)


def named_state(name: str) -> State:
    """Return a suspension by its name in the URL; abort with 404 if there is none."""
    state = current_refresher().board.view.state(name)
    if state is None:
        abort(404, gettext("There is no such suspension in this history."))
    return state


def stored_trips(store: History, state: State) -> list[TripResult]:
    """Return the trips of a suspension, with the intervals of its series."""
    return with_widened(store.read(*state.key), state.series.events)
