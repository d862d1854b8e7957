"""A board follows its store: what it shows is what a depot's study finds, whatever changed."""

import pickle
import shutil
import threading
from dataclasses import replace
from datetime import date
from functools import cache

import numpy as np
import pytest
from depot_trips import N_TRIPS, place, trips
from empty_stores import KINDS, empty_store

from suspnet.ground.parameters import Cause, Severity
from suspnet.ground.records import Place
from suspnet.history import History, HistoryError
from suspnet.maintenance import fleet as fleet_module
from suspnet.maintenance.alarms import OWN_CAUSES, Acknowledgement, Alarm
from suspnet.maintenance.fleet import fleet_state
from suspnet.maintenance.plan import make_plan, parts_of, trains_of
from suspnet.maintenance.series import Event
from suspnet.report import board as module
from suspnet.report.board import Board, BoardSettings
from suspnet.report.overview import address

pytestmark = pytest.mark.usefixtures("trips_fitted_once")
TODAY = "2026-03-01"
SETTINGS = BoardSettings(today=TODAY)
FAILED = {"k_s": np.where(np.arange(N_TRIPS) < 38, 1.0, 1.5)}
WORN = {"c_s": 1 - 0.2 * np.clip((np.arange(N_TRIPS) - 10) / 30, 0, None)}
ODD = {"k_p": np.full(N_TRIPS, 0.96)}
"""No change, less than a limit, and more than sisters differ by."""
FLEET = {
    place("left"): trips(place("left"), 0),
    place("right"): trips(place("right"), 1, FAILED),
    place("left", "4"): trips(place("left", "4"), 2, WORN),
    place("right", "4"): trips(place("right", "4"), 3),
    place("left", "5"): trips(place("left", "5"), 4),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a store of the first trips, written once; tests change copies of it."""
    path = tmp_path_factory.mktemp("written") / "fleet.db"
    with History(path) as history:
        for results in FLEET.values():
            history.write(results[:30])
    return path


@pytest.fixture
def store(written, tmp_path):
    return str(shutil.copy(written, tmp_path / "fleet.db"))


@pytest.fixture
def board(store):
    found = Board(store, SETTINGS)
    assert found.refresh()
    return found


def write(store, *results):
    with History(store) as history:
        history.write(results)


def found_of(states):
    """Return alarms and lives of each suspension as values that compare."""
    return {
        state.key: (
            repr(state.watched.alarms),
            {name: life.samples_km.tolist() for name, life in state.lives.items()},
        )
        for state in states
    }


def expected(store):
    with History(store) as history:
        return states_of(pickle.dumps(history.series()))


@cache
def states_of(series):
    """Return what is found of a fleet, once for all stores that hold the same."""
    return fleet_state(pickle.loads(series), {}, SETTINGS.changes, SETTINGS.sisters, SETTINGS.seed)


def views_of(board, monkeypatch):
    """Return the list that will hold each view that the board shows."""
    seen, show = [], board._show
    monkeypatch.setattr(
        board, "_show", lambda *args, **kw: (show(*args, **kw), seen.append(board.view))
    )
    return seen


# reference


def test_a_first_view_is_what_the_functions_give(store, board):
    view, states = board.view, expected(store)
    assert [one.key for one in view.states] == [one.key for one in states]
    assert found_of(view.states) == found_of(states)
    assert view.is_complete
    assert view.trouble == ""
    assert view.version > 0
    trains = trains_of(states, date.fromisoformat(TODAY), SETTINGS.plan.km_per_day)
    plan = make_plan(parts_of(states), trains, SETTINGS.plan, date.fromisoformat(TODAY))
    assert view.plan.rows() == plan.rows()
    assert view.plan.n_quiet == plan.n_quiet
    assert len(plan.rows()) > 0
    assert [row["where"] for row in view.rows] == [str(one.series.place) for one in states]
    assert {tuple(sorted(view.states[i].series.place.side for i in car)) for car in view.cars} == {
        ("left", "right")
    }
    assert len(view.cars) == 2
    assert {view.states[i].key for i in view.keys.values()} == {("am96", one) for one in FLEET}
    assert set(view.limits) == {"am96"}


def test_an_address_is_short_and_tells_suspensions_apart():
    places = [Place("a"), Place(side="a"), Place("a", car="1"), Place("<b>/../")]
    found = {address((vehicle, where)) for vehicle in ("x", "y") for where in places}
    assert len(found) == 8
    assert all(len(one) == 12 and int(one, 16) >= 0 for one in found)
    assert address(("am96", place("left"))) == address(("am96", place("left")))


@pytest.mark.parametrize("kind", KINDS)
def test_a_board_follows_each_database(kind, tmp_path):
    store = empty_store(kind, tmp_path)
    board = Board(store, SETTINGS)
    car = [FLEET[place(side)] for side in ("left", "right")]
    for begin, end in ((0, 25), (25, 26), (26, 40)):
        write(store, *(r for results in car for r in results[begin:end]))
        assert board.refresh()
        assert not board.refresh()
        assert not board.view.trouble
    assert found_of(board.view.states) == found_of(expected(store))
    assert board.view.states[0].severity == Severity.ACT


# property


def test_nothing_new_is_no_new_view(board):
    before = board.view
    assert not board.refresh()  # though it told the store alarms of sisters itself
    assert not board.refresh()
    assert board.view is before


def test_a_new_trip_is_worked_out_for_its_car_alone(store, board, monkeypatch):
    before = {state.key: state for state in board.view.states}
    watched = []
    whole = fleet_module.watch
    monkeypatch.setattr(
        fleet_module, "watch", lambda *args: (watched.append(args[0].place), whole(*args))[1]
    )
    write(store, FLEET[place("left", "4")][30])
    assert board.refresh()
    assert watched == [place("left", "4")]
    after = {state.key: state for state in board.view.states}
    same = {key[1] for key in after if after[key] is before[key]}
    assert same == {place("left"), place("right"), place("left", "5")}
    assert len(after["am96", place("left", "4")].series.trip) == 31
    # the prior of the rates is that of the first view: a fifth of a tenth of the trips are new
    alarms = {state.key: repr(state.watched.alarms) for state in expected(store)}
    assert {key: repr(state.watched.alarms) for key, state in after.items()} == alarms


def test_many_new_trips_are_as_if_read_for_the_first_time(store, board):
    for number in range(30, N_TRIPS, 5):
        write(store, *(r for results in FLEET.values() for r in results[number : number + 5]))
        assert board.refresh()
    before = board.view
    assert before.states[0].severity == Severity.ACT
    write(store, *(r for results in FLEET.values() for r in results))
    assert not board.refresh()  # the same trips again
    board._fleet._n_new["am96"] = 10_000
    write(store, replace(FLEET[place("left")][0], flags="doubtful"))
    assert board.refresh()
    assert found_of(board.view.states) == found_of(expected(store))


def test_rates_of_wear_are_learnt_again_with_a_tenth_of_new_trips(store, board, monkeypatch):
    learnt = []
    learn = fleet_module.learn_priors
    monkeypatch.setattr(
        fleet_module, "learn_priors", lambda *args: (learnt.append(1), learn(*args))[1]
    )
    n_needed = int(5 * 30 * 0.1) + 2  # of 150 trips, and those that come
    new = [results[number] for number in range(30, N_TRIPS) for results in FLEET.values()]
    for i, result in enumerate(new[:n_needed], 1):
        write(store, result)
        if i < n_needed - 2:
            continue
        board.refresh()
        assert len(learnt) == (i > 0.1 * (150 + i))
    assert len(learnt) == 1
    assert found_of(board.view.states) == found_of(expected(store))


def test_a_long_refresh_shows_what_it_has(store, monkeypatch):
    kept = Alarm("c_p", Cause.LIMIT, Severity.NOTICE, 2000.0, words="kept before")
    with History(store) as history:
        history.keep_alarms("am96", place("left"), [kept], OWN_CAUSES)
    monkeypatch.setattr(module, "SHOWN_S", 0.0)
    monkeypatch.setattr(module, "AT_ONCE", 1)
    board = Board(store, SETTINGS)
    assert board.view.version == 0
    assert not board.view.is_complete
    seen = views_of(board, monkeypatch)
    board.refresh()
    assert [view.is_complete for view in seen] == [False] * (len(seen) - 1) + [True]
    assert len(seen) > 8  # one early, one for each that was watched, for each life
    assert [view.version for view in seen] == list(range(1, len(seen) + 1))
    assert all(len(view.states) == 5 for view in seen)
    first = seen[0].states[seen[0].keys[address(("am96", place("left")))]]
    assert repr(first.alarms) == repr([kept])
    assert first.lives == {}
    assert seen[0].plan is None
    assert seen[-1].plan is not None
    assert found_of(seen[-1].states) == found_of(expected(store))


def test_acknowledgements_are_shown_without_working_anything_out(store, board, monkeypatch):
    write(store, *FLEET[place("right")])
    board.refresh()
    monkeypatch.setattr(fleet_module, "watch", lambda *_: pytest.fail("watched again"))
    monkeypatch.setattr(fleet_module, "remaining_lives", lambda *_: pytest.fail("predicted again"))
    before = board.view
    assert before.rows[0]["acknowledged"] == ""
    seen = Acknowledgement("k_s", Cause.LIMIT, Severity.ACT, 8e4, "Kim", f"{TODAY}T08:00:00+00:00")
    with History(store) as history:
        history.acknowledge("am96", place("right"), [seen])
    assert board.refresh()
    assert board.view.rows[0]["acknowledged"] == "Kim, 2026-03-01"
    assert board.view.acknowledged == {("am96", place("right")): [seen]}
    assert board.view.states == before.states
    assert board.view.plan is before.plan


def test_maintenance_is_seen(store, board):
    write(store, *FLEET[place("right")])
    board.refresh()
    assert board.view.states[0].severity == Severity.ACT
    with History(store) as history:
        history.add_event("am96", place("right"), Event(81_000.0, "exchanged"))
    assert board.refresh()
    state = board.view.states[board.view.keys[address(("am96", place("right")))]]
    assert state.severity == Severity.UNKNOWN
    assert not state.alarms


def test_alarms_of_sisters_are_told_the_store_and_left_by_others(tmp_path):
    store = str(tmp_path / "fleet.db")
    sides = [place(side) for side in ("left", "right", "third", "fourth")]
    with History(store) as history:
        for i, where in enumerate(sides):
            history.write(trips(where, 20 + i, ODD if i == 3 else {}))
    boards = [Board(store, SETTINGS), Board(store, SETTINGS)]
    assert all(board.refresh() for board in boards)
    with History(store) as history:
        kept = history.all_alarms()
        own = [Alarm("k_p", Cause.CHANGE, Severity.NOTICE, 40_000.0)]
    told = {key: [a for a in alarms if a.cause == Cause.SISTER] for key, alarms in kept.items()}
    shown = {
        state.key: [a for a in state.watched.alarms if a.cause == Cause.SISTER]
        for state in boards[0].view.states
    }
    assert repr(told) == repr({key: alarms for key, alarms in shown.items() if alarms})
    (key,) = told
    assert key == ("am96", sides[3])
    with History(store) as history:
        history.keep_alarms(*key, own, OWN_CAUSES)
        assert {a.cause for a in history.alarms(*key)} == {Cause.CHANGE, Cause.SISTER}
        before = history.revisions()
    # neither board wakes the other, or itself
    assert not any(board.refresh() for board in boards * 3)
    with History(store) as history:
        assert history.revisions() == before


def test_another_day_is_planned_anew(store, monkeypatch):
    board = Board(store, BoardSettings())
    monkeypatch.setattr(BoardSettings, "day", lambda _: date(2026, 3, 1))
    board.refresh()
    assert not board.refresh()
    monkeypatch.setattr(BoardSettings, "day", lambda _: date(2026, 3, 2))
    assert board.refresh()
    assert board.view.plan.today == date(2026, 3, 2)
    assert not board.refresh()


def test_views_are_whole_while_trips_are_written(store):
    board = Board(store, SETTINGS)
    new = [results[number] for number in range(30, 33) for results in FLEET.values()]
    writer = threading.Thread(target=lambda: [write(store, result) for result in new])
    writer.start()
    versions = []
    while writer.is_alive() or board.refresh():
        board.refresh()
        view = board.view
        versions.append(view.version)
        assert len(view.states) == len(view.rows) == len(view.keys) == 5
    writer.join()
    assert versions == sorted(versions)
    assert all(len(state.series.trip) == 33 for state in board.view.states)
    alarms = {state.key: repr(state.watched.alarms) for state in expected(store)}
    assert {s.key: repr(s.watched.alarms) for s in board.view.states} == alarms


# failure


def test_a_store_that_is_not_there_yet_is_told(tmp_path):
    board = Board(str(tmp_path / "later.db"), SETTINGS)
    assert board.refresh()
    assert "there is no such store" in board.view.trouble
    assert not board.refresh()
    assert not (tmp_path / "later.db").exists()
    write(board.store, *FLEET[place("left")])
    assert board.refresh()
    assert board.view.trouble == ""
    assert len(board.view.states) == 1


def test_a_server_that_does_not_answer_is_told():
    pytest.importorskip("psycopg")
    board = Board("postgresql://me:secret@127.0.0.1:1/x", SETTINGS)
    assert board.refresh()
    assert "127.0.0.1" in board.view.trouble
    assert "secret" not in board.view.trouble


def test_a_store_that_goes_away_leaves_the_last_view(store, board, tmp_path):
    before = board.view
    (tmp_path / "fleet.db").rename(tmp_path / "away.db")
    assert board.refresh()
    assert "there is no such store" in board.view.trouble
    assert board.view.states == before.states
    assert board.view.version == before.version + 1
    (tmp_path / "away.db").rename(tmp_path / "fleet.db")
    assert board.refresh()
    assert board.view.trouble == ""
    assert board.view.is_complete
    assert not board.refresh()


@pytest.mark.parametrize("method", ["series", "all_alarms", "all_acknowledgements", "revisions"])
def test_a_store_that_fails_within_a_refresh_loses_nothing(store, method, monkeypatch):
    board = Board(store, SETTINGS)
    with monkeypatch.context() as patch:
        patch.setattr(module, "SHOWN_S", 0.0)
        patch.setattr(History, method, failing)
        assert board.refresh()
        assert "went away" in board.view.trouble
        assert not board.refresh()
    assert board.refresh()
    assert board.view.trouble == ""
    assert board.view.is_complete
    assert found_of(board.view.states) == found_of(expected(store))


def test_a_store_that_may_only_be_read_is_shown(store, monkeypatch):
    board = Board(store, SETTINGS)
    monkeypatch.setattr(History, "keep_all_alarms", failing)
    assert board.refresh()
    assert board.view.trouble == ""
    assert not board.refresh()


def test_suspensions_that_are_gone_are_not_shown(store, board, tmp_path):
    (tmp_path / "fleet.db").unlink()
    write(store, *(r for where in (place("left"), place("right")) for r in FLEET[where][:30]))
    board.refresh()
    assert {state.key[1] for state in board.view.states} == {place("left"), place("right")}
    assert len(board.view.cars) == 1


def test_limits_that_do_not_go_together_are_told(store):
    limits = {"k_s": {"notice": [0.5, 1.6]}}
    board = Board(store, BoardSettings(today=TODAY, limits=limits))
    assert board.refresh()
    assert "vehicle am96: " in board.view.trouble
    with pytest.raises(ValueError, match="must be a day like"):
        BoardSettings(today="tomorrow")


def failing(*_, **__):
    raise HistoryError("the store went away")


LAST_FLAGGED = "all of the last 5 trips are flagged"


@pytest.mark.parametrize(
    ("flagged", "severity", "words", "reason"),
    [
        ([""] * 10, Severity.NONE, "", ""),
        (["misfit"] * 4 + [""] + ["misfit"] * 4, Severity.NONE, "", ""),
        (["misfit"] * 10, Severity.UNKNOWN, LAST_FLAGGED, "not judged, as all trips are flagged"),
        (
            [""] * 5 + ["misfit"] * 5,
            Severity.UNKNOWN,
            LAST_FLAGGED,
            f"not judged, as {LAST_FLAGGED}",
        ),
    ],
)
def test_suspension_whose_last_trips_are_all_flagged_is_not_judged(
    tmp_path, flagged, severity, words, reason
):
    where = place("left")
    made = trips(where, 0, n_trips=len(flagged))
    with History(tmp_path / "fleet.db") as store:
        store.write([replace(one, flags=flag) for one, flag in zip(made, flagged, strict=True)])
    board = Board(str(tmp_path / "fleet.db"), BoardSettings())
    board.refresh()
    (state,) = board.view.states
    assert (state.severity, state.unjudged) == (severity, words)
    assert reason in board.view.rows[0]["reason"]
