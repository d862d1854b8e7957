"""train.py and evaluate.py as a user runs them, at small size."""

import csv
import json
import os
import signal

import pytest
from cli_runner import SMALL, blank_figures, run_main, typed
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from suspnet.cli import evaluate, program, train
from suspnet.curves.problem import Problem
from suspnet.estimation.estimate import KINDS
from suspnet.runs.dataset import read_dataset

pytestmark = pytest.mark.usefixtures("blank")
"""Figures are made by the fixture `run` only; tests/runs/test_plots.py draws them."""
UNCALIBRATED = [*SMALL, "data.n_calibrate=null"]
BARE = ["progress=false", "figures=false"]
RECORD = "protocol group output metric model published measured bound n_train snr_db seed seconds"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    with blank_figures(made=True):
        return folder, run_main(train, folder, *SMALL, "figures=true", "threads=1")


def test_run_folder_holds_everything(run):
    folder, metrics = run
    names = {path.name for path in folder.iterdir()}
    assert {
        "config.yaml",
        "environment.json",
        "figures",
        "metrics.json",
        "model.json",
        "model.safetensors",
    } <= names
    figures = {path.stem for path in (folder / "figures").iterdir()}
    assert {"parity_k_p", "parity_c_p", "peaks_primary", "peaks_secondary"} <= figures
    assert metrics["training"]["fitted"]["converged"] is True
    for output in ("k_p", "c_p"):
        assert metrics["bound"][output]["mape_percent"] < metrics["scores"][output]["mape_percent"]
    assert json.loads((folder / "environment.json").read_text())["packages"]["torch"]


def test_fresh_curves_have_like_scores_intervals_and_flags(run, tmp_path):
    folder, metrics = run
    assert metrics["intervals"]["level"] == 0.9
    assert set(metrics["intervals"]["outputs"]) == {"k_p", "c_p"}
    assert "flagged_percent" not in metrics  # training fits no test curve
    fresh = run_main(evaluate, tmp_path, f"run={folder}", "data.n_test=150", *BARE)
    assert (fresh["seed"], fresh["n_test"]) == (1000, 150)
    for output, values in fresh["scores"].items():
        ratio = values["rmse"] / metrics["scores"][output]["rmse"]
        assert 0.5 < ratio < 2  # 300 training curves: the errors' tails vary between test sets
    for scored in (metrics, fresh):
        for values in scored["intervals"]["outputs"].values():
            # at least 33 calibration and 100 test curves: 5 % and 3 %; three of their root sum
            assert values["coverage_percent"] == pytest.approx(90, abs=18)
            assert 0.01 < values["half_width_percent"] < 30
    assert set(fresh["flagged_percent"]) == {*KINDS, "any"}
    assert fresh["flagged_percent"]["any"] < 10


def test_refined_run_reaches_the_bound_and_is_called_so(tmp_path):
    small = [*UNCALIBRATED, "model=linear", "refine=true", "threads=1"]
    metrics = run_main(train, tmp_path / "run", *small)
    assert metrics["model"] == "linear+refine"
    for ratio in metrics["rms_ratio"].values():
        assert ratio == pytest.approx(1, abs=0.28)  # 60 curves: 9 %, three of those
    fresh = run_main(
        evaluate, tmp_path, f"run={tmp_path / 'run'}", "data.n_test=40", *BARE, *small[-1:]
    )
    assert fresh["model"] == "linear+refine"
    assert fresh["scores"]["c_p"]["rmse"] < 1.5 * metrics["scores"]["c_p"]["rmse"]


@pytest.mark.parametrize("solver", ["newton", "irwls"])
def test_tensorboard_shows_the_iterations_of_each_solver_by_name(tmp_path, solver):
    tube = ["model.C=10", "model.epsilon=0.3", "model.feature_map=exact", f"model.solver={solver}"]
    metrics = run_main(train, tmp_path, *UNCALIBRATED, "data.n_train=80", *tube, "figures=false")
    events = EventAccumulator(str(tmp_path)).Reload()
    objective, step, support = (
        [(event.step, event.value) for event in events.Scalars(f"{solver}/{name}")]
        for name in ("objective", "step", "support")
    )
    fitted = metrics["training"]["fitted"]
    assert [place for place, _ in objective] == list(range(1, fitted["n_iter"] + 1))
    assert [value for _, value in objective] == sorted((v for _, v in objective), reverse=True)
    assert objective[-1][1] == pytest.approx(fitted["objective"])
    assert all(0 < value <= 1 for _, value in step)
    n_outside = fitted["support_fraction"] * metrics["training"]["n_train_complete"]
    assert support[-1][1] == pytest.approx(n_outside)
    assert 0 < support[-1][1] < 80


def test_tensorboard_holds_figures_and_hyperparameters(run):
    folder, metrics = run
    events = EventAccumulator(str(folder)).Reload()
    tags = events.Tags()
    assert {"training/peaks_primary", "estimates/parity_k_p"} <= set(tags["images"])
    assert {"settings/text_summary", "scores/text_summary"} <= set(tags["tensors"])
    table = events.Tensors("scores/text_summary")[0].tensor_proto.string_val[0].decode()
    assert table.startswith("| output")
    errors = events.Scalars("error_by_n/k_p")
    assert [event.step for event in errors] == sorted({event.step for event in errors})
    assert len(errors) > 1
    assert errors[-1].step == metrics["training"]["n_train_complete"]
    assert errors[-1].value == pytest.approx(metrics["rms_percent"]["k_p"], rel=1e-6)
    assert "custom_scalars__config__" in tags["tensors"]
    plugin = events.summary_metadata["_hparams_/session_start_info"].plugin_data
    assert plugin.plugin_name == "hparams"
    assert b"sigma" in plugin.content
    assert events.Scalars("final/mape_percent_k_p")[0].value == pytest.approx(
        metrics["scores"]["k_p"]["mape_percent"], rel=1e-6
    )


def test_same_seed_same_numbers_other_seed_other_numbers(run, tmp_path):
    _, metrics = run
    again = run_main(train, tmp_path / "a", *UNCALIBRATED, "threads=1")
    other = run_main(train, tmp_path / "b", *UNCALIBRATED, "threads=1", "seed=1")
    assert again["scores"] == metrics["scores"]
    assert other["scores"] != metrics["scores"]


def test_a_run_writes_its_data_set_where_it_is_asked_for(tmp_path):
    given = [*SMALL, "model=linear", "dataset=npz"]
    metrics = run_main(train, tmp_path / "run", *given)
    data = read_dataset(tmp_path / "run" / "dataset.npz")
    assert data.rows("test").sum() == metrics["n_test"]
    assert data.about["outputs"] == list(metrics["rms_ratio"])


@pytest.mark.representatives(5)
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("vehicle.primary_stiffness_n_per_m=1.3e9", "print kN/m where N/m is meant"),
        ("vehicle.body_mass_kg=-1", "`body_mass_kg` must be a finite number > 0"),
        ("data.snr_db=abc", r"`data.snr_db` must be a finite number .*, got 'abc'"),
        ("group=tertiary", "has no group 'tertiary'; choose from"),
        ("model.C=abc", "`C` must be a finite number > 0, got 'abc'"),
        ("device=cuda:99", "`device`='cuda:99' cannot be used here"),
        ("seed=-1", "`seed` must be a whole number"),
        ("+model._target_=os.system", "._target_` is no setting of "),
    ],
)
def test_mistake_gets_one_line(override, message, tmp_path):
    with pytest.raises(SystemExit, match=f"^error: .*{message}") as caught:
        run_main(train, tmp_path, *SMALL, override)
    assert "\n" not in str(caught.value)


@pytest.mark.representatives(4)
@pytest.mark.parametrize(
    ("program", "overrides", "message"),
    [
        (train, ["protocol=foo"], "Could not find 'protocol/foo'"),
        (
            train,
            ["data.n_trian=1"],
            "There is no such key: did you mean n_train?; --help lists them",
        ),
        (train, ["protocol.feature_settings.n=4"], "no such key: a + before it adds it; --help"),
        (
            evaluate,
            ["run=x", "monitor.reference=first_trips"],  # of earlier versions
            "'monitor.reference'. There is no such key",
        ),
        (train, ["hydra.run.dir={file}/x"], "Not a directory"),
        (evaluate, [], "which run?"),
        (evaluate, ["run=nowhere"], "run=nowhere does not exist"),
        (evaluate, ["experiment=table6"], "python train.py experiment=NAME"),
        (train, ["study=maintenance"], "python evaluate.py study=NAME"),
    ],
)
def test_mistake_on_the_command_line_gets_one_line(program, overrides, message, tmp_path):
    file = tmp_path / "file"
    file.touch()
    words = [one.replace("{file}", str(file)) for one in overrides]
    is_one_line(typed(program, *words, cwd=tmp_path), message)


def is_one_line(ended, message):
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: ")
    assert message in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_traceback_on_request(tmp_path, monkeypatch):
    monkeypatch.setattr(program, "is_debugging", True)
    with pytest.raises(ValueError, match="`seed` must be a whole number >= 0, got -1"):
        typed(train, "seed=-1", *SMALL, cwd=tmp_path)


def test_interrupt_leaves_nothing_half_written_and_a_second_start_works(tmp_path, monkeypatch):
    curves, sent = Problem.curves, []

    def interrupted(*arguments):
        if not sent:  # a second signal, by the next block, could come after the program has ended
            sent.append(signal.SIGINT)
            os.kill(os.getpid(), sent[0])
        return curves(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Problem, "curves", interrupted)
        ended = typed(train, *UNCALIBRATED, "hydra.run.dir=run", cwd=tmp_path)
    is_interrupted(ended.returncode, ended.stderr, tmp_path)
    again = [*UNCALIBRATED, "model=linear", "hydra.run.dir=run"]
    assert typed(train, *again, cwd=tmp_path).returncode == 0
    assert (tmp_path / "run" / "model.json").exists()


def is_interrupted(code, words, folder):
    assert code == 130, words
    assert "Traceback" not in words
    assert "interrupted" in words
    left = {path.name for path in folder.rglob("*") if path.is_file()}
    assert not [name for name in left if name.endswith(".safetensors") or "metrics" in name]


@pytest.fixture(scope="module")
def table6(tmp_path_factory):
    folder = tmp_path_factory.mktemp("table6")
    few = ["data.n_train=300", "data.n_test=100", "data.n_calibrate=null"]
    options = ["experiment=table6", "model=linear,msvr", *few, "progress=false"]
    with blank_figures():
        ended = typed(train, *options, cwd=folder)
    assert ended.returncode == 0, ended.stderr
    (sweep,) = (folder / "outputs" / "table6").iterdir()
    return sweep, ended.stdout


def test_tensorboard_shows_the_comparison_first(table6):
    folder, _ = table6
    events = {
        path.parent: EventAccumulator(str(path.parent)).Reload()
        for path in folder.rglob("events.*")
    }
    images = {path: found.Tags()["images"] for path, found in events.items()}
    assert min(image for found in images.values() for image in found) == "comparison/table6"
    assert images.pop(folder) == ["comparison/table6"]
    assert all(
        any(name.startswith("estimates/parity_") for name in found) for found in images.values()
    )


def test_tensorboard_shows_what_a_multirun_varies(table6):
    folder, _ = table6
    for run in folder.glob("[0-9]_*"):
        summaries = EventAccumulator(str(run)).Reload().summary_metadata
        content = summaries["_hparams_/experiment"].plugin_data.content
        experiment = HParamsPluginData.FromString(content).experiment
        columns = experiment.hparam_infos
        assert {column.name for column in columns if column.differs} == {"group", "model"}
        # the parallel coordinates leave out runs without one of the metrics
        names = [info.name.tag for info in experiment.metric_infos]
        assert names == ["final/rms_percent", "final/seconds"]
        assert set(names) <= set(EventAccumulator(str(run)).Reload().Tags()["scalars"])
        content = summaries["_hparams_/session_start_info"].plugin_data.content
        values = HParamsPluginData.FromString(content).session_start_info.hparams
        group, model = run.name.split("_")[-2:]
        assert (values["group"].string_value, values["model"].string_value) == (group, model)


def test_table6_has_a_record_for_each_output_metric_and_model(table6):
    folder, printed = table6
    records = json.loads((folder / "table6.json").read_text())
    assert all(list(record) == RECORD.split() for record in records)
    keys = {(r["group"], r["output"], r["metric"], r["model"]) for r in records}
    assert len(keys) == len(records) == 4 * 2 * 2
    assert {r["group"] for r in records} == {"primary", "secondary"}
    first = next(r for r in records if r["output"] == "k_s" and r["model"] == "msvr")
    with (folder / "table6.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["measured"]) for row in rows] == [r["measured"] for r in records]
    assert (folder / "table6.md").read_text().startswith("| group ")
    assert (folder / "table6.png").read_bytes().startswith(b"\x89PNG")
    assert first["published"] == 4.37
    assert first["n_train"] == 300
    assert "| MAPE %, ours (the paper's) | k_p " in printed
    table = [line for line in printed.splitlines() if line.startswith("|")]
    assert max(map(len, table)) <= 100
    assert printed.splitlines()[-1].startswith("compare the jobs with: tensorboard --logdir ")


def test_evaluate_takes_a_whole_multirun(table6, tmp_path):
    folder, _ = table6
    options = [f"run={folder}", "data.n_test=60", *BARE, "hydra.run.dir=fresh"]
    ended = typed(evaluate, *options, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    records = json.loads((tmp_path / "fresh" / "table6.json").read_text())
    assert {(r["group"], r["model"], r["seed"]) for r in records} == {
        (group, model, 1000) for group in ("primary", "secondary") for model in ("linear", "msvr")
    }


def test_table5_writes_an_override_file_that_works(tmp_path):
    ended = typed(
        train,
        "experiment=table5",
        "model=msvr",
        "group=primary",
        "model.n_components=64",
        "search.n_folds=2",
        "search.grids.msvr.C=[1.0,100.0]",
        "search.grids.msvr.sigma=[0.01,3.0]",
        "search.grids.msvr.epsilon=[1e-3]",
        *UNCALIBRATED,
        "data.n_train=150",
        "hydra.sweep.dir=sweep",
        cwd=tmp_path,
    )
    assert ended.returncode == 0, ended.stderr
    (record,) = json.loads((tmp_path / "sweep" / "table5.json").read_text())
    assert record["best"] == {"C": 100.0, "epsilon": 1e-3, "sigma": 3.0}
    assert record["n_settings"] == 4
    search = [f"--config-dir={tmp_path / 'sweep'}", "experiment=best", *UNCALIBRATED]
    search.append("model.n_components=64")
    ended = typed(train, *search, "hydra.run.dir=tuned", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    metrics = json.loads((tmp_path / "tuned" / "metrics.json").read_text())
    assert metrics["training"]["parameters"]["C"] == 100.0
