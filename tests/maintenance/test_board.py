"""A board follows its store: what it shows is what a depot's study finds, whatever changed."""

import pickle
import shutil
import threading
from datetime import date
from functools import cache

import numpy as np
import pytest
from depot_trips import N_TRIPS, place, trips
from empty_stores import KINDS, empty_store

from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Severity
from suspnet.trains.history import History, HistoryError
from suspnet.trains.maintenance import state as states_module
from suspnet.trains.maintenance.alarms import Acknowledgement
from suspnet.trains.maintenance.plan import plan_of
from suspnet.trains.maintenance.series import Event
from suspnet.trains.maintenance.state import by_urgency, state_of
from suspnet.trains.pages import board as module
from suspnet.trains.pages.board import Board, BoardSettings
from suspnet.trains.pages.overview import address

pytestmark = pytest.mark.usefixtures("trips_fitted_once")
TODAY = "2026-03-01"
SETTINGS = BoardSettings(today=TODAY)
FAILED = {"k_s": np.where(np.arange(N_TRIPS) < 38, 1.0, 1.5)}
WORN = {"c_s": 1 - 0.2 * np.clip((np.arange(N_TRIPS) - 10) / 30, 0, None)}
LEFT, RIGHT, OTHER = place("left"), place("right"), place("left", "4")
FLEET = {LEFT: trips(LEFT, 0), RIGHT: trips(RIGHT, 1, FAILED), OTHER: trips(OTHER, 2, WORN)}
N_WRITTEN = 30


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a store of the first trips, written once; tests change copies of it."""
    path = tmp_path_factory.mktemp("written") / "fleet.db"
    with History(path) as history:
        for results in FLEET.values():
            history.write(results[:N_WRITTEN])
    return path


@pytest.fixture
def store(written, tmp_path):
    return str(shutil.copy(written, tmp_path / "fleet.db"))


@pytest.fixture
def board(store):
    board = Board(store, SETTINGS)
    assert board.refresh()
    return board


def write(store, *results):
    with History(store) as history:
        history.write(results)


def new_trips():
    """Return the trips that are not written yet, in the order in which they come."""
    return [results[i] for i in range(N_WRITTEN, N_TRIPS) for results in FLEET.values()]


def content_of(states):
    """Return alarms and lives of each suspension as values that compare."""
    return {
        state.key: (
            repr(state.watched.alarms),
            {name: life.samples_km.tolist() for name, life in state.lives.items()},
        )
        for state in states
    }


def alarms_of(states):
    return {state.key: repr(state.watched.alarms) for state in states}


def expected(store):
    with History(store) as history:
        return states_of(pickle.dumps(history.series()))


@cache
def states_of(series):
    """Return the states of a fleet, once for all stores that hold the same."""
    return by_urgency(
        state_of(one, DEFAULT_LIMITS, SETTINGS.changes, SETTINGS.seed)
        for one in pickle.loads(series)
    )


def failing(*_, **__):
    raise HistoryError("the store went away")


# reference


def test_a_first_view_is_what_the_functions_give(store, board):
    view, states = board.view, expected(store)
    assert [one.key for one in view.states] == [one.key for one in states]
    assert content_of(view.states) == content_of(states)
    assert (view.is_complete, view.trouble) == (True, "")
    assert view.version > 0
    plan = plan_of(states, SETTINGS.plan, date.fromisoformat(TODAY))
    assert view.plan.rows() == plan.rows() != []
    assert view.plan.n_quiet == plan.n_quiet
    assert [row["where"] for row in view.rows] == [str(one.series.place) for one in states]
    assert {view.states[i].key for i in view.keys.values()} == {("am96", one) for one in FLEET}


@pytest.mark.parametrize("kind", KINDS)
def test_a_board_follows_each_database(kind, tmp_path):
    store = empty_store(kind, tmp_path)
    board = Board(store, SETTINGS)
    for begin, end in ((0, 25), (25, N_TRIPS)):
        write(store, *(r for one in (LEFT, RIGHT) for r in FLEET[one][begin:end]))
        assert board.refresh()
        assert not board.refresh()
        assert not board.view.trouble
    assert content_of(board.view.states) == content_of(expected(store))
    assert board.view.states[0].severity == Severity.ACT


# property


def test_a_new_trip_is_computed_for_its_suspension_alone(store, board, monkeypatch):
    before = {state.key: state for state in board.view.states}
    watched, whole = [], states_module.watch
    monkeypatch.setattr(
        states_module, "watch", lambda *args: (watched.append(args[0].place), whole(*args))[1]
    )
    write(store, FLEET[OTHER][N_WRITTEN])
    assert board.refresh()
    assert watched == [OTHER]
    after = {state.key: state for state in board.view.states}
    assert {key[1] for key in after if after[key] is before[key]} == {LEFT, RIGHT}
    assert len(after["am96", OTHER].series.trip) == N_WRITTEN + 1
    assert content_of(after.values()) == content_of(expected(store))
    shown = board.view
    write(store, *(r for results in FLEET.values() for r in results[:N_WRITTEN]))
    assert not board.refresh()  # the same trips again
    assert board.view is shown


def test_a_long_refresh_shows_more_and_more(store, monkeypatch):
    monkeypatch.setattr(module, "AT_ONCE", 1)
    board, seen, view_of = Board(store, SETTINGS), [], module.FleetView
    assert (board.view.version, board.view.is_complete) == (0, False)
    monkeypatch.setattr(
        module, "FleetView", lambda **values: seen.append(view_of(**values)) or seen[-1]
    )
    board.refresh()
    assert [view.is_complete for view in seen] == [False, False, True]
    assert [view.version for view in seen] == list(range(1, len(seen) + 1))
    assert [len(view.states) for view in seen] == [1, 2, 3]
    assert [view.n_waiting for view in seen] == [2, 1, 0]
    assert seen[0].plan is None
    assert content_of(seen[-1].states) == content_of(expected(store))


def test_acknowledgements_are_shown_without_computing_anything(store, board, monkeypatch):
    write(store, *FLEET[RIGHT])
    board.refresh()
    monkeypatch.setattr(states_module, "watch", lambda *_: pytest.fail("watched again"))
    monkeypatch.setattr(states_module, "with_lives", lambda *_: pytest.fail("predicted again"))
    before = board.view
    assert before.rows[0]["acknowledged"] == ""
    seen = Acknowledgement("k_s", Cause.LIMIT, Severity.ACT, 8e4, "Kim", f"{TODAY}T08:00:00+00:00")
    with History(store) as history:
        history.acknowledge("am96", RIGHT, [seen])
    assert board.refresh()
    assert board.view.rows[0]["acknowledged"] == "Kim, 2026-03-01"
    assert board.view.acknowledged == {("am96", RIGHT): [seen]}
    assert board.view.states == before.states
    assert board.view.plan is before.plan
    # maintenance, however, leaves nothing as it was
    monkeypatch.undo()
    with History(store) as history:
        history.add_event("am96", RIGHT, Event(81_000.0, "exchanged"))
    assert board.refresh()
    state = board.view.states[board.view.keys[address(("am96", RIGHT))]]
    assert (state.severity, state.alarms) == (Severity.UNKNOWN, [])


def test_another_day_is_planned_again(store, monkeypatch):
    board = Board(store, BoardSettings())
    for day in (date(2026, 3, 1), date(2026, 3, 2)):
        monkeypatch.setattr(BoardSettings, "day", lambda _, day=day: day)
        assert board.refresh()
        assert board.view.plan.today == day
        assert not board.refresh()


def test_views_are_whole_while_trips_are_written(store):
    board, new = Board(store, SETTINGS), new_trips()[:6]
    writer = threading.Thread(target=lambda: [write(store, result) for result in new])
    writer.start()
    versions = []
    while writer.is_alive() or board.refresh():
        board.refresh()
        view = board.view
        versions.append(view.version)
        assert len(view.states) == len(view.rows) == len(view.keys) == len(FLEET)
    writer.join()
    assert versions == sorted(versions)
    assert all(len(state.series.trip) == N_WRITTEN + 2 for state in board.view.states)
    assert alarms_of(board.view.states) == alarms_of(expected(store))


# failure


def test_a_store_that_is_missing_or_goes_away_is_named_and_leaves_the_last_view(store, tmp_path):
    path, away = tmp_path / "fleet.db", tmp_path / "away.db"
    path.rename(away)
    board = Board(store, SETTINGS)
    assert board.refresh()
    assert "there is no such store" in board.view.trouble
    assert not board.refresh()
    assert not path.exists()
    away.rename(path)
    assert board.refresh()
    before = board.view
    assert (before.trouble, len(before.states)) == ("", len(FLEET))
    path.rename(away)
    assert board.refresh()
    assert "there is no such store" in board.view.trouble
    assert board.view.states == before.states
    assert board.view.version == before.version + 1
    away.rename(path)
    assert board.refresh()
    assert (board.view.trouble, board.view.is_complete) == ("", True)
    assert not board.refresh()


def test_a_server_that_does_not_answer_is_named():
    pytest.importorskip("psycopg", reason="needs suspnet[postgres]")
    board = Board("postgresql://me:secret@127.0.0.1:1/x", SETTINGS)
    assert board.refresh()
    assert "127.0.0.1" in board.view.trouble
    assert "secret" not in board.view.trouble


@pytest.mark.parametrize("method", ["series", "all_alarms", "all_acknowledgements", "revisions"])
def test_a_store_that_fails_within_a_refresh_loses_nothing(store, method, monkeypatch):
    board = Board(store, SETTINGS)
    with monkeypatch.context() as patch:
        patch.setattr(History, method, failing)
        assert board.refresh()
        assert "went away" in board.view.trouble
        assert not board.refresh()
    assert board.refresh()
    assert (board.view.trouble, board.view.is_complete) == ("", True)
    assert content_of(board.view.states) == content_of(expected(store))


def test_suspensions_that_are_gone_are_not_shown(store, board, tmp_path):
    (tmp_path / "fleet.db").unlink()
    write(store, *(r for where in (LEFT, OTHER) for r in FLEET[where][:N_WRITTEN]))
    board.refresh()
    assert {state.key[1] for state in board.view.states} == {LEFT, OTHER}


def test_inconsistent_limits_and_days_are_named(store):
    limits = {"k_s": {"notice": [0.5, 1.6]}}
    board = Board(store, BoardSettings(today=TODAY, limits=limits))
    assert board.refresh()
    assert "vehicle am96: " in board.view.trouble
    with pytest.raises(ValueError, match="must be a day like"):
        BoardSettings(today="tomorrow")
