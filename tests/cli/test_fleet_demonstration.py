"""A small fleet from nothing to its alarms: simulated, commissioned and read in processes."""

import json

import pyarrow.parquet as pq
import pytest
from cli_runner import run_program

from suspnet.cli import evaluate, simulate, train
from suspnet.estimation.checkpoint import load_model
from suspnet.runs.evaluate import find_runs
from suspnet.trains.history import History
from suspnet.trains.trips.commissionings import place_of

CHEAP = [
    *("data.segment_s=10", "data.n_train=2000", "data.n_test=100", "data.n_calibrate=100"),
    *("figures=false"),
]


@pytest.mark.slow
def test_fleet_is_simulated_commissioned_and_read(tmp_path):
    trips, models, store = tmp_path / "trips", tmp_path / "models", tmp_path / "fleet.db"
    fleet = ["trains=1", "cars=2", "n_wearing=1", "scenario=damper_fade", f"out={trips}"]
    short = ["fleet.n_trips=6", "fleet.minutes=5", "fleet.rate_hz=500", "progress=false"]
    assert run_program(simulate, tmp_path / "log", *fleet, *short) == 0
    (wearing,) = json.loads((trips / "truth.json").read_text())["wearing"]
    given = ["experiment=trips", f"healthy={trips}", "n_healthy=3", "data.minutes=5", *CHEAP]
    assert run_program(train, models, *given, "progress=false") == 0
    runs = find_runs(models)
    assert [run.name for run in runs] == sorted(path.parent.name for path in trips.glob("*/*.json"))
    given = [f"trips={trips}", f"run={models}", f"store={store}", "progress=false"]
    assert run_program(evaluate, tmp_path / "read", *given) == evaluate.ACT
    rows = pq.read_table(tmp_path / "read" / "overview.parquet").to_pylist()
    assert len(rows) == 4
    assert [row["folder"] for row in rows if row["severity"] in ("notice", "act")] == [wearing]
    with History(store) as history:
        places = {place for _, place in history.places()}
    assert places == {place_of(load_model(run)) for run in runs}
