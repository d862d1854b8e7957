"""suspnet-history lists, adds maintenance and writes tables; mistakes are one line."""

import pyarrow.parquet as pq
import pytest
from trip_records import fleet, trip

from suspnet.cli.history import history, main, parser
from suspnet.history import History, HistoryError
from suspnet.recordings.manifest import Place

PLACE = Place("bogie 1, left")
WHERE = ["--vehicle", "AM96 217", "--suspension", PLACE.suspension]


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "history.db"
    with History(found) as store:
        store.write([*fleet(5, missing=(2,), with_curves=False)])
        store.write([trip(0, with_curves=False, place=Place("x", "leading", train="4", car="7"))])
    return found


def run(path, *arguments):
    history(parser().parse_args([str(path), *arguments]))


def test_list_names_each_suspension_with_trips_and_maintenance(path, capsys):
    run(path, "event", *WHERE, "--at-km", "30000", "--words", "new dampers")
    run(path, "list")
    said = capsys.readouterr().out
    assert said.startswith("bogie 1, left: new dampers at 30 000 km\n")
    assert "| AM96 217  | bogie 1, left" in said
    assert "| 5       | 4               | 10 000 to 50 000" in said
    assert "train 4, car 7, x, leading bogie" in said


def test_export_writes_every_trip_and_event(path, tmp_path, capsys):
    run(path, "event", *WHERE, "--at-km", "30000", "--kind", "reprofiled")
    run(path, "export", str(tmp_path / "tables"))
    assert "6 trips and 1 events" in capsys.readouterr().out
    trips = pq.read_table(tmp_path / "tables" / "trips.parquet").to_pylist()
    with History(path) as store:
        expected = [r.estimates.get("k_p") for r in store.read("AM96 217", PLACE)]
    found = [row["k_p"] for row in trips if row["suspension"] == PLACE.suspension]
    assert [v if v == v else None for v in found] == expected
    assert {row["train"] for row in trips} == {"", "4"}
    (event,) = pq.read_table(tmp_path / "tables" / "events.parquet").to_pylist()
    assert (event["kind"], event["mileage_km"]) == ("reprofiled", 30_000.0)


def test_maintenance_of_an_unknown_suspension_is_refused(path):
    with pytest.raises(HistoryError, match="no trip of am96: y is kept here; known: AM96 217"):
        run(path, "event", "--vehicle", "am96", "--suspension", "y", "--at-km", "1")


def test_a_mistake_is_one_line_and_makes_no_file(tmp_path, monkeypatch, capsys):
    path = tmp_path / "nothing.db"
    monkeypatch.setattr("sys.argv", ["suspnet-history", str(path), "list"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert "there is no such file; evaluate.py" in str(ended.value.code)
    assert not path.exists()
