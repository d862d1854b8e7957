"""Ablations: what differs from the baseline, in which order, and what a small multirun writes."""

import csv
import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from cli_runner import ROOT, command, run_main
from hydra import compose, initialize_config_dir
from hydra.types import RunMode
from matplotlib.backends.backend_agg import FigureCanvasAgg
from omegaconf import OmegaConf

from suspnet.cli import train
from suspnet.estimation.feature_information import feature_loss
from suspnet.runs import ablation as study
from suspnet.runs.ablation import (
    BASELINE,
    ablation_caption,
    ablation_markdown,
    ablation_records,
    changes,
)
from suspnet.runs.sweeps import Ablation
from suspnet.runs.tables import records_csv

CONFIGS = ROOT / "configs"
NAMES = list(OmegaConf.load(CONFIGS / "ablations.yaml"))
SMALL = ["data.n_train=150", "data.n_test=40", "data.step_hz=0.1", "data.cache_dir=null"]
SMALL += ["progress=false"]
N_VEHICLES = 6
BASE = {
    "seed": 0,
    "ablation_name": BASELINE,
    "data": {"n_train": 20_000, "snr_db": 34.0},
    "protocol": {"feature_set": "peaks", "features": {"window": 1.0}, "curve": {}},
    "model": {"C": 1e4, "feature_map": "rff", "n_components": 1024},
}


def composed(*overrides, hydra=False):
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        return compose("train", overrides=list(overrides), return_hydra_config=hydra)


def config(name, part=None, **changed):
    """Return the configuration of an ablation that changes settings of one part."""
    copy = json.loads(json.dumps(BASE)) | {"ablation_name": name}
    if part is not None:
        copy[part] |= changed
    return copy


def run(name, ratios, part=None, group="primary", seed=0, features=None, **changed):
    """Return what the study knows of one run; `ratios` are those of k_p and c_p to the bound."""
    outputs = dict(zip(("k_p", "c_p"), ratios, strict=True))
    return {
        "protocol": "multi_location",
        "group": group,
        "ablation": name,
        "config": config(name, part, **changed),
        "rms_ratio": outputs,
        "features_ratio": features or dict.fromkeys(outputs, 1.25),
        "scores": {key: {"mape_percent": ratio / 8, "rmse": 0.1} for key, ratio in outputs.items()},
        "bound": {key: {"mape_percent": 0.125, "rmse": 0.05} for key in outputs},
        "n_test": 400,
        "n_test_complete": 390,
        "n_train": changed.get("n_train", 20_000),
        "snr_db": changed.get("snr_db", 34.0),
        "seed": seed,
        "seconds": 1.5,
    }


@pytest.fixture
def runs():
    """One group, in another order than the table's."""
    return [
        run("wide", (1.5, 1.0), "protocol", features={"window": 1.4}),
        run("n10000", (1.2, 1.0), "data", n_train=10_000),
        run("C_1e6", (1.0, 0.5), "model", C=1e6),
        run(BASELINE, (2.0, 1.0)),
        run("n5000", (3.0, 1.5), "data", n_train=5000),
        run("C_100", (4.0, 2.5), "model", C=100.0),
    ]


# reference


def test_changes_are_what_a_user_would_override():
    changed = config("curve", "protocol", feature_set="curve", curve={"n_components": 9})
    changed["model"]["C"] = 100.0
    # what is gone is not told, settings come in a fixed order, the ablation's name does not count
    assert changes(changed, BASE) == {
        "protocol.curve.n_components": 9,
        "protocol.feature_set": "curve",
        "model.C": 100.0,
    }
    assert list(changes(changed, BASE))[-1] == "model.C"
    assert changes(config("other"), BASE) == {}


def test_records_compare_with_the_baseline_of_their_setting(runs):
    other = [
        run(BASELINE, (10.0, 5.0), group="secondary"),
        run("C_100", (1.0, 1.0), "model", group="secondary", C=100.0),
        run("C_100", (1.0, 1.0), "model", seed=1, C=100.0),  # its seed has no baseline
    ]
    records = ablation_records(runs + other)
    found = {(r["group"], r["seed"], r["ablation"], r["output"]): r for r in records}
    assert len(found) == len(records) == 2 * 9
    assert found["primary", 0, "C_100", "k_p"]["to_baseline"] == 2.0
    assert found["primary", 0, "C_1e6", "c_p"]["to_baseline"] == 0.5
    assert found["secondary", 0, "C_100", "k_p"]["to_baseline"] == 0.1
    assert found["primary", 0, BASELINE, "c_p"]["to_baseline"] == 1.0
    alone = found["primary", 1, "C_100", "k_p"]
    assert (alone["to_baseline"], alone["change"]) == (None, None)
    assert found["primary", 0, "C_100", "k_p"] == {
        "protocol": "multi_location",
        "group": "primary",
        "ablation": "C_100",
        "change": "model.C=100",
        "output": "k_p",
        "rms_ratio": 4.0,
        "to_baseline": 2.0,
        "features_ratio": 1.25,
        "mape_percent": 0.5,
        "bound": 0.125,
        "lost_percent": pytest.approx(2.5),
        "n_train": 20_000,
        "snr_db": 34.0,
        "seed": 0,
        "seconds": 1.5,
    }


def test_baseline_comes_first_and_values_of_a_setting_lie_together(runs):
    records = ablation_records(runs)
    assert [r["ablation"] for r in records[::2]] == [
        BASELINE,
        "wide",
        "n5000",
        "n10000",
        "C_100",
        "C_1e6",
    ]
    assert [r["output"] for r in records] == ["k_p", "c_p"] * 6
    assert ablation_records(runs[::-1]) == records
    nothing = run("a", (1.0, 1.0))
    assert [r["ablation"] for r in ablation_records([nothing, *runs])][:4:2] == [BASELINE, "a"]


def cells(markdown):
    """Return the rows of a Markdown table, header first."""
    lines = [line for line in markdown.splitlines() if not set(line) <= set("|-: ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_table_holds_every_ablation_and_averages_seeds(runs):
    again = run(BASELINE, (3.0, 1.0), seed=1)
    records = ablation_records([*runs, again])
    header, *rows = cells(ablation_markdown(records))
    each = ["x", "features", "MAPE %"]
    assert header == ["ablation", "k_p", *each, "c_p", *each, "lost %", "seconds", "change"]
    by_name = {row[0]: row[1:] for row in rows}
    assert len(by_name) == len(rows) == 6
    assert by_name[BASELINE][:4] == ["2.50", "1.00", "1.25", "0.312"]
    assert by_name[BASELINE][-3:] == ["2.50", "1.50", ""]
    assert by_name["C_100"][:4] == ["4.00", "2.00", "1.25", "0.5"]
    assert by_name["C_100"][4:] == ["2.50", "2.50", "1.25", "0.312", "2.50", "1.50", "model.C=100"]
    assert "20000 training curves, 34 dB and seed 0, 1 unless" in ablation_caption(records)


def test_table_and_csv_mark_what_is_not_known():
    unknown = run("C_100", (math.inf, 1.0), "model", C=100.0, features={"k_p": None, "c_p": 1.0})
    records = ablation_records([unknown])
    _, row = cells(ablation_markdown(records))
    outputs = ["-", "-", "-", "-", "1.00", "-", "1.00", "0.125"]
    assert row == ["C_100", *outputs, "2.50", "1.50", "-"]
    found = list(csv.DictReader(io.StringIO(records_csv(records))))
    assert [r["features_ratio"] for r in found] == ["", "1.0"]


# the configurations


def test_experiment_sweeps_every_ablation():
    hydra = composed("experiment=ablation", hydra=True).hydra
    assert hydra.mode == RunMode.MULTIRUN
    assert hydra.sweeper.params == {"group": "primary,secondary", "ablation": "glob(*)"}
    assert BASELINE in NAMES


@pytest.mark.parametrize(
    "names",
    [
        [BASELINE, "C_100", "curve_6", "nystroem_512"],
        pytest.param(NAMES, marks=pytest.mark.slow),
    ],
    ids=["some", "all"],
)
def test_every_ablation_changes_the_baseline_in_one_place(names):
    plain = OmegaConf.to_container(composed("ablation=baseline", "ablation_name=x"), resolve=True)
    model = plain["model"]
    assert (model["C"], model["sigma"], model["epsilon"]) == (1e4, 3.0, 1e-6)
    assert (model["feature_map"], model["n_components"]) == ("rff", 1024)
    assert plain["data"]["n_train"] == 20_000
    told = []
    for name in names:
        one = composed("protocol=multi_location", f"ablation={name}", "ablation_name=x")
        other = OmegaConf.to_container(one, resolve=True)
        changed = changes(other, plain)
        told.append(str(changed))
        assert bool(changed) != (name == BASELINE)
        whole_curve = {"protocol.curve.n_components", "protocol.feature_set", "model.sigma"}
        landmarks = {"model.feature_map", "model.n_components"}
        assert len(changed) <= 1 or set(changed) in (whole_curve, landmarks)
    assert len(set(told)) == len(names)


def test_command_line_beats_ablation_and_ablation_beats_experiment():
    both = composed("experiment=ablation", "ablation=noise_54_db", "data.n_test=77")
    assert (both.data.snr_db, both.data.n_test, both.data.n_calibrate) == (54.0, 77, None)
    assert both.figures is False
    assert composed("experiment=sensitivity", "ablation=curves_5000").data.n_train == 5000
    assert composed("ablation=C_100", "model.C=7").model.C == 7
    assert composed().figures is True


# a small multirun


@pytest.fixture(scope="module")
def multirun(tmp_path_factory):
    """Three jobs as the experiment starts them, summarised; the folder and the metrics of each."""
    folder = tmp_path_factory.mktemp("multirun")
    jobs = [[BASELINE], ["C_100"], ["curve_6", "protocol.curve.n_components=7"]]
    metrics = [
        run_main(
            train, folder / job[0], "experiment=ablation", f"ablation={job[0]}", *job[1:], *SMALL
        )
        for job in jobs
    ]
    callback = composed("experiment=ablation", f"hydra.sweep.dir={folder}", hydra=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "N_VEHICLES", N_VEHICLES)
        Ablation().on_multirun_end(callback)
    return folder, metrics


def test_runs_say_which_ablation_they_are_and_draw_nothing(multirun):
    folder, metrics = multirun
    assert [m["ablation"] for m in metrics] == [BASELINE, "C_100", "curve_6"]
    stored = yaml.safe_load((folder / "C_100" / "config.yaml").read_text())
    assert stored["ablation_name"] == "C_100"
    assert stored["model"]["C"] == 100.0
    assert not list(folder.glob("*/figures"))


def test_multirun_is_summarised(multirun):
    folder, metrics = multirun
    names = {file.name for file in folder.iterdir() if file.is_file()}
    assert {"ablation.md", "ablation.csv", "ablation.json", "ablation.png"} < names
    assert any(name.startswith("events.out.tfevents") for name in names)
    assert (folder / "ablation.png").read_bytes()[1:4] == b"PNG"
    records = json.loads((folder / "ablation.json").read_text())
    assert [(r["ablation"], r["output"]) for r in records] == [
        (name, output) for name in (BASELINE, "curve_6", "C_100") for output in ("k_p", "c_p")
    ]
    assert records[2]["change"].split() == [
        "protocol.curve.n_components=7",
        "protocol.feature_set=curve",
        "model.sigma=8",
    ]
    assert records[1]["rms_ratio"] == metrics[0]["rms_ratio"]["c_p"]
    _, *rows = cells((folder / "ablation.md").read_text().split("\n\n")[1])
    assert [row[0] for row in rows] == [BASELINE, "curve_6", "C_100"]
    assert float(rows[2][1]) == pytest.approx(metrics[1]["rms_ratio"]["k_p"], rel=6e-3)


def test_bounds_of_features_belong_to_the_features_of_the_run(multirun):
    folder, _ = multirun
    records = json.loads((folder / "ablation.json").read_text())
    peaks, curve, peaks_again = (
        {r["output"]: r["features_ratio"] for r in records if r["ablation"] == name}
        for name in (BASELINE, "curve_6", "C_100")
    )
    assert peaks == peaks_again
    assert curve["c_p"] > peaks["c_p"] > 1
    model = study.load_model(folder / "curve_6")
    assert len(model.task.extractor.names) == 7
    ratios = model.task.sample(N_VEHICLES, 0, 1)
    observer = model.settings.observer(model.generator)
    assert curve == pytest.approx(feature_loss(model.task, observer, ratios), rel=1e-12)


def test_same_features_are_judged_once(multirun, monkeypatch):
    folder, _ = multirun
    monkeypatch.setattr(study, "N_VEHICLES", 4)
    known = {}
    models = [study.load_model(folder / name) for name in (BASELINE, "C_100", "curve_6")]
    peaks, curve = (study.features_ratio(models[k], known) for k in (0, 2))
    assert len(known) == 2
    with monkeypatch.context() as patch:
        patch.delattr(study, "feature_loss")
        assert study.features_ratio(models[1], known) == peaks
    # another basis is another feature set, though its settings are the same
    arrays = models[2].task.extractor.state()
    turned = arrays | {"directions": np.roll(arrays["directions"], 40, axis=1)}
    task = replace(models[2].task, extractor=models[2].task.extractor.restored(turned))
    assert study.features_ratio(replace(models[2], task=task), known) != curve
    assert len(known) == 3


@pytest.mark.slow
def test_ablations_are_chosen_on_the_command_line(tmp_path):
    overrides = ["experiment=ablation", "group=secondary", "ablation=rff_256,baseline", *SMALL]
    done = command("train.py", *overrides, f"hydra.sweep.dir={tmp_path}", "threads=1")
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "ablation.md").read_text()
    assert table in done.stdout
    assert [row[0] for row in cells(table.split("\n\n")[1])] == ["ablation", BASELINE, "rff_256"]
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {
        "0_multi_location_secondary_rff_256",
        "1_multi_location_secondary_baseline",
    }


def test_folder_without_runs_is_left_alone(tmp_path):
    assert study.write_ablation(tmp_path) == []
    assert not list(tmp_path.iterdir())


# the figure


def test_figure_shows_estimates_and_bounds_of_every_ablation(runs):
    runs[0]["features_ratio"] = {"k_p": None, "c_p": math.inf}
    records = ablation_records([*runs, run("C_100", (2.0, 2.0), "model", group="secondary", C=100)])
    figure = study.figure(records)
    assert len(figure.axes) == 2
    left, right = figure.axes
    names = [label.get_text() for label in left.get_yticklabels()]
    assert names == ["baseline", "wide", "n5000", "n10000", "C 100", "C 1e6"]
    by_label = {line.get_label(): line for line in left.lines}
    estimates = by_label["estimate"].get_xydata()
    assert sorted(map(tuple, estimates)) == sorted(
        [(2.0, 0), (1.5, 1), (3.0, 2), (1.2, 3), (4.0, 4), (1.0, 5), (2.0, 4)]
    )
    assert set(by_label["bound of the curves"].get_xdata()) == {1}
    assert set(by_label["baseline"].get_xdata()) == {2.0}
    for axis in (left, right):
        bounds = next(line for line in axis.lines if line.get_label() == "bound of the features")
        assert np.isfinite(bounds.get_xydata()).all()
        assert len(bounds.get_xydata()) == 6
    FigureCanvasAgg(figure).draw()


def test_names_need_no_quotes():
    assert all(name.replace("_", "").replace(".", "").replace("-", "").isalnum() for name in NAMES)


def test_ablation_of_one_s_own_is_a_file(tmp_path):
    (tmp_path / "ablation").mkdir()
    file = tmp_path / "ablation" / "mine.yaml"
    file.write_text("# @package _global_\ndefaults: [baseline]\nmodel: {C: 7.0}\n")
    mine = composed(f"hydra.searchpath=[file://{tmp_path}]", "ablation=mine")
    assert (mine.model.C, mine.model.sigma) == (7.0, 3.0)
