"""suspnet history lists, adds maintenance and writes tables; mistakes are one line."""

import pyarrow.parquet as pq
import pytest
from trip_records import fleet, trip

from suspnet.cli.history import history
from suspnet.cli.options import history_parser
from suspnet.ground.parameters import Cause, Severity
from suspnet.ground.records import Place
from suspnet.trains.history import History, HistoryError
from suspnet.trains.maintenance.alarms import Alarm

PLACE = Place("bogie 1, left")
OTHER = Place("x", "leading", train="4", car="7")
WHERE = ["--vehicle", "AM96 217", "--suspension", PLACE.suspension]


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "history.db"
    with History(found) as store:
        store.write([*fleet(5, missing=(2,), with_curves=False)])
        store.write([trip(0, with_curves=False, place=OTHER)])
    return found


def run(path, *arguments):
    history(history_parser().parse_args([str(path), *arguments]))


def test_list_names_each_suspension_with_trips_and_maintenance(path, capsys):
    run(path, "event", *WHERE, "--at-km", "30000", "--words", "new dampers")
    run(path, "list")
    said = capsys.readouterr().out
    assert said.startswith("bogie 1, left: new dampers at 30 000 km\n")
    assert "| AM96 217  | bogie 1, left" in said
    assert "| 5       | 4               | 10 000 to 50 000" in said
    assert "train 4, car 7, x, leading bogie" in said


@pytest.fixture
def alarmed(path):
    """A store with an alarm that is over, one that is open, and a worse one elsewhere."""
    with History(path) as store:
        over = Alarm("c_p", Cause.LIMIT, Severity.NOTICE, 1e4, 2e4, "below")
        store.keep_alarms(
            "AM96 217",
            PLACE,
            [over, Alarm("k_p", Cause.CHANGE, Severity.NOTICE, 3e4, words="fell")],
        )
        worse = Alarm("k_p", Cause.LIMIT, Severity.ACT, 1e4, words="far below")
        store.keep_alarms("AM96 217", OTHER, [worse])
    return path


def test_no_text_of_others_controls_the_terminal(alarmed, capsys):
    run(alarmed, "acknowledge", *WHERE, "--parameter", "k_p", "--by", "Eve\x1b[2J")
    run(alarmed, "alarms")
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "Eve\\x1b[2J" in said


def test_alarms_are_listed_worst_first_with_who_has_seen_them(alarmed, capsys):
    seen = ("acknowledge", *WHERE, "--parameter", "k_p", "--by", "Kim", "--words", "ordered")
    run(alarmed, *seen, "--cause", "change")
    assert capsys.readouterr().out == (
        "bogie 1, left: k_p (change, notice) acknowledged by Kim at 50 000 km\n"
    )
    run(alarmed, "alarms")
    _, _, *rows = capsys.readouterr().out.splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [row[0] for row in cells] == ["act", "notice"]
    assert cells[0][2:7] == [str(OTHER), "k_p", "limit", "10 000", "far below"]
    assert cells[0][7] == ""
    assert cells[1][5:7] == ["30 000", "fell"]
    assert cells[1][7].startswith("Kim, 20")
    assert cells[1][7].endswith(": ordered")
    run(alarmed, "alarms", "--all")
    assert "| 10 000 to 20 000 | below" in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (["--parameter", "c_p"], "bogie 1, left has no open alarm of c_p; suspnet history"),
        (["--parameter", "k_p", "--cause", "limit"], "open alarm of k_p with cause limit"),
    ],
)
def test_an_alarm_that_is_not_open_cannot_be_acknowledged(chosen, message, alarmed):
    with pytest.raises(HistoryError, match=message):
        run(alarmed, "acknowledge", *WHERE, *chosen, "--by", "Kim")
    with History(alarmed) as store:
        assert store.all_acknowledgements() == {}


def test_export_writes_all_that_is_kept(alarmed, tmp_path, capsys):
    path = alarmed
    run(path, "event", *WHERE, "--at-km", "30000", "--kind", "reprofiled")
    run(path, "acknowledge", *WHERE, "--parameter", "k_p", "--by", "Kim")
    capsys.readouterr()
    run(path, "export", str(tmp_path / "tables"))
    assert "6 trips, 1 events, 3 alarms and 1 acknowledgements -> " in capsys.readouterr().out
    trips = pq.read_table(tmp_path / "tables" / "trips.parquet").to_pylist()
    with History(path) as store:
        expected = [r.estimates.get("k_p") for r in store.read("AM96 217", PLACE)]
    found = [row["k_p"] for row in trips if row["suspension"] == PLACE.suspension]
    assert [v if v == v else None for v in found] == expected
    assert {row["train"] for row in trips} == {"", "4"}
    (event,) = pq.read_table(tmp_path / "tables" / "events.parquet").to_pylist()
    assert (event["kind"], event["mileage_km"]) == ("reprofiled", 30_000.0)
    alarms = pq.read_table(tmp_path / "tables" / "alarms.parquet").to_pylist()
    assert [row["severity"] for row in alarms] == ["notice", "notice", "act"]
    (seen,) = pq.read_table(tmp_path / "tables" / "acknowledgements.parquet").to_pylist()
    assert (seen["by"], seen["cause"], seen["at_km"]) == ("Kim", "change", 50_000.0)


def test_maintenance_of_an_unknown_suspension_is_refused(path):
    with pytest.raises(HistoryError, match="no trip of am96: y is stored here; known: AM96 217"):
        run(path, "event", "--vehicle", "am96", "--suspension", "y", "--at-km", "1")
