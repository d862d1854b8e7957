"""Runs get folders of their own; a multirun goes on where it stopped; one failed job is one row."""

import csv
import os
import re
import signal

import pytest
from cli_runner import SMALL, typed
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import open_dict, read_write
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from suspnet.cli import evaluate, folders, simulate, train
from suspnet.cli.program import CONFIGS
from suspnet.ground import own_files
from suspnet.ground.storage import read_json

pytestmark = pytest.mark.usefixtures("blank")
EVENTS = "events.out.tfevents.*"
LINEAR = ["model=linear", "data.n_calibrate=null", *(o for o in SMALL if "calibrate" not in o)]


def metrics(job):
    """Return what a run is measured to be, without the time that it took."""
    found = read_json(job / "metrics.json")
    return {key: value for key, value in found.items() if key not in ("seconds", "training")}


def jobs(sweep):
    return sorted(path.name for path in sweep.iterdir() if path.is_dir())


def only(folder):
    (found,) = folder.iterdir()
    return found


# folders


@pytest.mark.parametrize("kind", ["run", "sweep"])
def test_folder_is_reserved_unless_the_command_line_names_it(tmp_path, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)
    start = {"run": "on_run_start", "sweep": "on_multirun_start"}[kind]
    found = []
    for overrides in ([], [], [f"hydra.{kind}.dir=named"], ["resume=named"]):
        with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
            config = compose("train", overrides=overrides, return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        if not overrides:
            with read_write(config.hydra), open_dict(config.hydra):
                config.hydra[kind].dir = "outputs/it's noon"
        getattr(folders.OwnFolder(), start)(config)
        found.append(config.hydra[kind].dir)
        told = [o for o in config.hydra.overrides.hydra if "it\\'s noon" in o]
        assert len(told) == (kind == "sweep" and not overrides)
    assert found == ["outputs/it's noon", "outputs/it's noon_2", "named", "named"]
    ours = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert ours == {own_files.MARKER}


# multiruns


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """Return a sweep of three jobs, one of which failed, one a fault and one unfinished."""
    folder = tmp_path_factory.mktemp("sweep")
    run = train.train

    def faulty(problem, *arguments, **options):
        if problem.seed == 2:
            raise KeyError("a fault")
        return run(problem, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "train", faulty)
        ended = typed(train, "-m", "seed=3,-1,2,1", *LINEAR, cwd=folder)
    return only(folder / "outputs" / "train"), ended


def test_failed_job_stops_no_other_and_the_table_is_sorted(interrupted):
    sweep, ended = interrupted
    assert ended.returncode == 1
    lines = ended.stderr.splitlines()
    assert [line for line in lines if line.startswith("0: fit ")]  # how far each job is
    first, second, last = [line for line in lines if not re.match(r"\d: ", line)]
    assert first == "error: `seed` must be a whole number >= 0, got -1"
    assert second.startswith("error: KeyError: 'a fault'; see ")
    assert last.startswith("error: 2 jobs failed (1_")
    assert f"resume=outputs/train/{sweep.name} runs these again" in last
    rows = list(csv.DictReader((sweep / "jobs.csv").read_text().splitlines()))
    assert [row["state"] for row in rows] == ["finished", "finished", "failed", "failed"]
    assert float(rows[0]["mean"]) < float(rows[1]["mean"])
    assert "-> outputs/train" in ended.stdout
    assert "rms error in %, least mean first" in ended.stdout
    errors = {path.parent.name[0]: path.read_text() for path in sweep.glob("*/error.txt")}
    assert errors.keys() == {"1", "2"}
    assert "Traceback" in errors["2"]
    assert errors["1"] == f"{first}\n"


def test_multirun_goes_on_and_ends_as_if_uninterrupted(interrupted, tmp_path):
    sweep, _ = interrupted
    begun = {path: path.stat().st_mtime_ns for path in sweep.glob("*/metrics.json")}
    assert len(begun) == 2
    (unfinished,) = sweep.glob("0_*")  # as if killed before the end
    kept = {path: time for path, time in begun.items() if path.parent != unfinished}
    (unfinished / "metrics.json").unlink()
    (begun_event,) = unfinished.glob(EVENTS)
    (unfinished / ".model.json.0123abcd").write_text("{")  # half of it
    seeds = "seed=3,2,1"  # one is left out, so that the number of the last job changes
    cwd = sweep.parents[2]
    ended = typed(train, "-m", seeds, *LINEAR, f"resume={sweep}", "threads=1", cwd=cwd)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("finished before: ") == 1
    assert typed(train, "-m", "seed=3", *LINEAR, cwd=tmp_path).returncode == 0
    whole = only(tmp_path / "outputs" / "train")

    def results(folder):
        return {job["seed"]: job for job in map(metrics, (p.parent for p in finished(folder)))}

    def finished(folder):
        return sorted(folder.glob("*/metrics.json"))

    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert results(sweep).keys() == {1, 2, 3}
    assert results(sweep)[3] == results(whole)[3]
    assert len(finished(sweep)) == 3
    assert (unfinished / ".model.json.0123abcd").read_text() == "{"
    assert not list(sweep.glob("*/error.txt"))
    assert begun_event.exists()
    for path in finished(sweep):  # TensorBoard shows each number once
        shown = EventAccumulator(str(path.parent)).Reload()
        assert {len(shown.Scalars(tag)) for tag in shown.Tags()["scalars"] if "final" in tag} == {1}
    again = typed(train, "-m", "seed=3,1", *LINEAR, f"hydra.sweep.dir={sweep}", cwd=cwd)
    assert again.stdout.count("finished before: ") == 2
    assert again.returncode == 0


# signals

GO_ON = "go on with the same command and resume=outputs/"


@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
@pytest.mark.parametrize(
    ("module", "step", "arguments", "hint"),
    [
        pytest.param(*(train, "train", LINEAR, "start again at any time"), marks=pytest.mark.slow),
        (train, "train", ["-m", "seed=0,1", *LINEAR], GO_ON),
        (simulate, "write_fleet", ["out=trips"], "start again at any time"),
        pytest.param(
            *(evaluate, "named_runs", ["run=x", "trips=y"], GO_ON), marks=pytest.mark.slow
        ),
    ],
)
def test_sigterm_ends_a_program_with_one_line(tmp_path, monkeypatch, module, step, arguments, hint):
    before = signal.getsignal(signal.SIGTERM)

    def killed(*_, **__):
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("unreachable")

    monkeypatch.setattr(module, step, killed)
    ended = typed(module, *arguments, cwd=tmp_path)
    assert ended.returncode == 143
    assert ended.stderr.startswith(f"terminated: nothing was half-written; {hint}")
    assert ended.stderr.count("\n") == 1
    assert signal.getsignal(signal.SIGTERM) is before
