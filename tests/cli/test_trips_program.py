"""Fleets simulated, models trained and trips read from the command line, at small size."""

import json
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from cli_runner import blank_figures, command, python, run_program, typed
from hydra import compose, initialize_config_dir
from trip_fixtures import RATES_HZ, changed, model_at, signal
from trip_records import HALF_WIDTHS
from trip_records import trip as record

from suspnet.cli import evaluate, folders, simulate, train
from suspnet.cli.kinds import build
from suspnet.cli.program import CONFIGS
from suspnet.estimation.checkpoint import save_model
from suspnet.ground.parameters import Severity
from suspnet.trains.jobs import fleet
from suspnet.trains.pages import output
from suspnet.trains.recordings import formats
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.simulation.true_vehicle import scattered, true_numbers

RATES = [f"fleet.sensors.{n}.rate_hz={r:g}" for n, r in zip(CHANNELS, RATES_HZ, strict=True)]
SHORT = ["fleet.minutes=5", "progress=false", "workers=1", *RATES]
SIMULATE = [*SHORT, "generator=best", "scatter=0"]
"""The vehicle of the file itself, which a model reads that has not been commissioned."""
TRAIN = [
    *("experiment=trips", "data.n_train=400", "data.n_test=60", "data.minutes=5"),
    "data.n_calibrate=100",
    *("data.rates_hz=[400,250,250]", "progress=false", "threads=1"),
    *("model.feature_map=nystroem", "model.n_components=512"),
]
EVALUATE = ["progress=false", "monitor.workers=1"]
SOME_WITHOUT_ESTIMATE = 2


def metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the run of a model that reads trips."""
    folder = tmp_path_factory.mktemp("run")
    save_model(folder, model_at())
    return folder


@pytest.fixture(scope="module")
def trips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trips") / "worn"
    out = f"out={folder}"
    assert run_program(simulate, folder.parent / "log", *SIMULATE, out, "fleet.n_trips=3") == 0
    return folder


@contextmanager
def undrawn():
    """Draw no figures and write no report, which takes longest; those of `evaluated` are."""
    write = output.write_pages
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fleet, "write_pages", lambda *to, draw: write(*to, draw=False))
        patch.setattr(output, "write_report", lambda *_: None)
        yield


@pytest.fixture
def no_figures():
    with undrawn():
        yield


# the way from nothing to a report


@pytest.fixture(scope="module")
def evaluated(run, trips, tmp_path_factory, _parquet_read_in_this_process):
    """Return the folder of an evaluation that reads each file in a process, as users do."""
    folder = tmp_path_factory.mktemp("evaluated")
    with pytest.MonkeyPatch.context() as patch, blank_figures():
        patch.setitem(formats.READERS, ".parquet", _parquet_read_in_this_process)
        assert run_program(evaluate, folder, f"run={run}", f"trips={trips}", *EVALUATE) == 0
    return folder


def test_simulated_trips_are_read(run, trips, evaluated):
    found, test = metrics(evaluated), json.loads((run / "model.json").read_text())["training"]
    assert (found["n_trips"], found["n_estimated"]) == (3, 3)
    for name, error in found["rms_error_percent"].items():
        assert 0 < error < 3 * test["test_rms_percent"][name]
    names = {path.name for path in evaluated.iterdir()}
    assert {
        *("config.yaml", "figures", "metrics.json", "report.html", "responses.parquet"),
        *("trips.csv", "trips.parquet"),
    } <= names
    config = (evaluated / "config.yaml").read_text()
    assert "min_averages: 10.0" in config
    assert f"trips: {trips}" in config


@pytest.mark.parametrize(
    ("severities", "complete", "expected"),
    [
        ([Severity.NONE], True, 0),
        ([Severity.NONE], False, 2),
        ([Severity.NONE, Severity.UNKNOWN], True, 2),
        ([Severity.UNKNOWN, Severity.NOTICE], True, 3),
        ([Severity.ACT, Severity.UNKNOWN], False, 4),
    ],
)
def test_exit_code_is_that_of_the_worst_suspension(severities, complete, expected):
    done = [SimpleNamespace(severity=one, is_complete=complete) for one in severities]
    assert evaluate.exit_code(done) == expected


def test_fleet_unless_told_otherwise_is_a_scattered_vehicle_with_sensors_on_both_sides(tmp_path):
    trips = tmp_path / "trips"
    options = [*SHORT, f"out={trips}", "fleet.n_trips=1", "fleet.minutes=0.5", "seed=2"]
    assert run_program(simulate, tmp_path / "log", *options) == 0
    assert sorted(path.name for path in trips.iterdir()) == [
        "trip_001",
        "trip_001.yaml",
        "truth.json",
    ]
    columns = [
        pq.read_table(trips / "trip_001" / f"{name}.parquet").column_names for name in CHANNELS
    ]
    assert columns == 3 * [["left", "right"]]
    truth = json.loads((trips / "truth.json").read_text())
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        generator = build(compose("simulate"), "generator")
    assert truth["parts"] == list(generator.parts)
    assert len(truth["parts"]) == 6
    assert truth["numbers"] == true_numbers(scattered(generator, 1.0, 2))
    assert all(one["ratio"] != 1 for name, one in truth["numbers"].items() if name != "bogie_mass")


@pytest.mark.slow
def test_whole_way_as_a_user_with_two_workers_and_dask(tmp_path):
    pytest.importorskip("distributed")
    files = {"trips": "out=trips", "run": "hydra.run.dir=run"}
    made = [
        python(
            "-m", "suspnet", "simulate", files["trips"], *SIMULATE, "fleet.n_trips=3", cwd=tmp_path
        ),
        command("train.py", files["run"], *TRAIN, cwd=tmp_path),
    ]
    assert [ended.returncode for ended in made] == [0, 0], made
    program = ["evaluate.py", "run=run", "trips=trips", "progress=false"]
    found = []
    for name, options in (("one", ["monitor.workers=1"]), ("two", ["monitor.workers=2"])):
        ended = command(*program, f"hydra.run.dir={name}", *options, cwd=tmp_path)
        assert ended.returncode == 0, ended.stderr
        table = pq.read_table(tmp_path / name / "trips.parquet").to_pydict()
        found.append([table[key] for key in ("k_p", "c_p", "k_s", "c_s", "M_s")])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)
    (tmp_path / "trips" / "trip_002" / "body.parquet").unlink()
    ended = command(*program, "hydra.run.dir=bad", "monitor.workers=2", cwd=tmp_path)
    assert ended.returncode == SOME_WITHOUT_ESTIMATE
    assert "2 of 3 trips have an estimate" in ended.stdout


# alarms and exit codes


def as_alarming(file, *_):
    """Read no recording: the folder's name says how stiff k_s is in all its trips, in %."""
    made_up = record(0, with_curves=False, half_widths=HALF_WIDTHS, manifest=str(file.path))
    k_s = float(file.path.parent.name) / 100
    return replace(made_up, estimates=made_up.estimates | {"k_s": k_s})


@pytest.fixture
def fleets(no_figures, monkeypatch, tmp_path):
    """Return a folder of three folders of a trip: healthy, to be looked at and to act on."""
    monkeypatch.setattr(fleet, "evaluate_trip", as_alarming)
    for name in ("100", "115", "150"):
        (tmp_path / "fleets" / name).mkdir(parents=True)
        (tmp_path / "fleets" / name / "trip.yaml").write_text(f"suspension: car {name}")
    return tmp_path / "fleets"


@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in (
                (
                    "100",
                    evaluate.FINE,
                    "No parameter is beyond its limits; there are too few trips",
                ),
                ("150", evaluate.ACT, "Act: 1 of 4 parameters is beyond the act limit:"),
            )
        ),
        ("115", evaluate.NOTICE, "Notice: 1 of 4 parameters is to be looked at:"),
        (".", evaluate.ACT, "3 suspensions: 1 to act on, 1 to be looked at, 1 without alarm."),
    ],
)
def test_verdict_is_printed_and_an_alarm_has_an_exit_code(
    run, fleets, tmp_path, caplog, name, code, words
):
    with caplog.at_level("INFO", logger="suspnet"):
        ended = run_program(
            evaluate, tmp_path / "out", f"run={run}", f"trips={fleets / name}", *EVALUATE
        )
    assert ended == code
    assert words in caplog.text


def test_limits_are_set_from_the_command_line(run, fleets, tmp_path):
    given = [f"run={run}", f"trips={fleets / '150'}", *EVALUATE]
    wide = "monitor.limits.k_s.act=[0.4,1.6]"
    assert run_program(evaluate, tmp_path / "a", *given, wide) == evaluate.NOTICE
    assert run_program(evaluate, tmp_path / "b", *given, "monitor.limits.k_s=null") == evaluate.FINE
    words = run_program(evaluate, tmp_path / "c", *given, "monitor.limits.k_s.act=[1.2,1.6]")
    assert words.startswith("error: `limits.k_s`: `act[0]` must be a finite number")


def test_wrong_limits_of_a_vehicle_name_file_and_key(tmp_path):
    given = ["experiment=trips", "vehicle.limits.k_s.act=[1.2,1.6]"]
    words = run_program(train, tmp_path / "run", *given)
    assert words.startswith("error: vehicle/am96.yaml: `limits.k_s`: `act[0]` must be a finite")
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.parametrize(
    ("names", "codes", "worst"),
    [
        pytest.param(
            *(("115", "nowhere", "100"), ["3", "1", "0"], folders.MISTAKE),
            marks=pytest.mark.slow,  # the order of codes is that of `evaluate.worst`, below
        ),
        (("nowhere", "150"), ["1", "4"], evaluate.ACT),
    ],
)
def test_multirun_runs_all_jobs_and_ends_with_the_worst_code(
    run, fleets, tmp_path, names, codes, worst
):
    """It ran the first job only and ended with 0."""
    trips = ",".join(str(fleets / name) for name in names)
    folder = tmp_path / "sweep"
    given = [f"hydra.sweep.dir={folder}", *EVALUATE, f"run={run}", f"trips={trips}"]
    ended = typed(evaluate, "-m", *given, cwd=tmp_path)
    assert ended.returncode == worst
    files = sorted(folder.glob("*/exit_code"), key=lambda file: int(file.parent.name.split("_")[0]))
    assert [file.read_text().strip() for file in files] == codes
    assert ended.stderr.count("error: there is no folder") == names.count("nowhere")
    assert "Traceback" not in ended.stderr


def test_worst_code_is_the_most_urgent_one():
    assert [evaluate.worst(codes) for codes in ([], [0, 2], [2, 3], [3, 1], [1, 4], [0, 77])] == [
        *(0, 2, 3, 1, 4, 1)
    ]
    assert set(folders.BY_URGENCY) == {*range(5)}


# bad recordings


def cut(manifest, folder, name, size):
    """Copy a trip, but only the first bytes of the body's file."""
    source = manifest.with_suffix("") / "body.parquet"
    file = folder / f"{name}.parquet"
    file.write_bytes(source.read_bytes()[:size])
    return changed(manifest, folder, name, channels={"body": {"file": str(file)}})


@pytest.fixture(scope="module")
def bad(run, trips, tmp_path_factory):
    """Return the exit code and the rows of a folder of good and of bad trips."""
    folder = tmp_path_factory.mktemp("bad")
    good, other, _ = sorted(trips.glob("*.yaml"))
    body, n = signal(good, "body").astype(float), len(signal(good, "body"))
    at = np.arange(n)
    for name, values in {
        "gap_30_s": np.where((at >= 25_000) & (at < 32_500), np.nan, body),
        "saturation": np.clip(body, -0.5 * body.std(), 0.5 * body.std()),
        "constant": np.full(n, 0.25),
        "ten_seconds": body[:2500],
    }.items():
        changed(good, folder, name, signals={"body": values})
    changed(good, folder, "missing_column", channels={"body": {"column": "a_z"}})
    cut(good, folder, "truncated", 20_000)
    changed(other, folder, "good_2")
    out = tmp_path_factory.mktemp("out")
    with undrawn():
        code = run_program(evaluate, out, f"run={run}", f"trips={folder}", *EVALUATE)
    rows = pq.read_table(out / "trips.parquet").to_pylist()
    assert len(rows) == len(list(folder.glob("*.yaml")))
    return code, {row["trip"]: row for row in rows}


@pytest.fixture(scope="module")
def alone(evaluated):
    """Return the rows of the good trips, evaluated without the bad ones."""
    return pq.read_table(evaluated / "trips.parquet").to_pylist()


def test_bad_trips_end_with_code_2_and_do_no_harm_to_good_ones(bad, alone):
    code, rows = bad
    assert code == SOME_WITHOUT_ESTIMATE
    kept = {key for key in alone[1] if key not in ("trip", "manifest", "seconds")}
    ours, others = ({key: row[key] for key in kept} for row in (rows["good_2"], alone[1]))
    np.testing.assert_equal(ours, others)


def test_harmless_fault_is_told_and_the_estimate_stays(bad, alone):
    row = bad[1]["gap_30_s"]
    assert (row["status"], row["reason"]) == ("ok", "")
    assert row["faults"].startswith("body: gap of 7500 samples (30 s), first at 100.000 s")
    for parameter in ("k_p", "c_p", "k_s", "c_s", "M_s"):
        assert row[parameter] == pytest.approx(alone[0][parameter], rel=0.01)


@pytest.mark.parametrize(
    ("name", "status", "reason"),
    [
        ("saturation", "no estimate", "no segment of 20 s is free of faults: body: saturation of"),
        ("constant", "error", "channel 'body' is constant (0.25) throughout: is the sensor conn"),
        (
            "ten_seconds",
            "error",
            "only 10.0 s are common to all channels; at least 60 s are needed",
        ),
        ("missing_column", "error", "body.parquet has no column 'a_z' of numbers; it has ['accele"),
        ("truncated", "error", "truncated.parquet is damaged, cut off or not a .parquet file"),
    ],
)
def test_bad_recording_is_a_row_with_its_reason(bad, name, status, reason):
    row = bad[1][name]
    assert row["status"] == status
    assert reason in row["reason"]
    assert "\n" not in row["reason"]
    assert np.isnan(row["k_p"])
    assert row["n_averages"] == 0


# mistakes of the user


@pytest.mark.representatives(4)
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["trips={tmp}/nowhere"],
            "there is no folder .*nowhere; give the one that holds the trips",
        ),
        (["trips={tmp}"], r"holds no \*\.yaml file; each trip needs one"),
        (["trips={trips}", "run={tmp}/no"], "run=.*/no does not exist"),
        (
            ["trips={trips}", "monitor.workers=0"],
            "`workers` must be a whole number >= 1 or null, got 0",
        ),
        (
            ["trips={trips}", "monitor.trips.rate_hz=5"],
            r"`trips\.rate_hz` must be a finite number >= 20 and <= ",
        ),
        (["trips={trips}", "+monitor._target_=os.system"], "._target_` is no setting of "),
    ],
)
def test_mistake_with_trips_gets_one_line(run, trips, tmp_path, overrides, message):
    given = [one.format(tmp=tmp_path, trips=trips) for one in overrides]
    if not any(one.startswith("run=") for one in given):
        given.append(f"run={run}")
    words = run_program(evaluate, tmp_path / "out", *EVALUATE, *given)
    with pytest.raises(SystemExit, match=f"^error: .*{message}"):
        raise SystemExit(words)
    assert "\n" not in words
    assert not (tmp_path / "out" / "trips.csv").exists()


@pytest.mark.representatives(6)
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["out={trips}"], "out=.*worn already holds trips; give another folder"),
        (["fleet.n_trips=0"], "`n_trips` must be a whole number >= 1, got 0"),
        (["track=moon"], "track.* must be one of|moon"),
        (["fleet.sensors.body.rate_hz=0"], "`sensor.rate_hz` must be a finite number > 0, got 0"),
        (["scenario.spread=2"], r"`scenario.spread` must be a finite number >= 0 and < 1, got 2"),
        (["scatter=-1"], "`scatter` must be a finite number >= 0 and <= 5, got -1"),
        (["fleet.sides=both"], "`sides`=both needs a vehicle with roll"),
        (["vehicle=sedan", "generator=vertical_vehicle"], "vehicle 'sedan' lacks"),
        (["+fleet._target_=os.system"], "._target_` is no setting of "),
        (["cars=2"], "cars=2 is of a fleet of trains: give trains= too"),
        (["trains=2", "n_wearing=5"], "`n_wearing` must be at most 4 in magnitude, got 5"),
        (["trains=1", "out={trips}"], "out=.*worn already holds trips; give another folder"),
    ],
)
def test_mistake_with_simulate_gets_one_line(trips, tmp_path, overrides, message):
    before = sorted(trips.rglob("*"))
    given = [one.format(trips=trips) for one in overrides]
    out = [] if given[0].startswith("out=") else [f"out={tmp_path / 'new'}"]
    words = run_program(simulate, tmp_path / "log", *SIMULATE, *out, *given)
    with pytest.raises(SystemExit, match=f"^error: .*({message})"):
        raise SystemExit(words)
    assert "\n" not in words
    assert sorted(trips.rglob("*")) == before
    assert not (tmp_path / "new").exists()


def test_trains_are_simulated_and_those_that_wear_are_told(tmp_path, caplog):
    given = ["trains=1", "cars=2", "n_wearing=1", "fleet.minutes=0.1", "fleet.n_trips=2"]
    with caplog.at_level("INFO", logger="suspnet"):
        words = run_program(simulate, tmp_path / "log", *SIMULATE, *given, f"out={tmp_path / 'f'}")
    assert words == 0
    names = [path.name for path in sorted((tmp_path / "f").iterdir()) if path.is_dir()]
    assert names == [f"train_1_car_{i}_{b}" for i in (1, 2) for b in ("leading", "trailing")]
    (wearing,) = json.loads((tmp_path / "f" / "truth.json").read_text())["wearing"]
    words = f"4 suspensions (trains=1, cars=2) of 2 trips each in {tmp_path / 'f'}"
    assert f"{words}\n1 wear, scenario worn_spring: {wearing}" in caplog.text
    learn = f"train healthy={tmp_path / 'f'} n_healthy=2"
    assert "learn the vehicle of each suspension from its first trips: " in caplog.text
    assert learn in caplog.text  # the manifests tell the rest
