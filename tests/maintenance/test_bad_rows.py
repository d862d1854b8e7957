"""A row that cannot be read costs that row: it is named, and all else is shown."""

import logging
import shutil
import sqlite3
import warnings

import numpy as np
import pytest
from depot_trips import place, trips

from suspnet.ground.parameters import Cause, Severity
from suspnet.trains.history import History
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm
from suspnet.trains.maintenance.series import Event
from suspnet.trains.pages.board import Board, BoardSettings

pytestmark = pytest.mark.usefixtures("trips_fitted_once")
SETTINGS = BoardSettings(today="2026-03-01")
SIDES = [place("left"), place("right")]
FIRST = "UPDATE {} SET {} = {} WHERE rowid = (SELECT MIN(rowid) FROM {})"
N_TRIPS = 12
TODAY = "2026-03-01T08:00:00+00:00"
BAD = [
    ("trips", "start", "'yesterday'"),
    ("trips", "mileage_km", "'far'"),
    ("trips", "mileage_km", "9e999"),
    ("trips", "mileage_km", "-1"),
    ("trips", "c_s_half_width", "-9e999"),
    ("trips", "trip", "x'00ff'"),
    ("events", "kind", "'repaired'"),
    ("alarms", "cause", "'magic'"),
    ("alarms", "begin_km", "9e999"),
    ("acknowledgements", "at", "'noon'"),
    ("suspensions", "vehicle", "x'00ff'"),
    ("suspensions", "revision", "'new'"),
]
"""Each kind of fault, in each table: no number or text, no time, out of range, unknown."""


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a store written once; tests change copies of it."""
    found = tmp_path_factory.mktemp("written") / "fleet.db"
    with History(found) as store:
        for i, one in enumerate(SIDES):
            store.write(trips(one, i, n_trips=N_TRIPS))
            store.add_event("am96", one, Event(2_000.0, "exchanged"))
            store.keep_alarms("am96", one, [Alarm("k_p", Cause.LIMIT, Severity.ACT, 3_000.0)])
            seen = Acknowledgement("k_p", Cause.LIMIT, Severity.ACT, 3_000.0, "Kim", TODAY)
            store.acknowledge("am96", one, [seen])
    return found


@pytest.fixture
def path(written, tmp_path):
    return shutil.copy(written, tmp_path / "fleet.db")


def change(path, table, column, value):
    """Change a value of a table's first row by hand, as SQLite lets anybody do."""
    with sqlite3.connect(path) as connection:
        connection.execute(FIRST.format(table, column, value, table))
        raised = "UPDATE suspensions SET revision = revision + 1 WHERE typeof(revision) != 'text'"
        connection.execute(raised)
    connection.close()


@pytest.mark.parametrize(("table", "column", "value"), BAD)
def test_bad_row_is_named_and_the_others_are_shown(path, table, column, value, caplog):
    board = Board(str(path), SETTINGS)
    change(path, table, column, value)
    with caplog.at_level(logging.WARNING):
        assert board.refresh()
        assert not board.refresh()
    view = board.view
    assert view.is_complete
    assert view.trouble == ""
    assert len(view.states) == (1 if table == "suspensions" else 2)
    assert sum(len(one.series.trip) for one in view.states) == {
        "trips": 2 * N_TRIPS - 1,
        "suspensions": N_TRIPS,
    }.get(table, 2 * N_TRIPS)
    (words,) = {str(one) for one in view.bad_rows}
    assert words.startswith(f"{table}, row ")
    assert column in words or value.strip("'") in words
    logged = [one.getMessage() for one in caplog.records if words in one.getMessage()]
    assert len(logged) == 1  # once, not at each look
    assert "correct or delete" in logged[0]


def test_rows_that_turn_bad_are_left_out_and_shown_again_once_they_are_corrected(path):
    board = Board(str(path), SETTINGS)
    board.refresh()
    for changes, n_bad in (("mileage_km = 'far'", N_TRIPS), ("mileage_km = 1000.0 * id", 0)):
        with sqlite3.connect(path) as connection:
            connection.execute(f"UPDATE trips SET {changes} WHERE suspension_id = 1")
            connection.execute("UPDATE suspensions SET revision = revision + 1")
        connection.close()
        assert board.refresh()
        shown = SIDES[1:] if n_bad else SIDES
        assert {one.key[1] for one in board.view.states} == set(shown)
        assert len(board.view.bad_rows) == n_bad


def test_other_programs_read_past_a_bad_row(path, caplog):
    for column, value in (("start", "x'00ff'"), ("coherence_p", "'good'"), ("status", "7e0")):
        change(path, "trips", column, value)
    with History(path) as store, caplog.at_level(logging.WARNING):
        assert len(store.read("am96", SIDES[0])) == N_TRIPS - 1
        assert [one.table for one in store.bad_rows] == ["trips"]
        assert len(store.series()) == 2
    assert any("trips, row id=1" in one.getMessage() for one in caplog.records)


def test_text_that_is_no_utf8_is_shown_with_a_sign_in_its_place(path):
    change(path, "trips", "trip", "CAST(x'61ff62' AS TEXT)")
    with History(path) as store:
        assert "a\N{REPLACEMENT CHARACTER}b" in [one.trip for one in store.read("am96", SIDES[0])]
        assert store.bad_rows == []


@pytest.mark.parametrize(
    ("column", "value"),
    [("k_p", "1e300"), ("c_s_half_width", "1e-300"), ("healthy_since_km", "-1e300"), ("k_p", "0")],
)
def test_absurd_numbers_of_one_suspension_leave_the_others(path, column, value):
    board = Board(str(path), SETTINGS)
    with sqlite3.connect(path) as connection:
        connection.execute(f"UPDATE trips SET {column} = {value} WHERE suspension_id = 1")
    connection.close()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of such numbers
        assert board.refresh()
    assert board.view.is_complete
    other = next(one for one in board.view.states if one.key[1] == SIDES[1])
    assert len(other.series.trip) == N_TRIPS
    assert np.isfinite(other.last_km)
