"""Trips run both ways: simulated, one run of models for each direction, all of them read."""

import json

import pytest
from cli_runner import run_program
from test_trips_program import BAND, EVALUATE, SHORT, TRAIN

from suspnet.cli import evaluate, simulate, train
from suspnet.trains.recordings.manifest_files import read_manifest

QUICK = [*TRAIN, *BAND, "figures=false", "data.n_train=300", "data.n_test=50"]
QUICK += ["data.n_calibrate=null"]


@pytest.fixture(scope="module")
def trips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("both") / "trips"
    plain = [*SHORT, "generator=best", "scatter=0", "fleet.n_trips=2", "fleet.direction=both"]
    assert run_program(simulate, folder.parent / "log", *plain, f"out={folder}") == 0
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    assert run_program(train, folder, *QUICK, "direction=both") == 0
    return folder


@pytest.mark.slow
def test_one_run_has_models_for_both_directions(run):
    rows = json.loads((run / "speeds.json").read_text())
    names = ["64.4_to_75.6_m_per_s", "64.4_to_75.6_m_per_s_reverse"]
    assert [row["folder"] for row in rows] == names
    for name, direction in zip(names, ("forward", "reverse"), strict=True):
        content = json.loads((run / name / "model.json").read_text())
        assert f'"direction": "{direction}"' in json.dumps(content)


@pytest.mark.slow
@pytest.mark.usefixtures("blank")
def test_trips_of_both_directions_are_read(run, trips, tmp_path):
    directions = [read_manifest(path).direction for path in sorted(trips.glob("*.yaml"))]
    assert directions == ["forward", "reverse"]
    assert run_program(evaluate, tmp_path, f"run={run}", f"trips={trips}", *EVALUATE) == 0
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert (found["n_trips"], found["n_estimated"]) == (2, 2)


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["figures=false"], "direction= is for models that read trips and depend on"),
        ([*QUICK, "vehicle=sedan"], "direction= is for models that read trips and depend on"),
        ([*QUICK, "direction=back"], "`direction` must be one of"),
    ],
)
def test_direction_is_refused_where_nothing_depends_on_it(tmp_path, changes, message):
    assert message in run_program(train, tmp_path, "direction=both", *changes)
