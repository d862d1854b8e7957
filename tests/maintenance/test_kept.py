"""Overviews in a store: a board that starts shows what was computed before, without computing."""

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from depot_trips import N_TRIPS, place, trips
from empty_stores import KINDS, empty_store
from served_fleet import bogie_trips

from suspnet.ground.findings import Finding, as_plain, stored
from suspnet.ground.records import Place
from suspnet.trains.history import History, HistoryError
from suspnet.trains.maintenance import state as states_module
from suspnet.trains.maintenance.plan import plan_of
from suspnet.trains.maintenance.series import Event
from suspnet.trains.maintenance.state import KeptState, State
from suspnet.trains.pages import kept
from suspnet.trains.pages.board import Board, BoardSettings
from suspnet.trains.pages.bogie import bogie_of, bogies_shown

pytestmark = pytest.mark.usefixtures("trips_fitted_once")
SETTINGS = BoardSettings(today="2026-03-01")
LEFT, RIGHT, BOGIE = place("left"), place("right"), Place("", "leading", "left", "4", "3")
FAILED = {"k_s": np.where(np.arange(N_TRIPS) < 36, 1.0, 1.5)}
GROUP = {"names": ("c_p_axle1_left", "c_p_axle2_left"), "where": "a damper", "percent": 70.0}
WORN = stored(Finding("worn-one-of", odds="20 : 1", **GROUP))


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Return a store that was served, and its view."""
    path = tmp_path_factory.mktemp("served") / "fleet.db"
    with History(path) as history:
        history.write(trips(LEFT, 0)[:-1])
        history.write(trips(RIGHT, 1, FAILED))
        history.write(bogie_trips(BOGIE, 2, {"c_p_axle1_left": lambda i: 0.6}, lambda _: WORN))
        history.add_event("am96", RIGHT, Event(20_000.0, "exchanged", "damper"))
    board = Board(str(path), SETTINGS)
    board.refresh()
    return path, board.view


@pytest.fixture
def store(served, tmp_path):
    return str(shutil.copy(served[0], tmp_path / "fleet.db"))


@pytest.fixture
def computed(monkeypatch):
    """Return the places whose alarms are computed from here on."""
    places, watch = [], states_module.watch
    monkeypatch.setattr(
        states_module, "watch", lambda *args: (places.append(args[0].place), watch(*args))[1]
    )
    return places


def shown(view):
    """Return all that the pages of a fleet show, as values that compare."""
    bogies = bogies_shown(view.entries, view.plan)
    return {
        "rows": [
            {k: (as_plain(v) if isinstance(v, str) else repr(v)) for k, v in row.items()}
            for row in view.rows
        ],
        "alarms": [repr(state.all_alarms) for state in view.states],
        "bogies": repr(bogies),
        "plan": (repr(view.plan.rows()), as_plain(view.plan.summary)),
        "names": view.names,
    }


def refreshed(store, settings=SETTINGS):
    board = Board(store, settings)
    assert board.refresh()
    return board


def changed_by_hand(store, statement):
    with closing(sqlite3.connect(store)) as connection, connection:
        connection.execute(statement)


# reference


def test_a_restart_shows_the_same_without_computing_it(served, store, computed):
    board, view = refreshed(store), served[1]
    assert all(isinstance(state, KeptState) for state in board.view.states)
    assert shown(board.view) == shown(view)
    assert len(board.view.plan.rows()) > 1
    assert (board.view.is_complete, board.view.n_waiting, computed) == (True, 0, [])
    assert not board.refresh()
    # another day changes the plan alone
    day = date(2026, 3, 9)
    later = refreshed(store, replace(SETTINGS, today=str(day))).view
    assert repr(later.plan.rows()) == repr(plan_of(view.states, SETTINGS.plan, day).rows())
    assert computed == []


@pytest.mark.parametrize("kind", KINDS)
def test_each_database_keeps_them(kind, tmp_path, computed):
    store = empty_store(kind, tmp_path)
    with History(store) as history:
        history.write(trips(LEFT, 0)[:20])
    before = refreshed(store).view
    assert computed == [LEFT]
    assert shown(refreshed(store).view) == shown(before)
    assert computed == [LEFT]


def test_a_suspension_that_is_asked_for_is_computed_once(served, store, computed):
    board = refreshed(store)
    for name, found, state in zip(
        board.view.names, board.view.states, served[1].states, strict=True
    ):
        whole = board.whole(name)
        assert type(whole) is State
        assert board.whole(name) is whole
        assert repr(whole.assessments) == repr(state.assessments)
        assert [*whole.lives] == [*found.lives] == [*state.lives]
    assert len(computed) == 3
    assert board.whole("other") is None


# property


def test_a_changed_suspension_is_shown_once_it_is_computed(store, computed, monkeypatch):
    with History(store) as history:
        history.write(trips(LEFT, 0)[-1:])
    board, views, show = Board(store, SETTINGS), [], Board._show
    monkeypatch.setattr(
        Board, "_show", lambda self, *args: (show(self, *args), views.append(self.view))
    )
    board.refresh()
    first, last = views
    assert {state.place for state in first.states} == {RIGHT, BOGIE}
    assert (first.is_complete, first.n_waiting) == (False, 1)
    assert (last.is_complete, last.n_waiting, len(last.states)) == (True, 0, 3)
    (row,) = (row for row in last.rows if row["where"] == str(LEFT))
    assert row["n_trips"] == N_TRIPS
    assert computed == [LEFT]
    refreshed(store)
    assert computed == [LEFT]


def test_what_several_trips_name_later_is_shown(served, store, computed):
    # as the next trip, or an evaluation of the folder, writes a trip again
    with History(store) as history:
        history.write([replace(history.read("am96", BOGIE)[-1], worn="")])
    board = refreshed(store)
    assert computed == [BOGIE]
    state = next(s for s in board.view.states if s.place == BOGIE)
    before = next(s for s in served[1].states if s.place == BOGIE)
    assert bogie_of(before).groups
    assert not bogie_of(state).groups


def test_other_settings_or_code_are_computed_anew(store, computed, monkeypatch):
    limits = {"k_s": {"act": [0.5, 2.0], "notice": [0.8, 1.7]}}
    for settings in (replace(SETTINGS, seed=1), replace(SETTINGS, limits=limits), SETTINGS):
        computed.clear()
        refreshed(store, settings)
        assert len(computed) == 3
    computed.clear()
    monkeypatch.setattr(kept, "code_hash", lambda: "later")
    refreshed(store)
    assert len(computed) == 3


# failure


def test_an_altered_overview_is_computed_anew(served, store, computed):
    for altered in ("''", "'[]'", "x'00ff'", "replace(content, 'none', 'act')"):
        changed_by_hand(store, f"UPDATE overviews SET content = {altered} WHERE suspension_id = 1")
        computed.clear()
        assert shown(refreshed(store).view) == shown(served[1])
        assert computed == [LEFT]


def test_a_store_that_cannot_be_written_is_served(store, monkeypatch):
    changed_by_hand(store, "DELETE FROM overviews")

    def refused(*_):
        raise HistoryError("attempt to write a readonly database")

    monkeypatch.setattr(History, "keep_overviews", refused)
    view = refreshed(store).view
    assert (view.trouble, view.is_complete, len(view.states)) == ("", True, 3)
