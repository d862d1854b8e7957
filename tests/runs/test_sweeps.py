"""What a multirun's summary says about methods that were not tuned or tested on equal terms."""

import csv
import json
import math

import pytest
import yaml
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from test_tables import run

from suspnet.ground.storage import read_json, write_json
from suspnet.runs.sweeps import Jobs, Summary, job_rows, write_table6

EDGE = "the best C, 100, is on the edge: slow"


def ended(callback, folder):
    """Let a multirun in a folder end."""
    callback.on_multirun_end(OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}}}))


def test_note_of_what_is_unequal_ends_the_table(tmp_path):
    write_table6([run("svr", ("k_p",))], tmp_path, "SVR's C is capped.")
    assert (tmp_path / "table6.md").read_text().endswith("s\nSVR's C is capped.\n")


def test_optimum_left_on_an_edge_is_told(tmp_path):
    searched = [
        run(name, ("k_p",))
        | {"group": "primary"}
        | {
            "search": {
                "best": {"C": 100.0, "epsilon": 1e-3},
                "settings": [{"C": C, "epsilon": 1e-3} for C in (10.0, 30.0, 100.0)],
                "rmse": [0.4, math.inf, 0.1],
                "fold_rmse": [[0.3, 0.5, 0.4], [math.inf] * 3, [0.1, 0.2, 0.0]],
                "edges": edges,
            }
        }
        for name, edges in (("svr", {"C": EDGE}), ("msvr", {}))
    ]
    for k, metrics in enumerate(searched):
        write_json(tmp_path / f"{k}" / "metrics.json", metrics)
    ended(Summary("table5"), tmp_path)
    assert f"# primary, svr: {EDGE}\n" in (tmp_path / "experiment" / "best.yaml").read_text()
    records = json.loads((tmp_path / "table5.json").read_text())
    assert [record["edges"] for record in records] == [[EDGE], []]
    written = (tmp_path / "table5.md").read_text()
    assert written.startswith("2 of 0 searches finished\n")  # no folders of jobs here
    assert "| primary | svr      | C 100, epsilon 0.001 | C             | 0.1 " in written
    # TensorBoard's HPARAMS tab has a row for each trial that could be fitted
    trials = tmp_path / "trials"
    rows = sorted({path.parent for path in trials.rglob("events*")} - {*trials.iterdir()})
    names = [f"{model}/primary_{k}/{i}" for k, model in ((1, "msvr"), (0, "svr")) for i in (0, 2)]
    assert [str(row.relative_to(trials)) for row in rows] == names
    events = EventAccumulator(str(rows[1])).Reload()
    assert [event.value for event in events.Scalars("best")] == [1]
    assert [event.value for event in events.Scalars("cv_rmse")] == [pytest.approx(0.1)]
    start = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    shown = HParamsPluginData.FromString(start).session_start_info.hparams
    assert {"C", "epsilon", "group"} == set(shown)


def finished(folder, name, seed, group, errors, **settings):
    """Write a finished job: its configuration, and errors [%] with a bound of 0.5 %."""
    job = folder / name
    job.mkdir()
    config = {"seed": seed, "group": group, "model": {"random_state": seed, **settings}}
    (job / "config.yaml").write_text(yaml.safe_dump(config))
    ratios = {key: value / 0.5 for key, value in errors.items()}
    (job / "metrics.json").write_text(json.dumps({"rms_percent": errors, "rms_ratio": ratios}))


def sweep(folder):
    finished(folder, "0", 0, "primary", {"k_p": 3.0, "c_p": 5.0}, C=1)
    finished(folder, "1", 1, "primary", {"k_p": 1.0, "c_p": 3.0}, C=1)
    finished(folder, "2", 0, "secondary", {"k_s": 0.1, "c_s": 0.3}, C=1)
    finished(folder, "3", 0, "primary", {"k_p": 0.5, "c_p": 0.7}, C=2)
    (folder / "4").mkdir()
    (folder / "4" / "config.yaml").write_text("seed: 1\n")


def test_jobs_are_ranked_among_those_with_the_same_outputs(tmp_path):
    sweep(tmp_path)
    rows = job_rows(tmp_path)
    assert [row["job"] for row in rows] == ["3", "1", "0", "2", "4"]
    assert [row["k_p/bound"] for row in rows[:3]] == [1.0, 2.0, 6.0]
    assert rows[3]["k_p/bound"] is None
    assert rows[4]["state"] == "unfinished"


def test_error_over_an_infinite_bound_is_a_dash_not_zero(tmp_path):
    finished(tmp_path, "0", 0, "primary", {"k_p": 3.0, "c_p": 5.0})
    finished(tmp_path, "1", 0, "secondary", {"k_s": 0.5})
    metrics = tmp_path / "1" / "metrics.json"
    write_json(metrics, read_json(metrics) | {"rms_ratio": {"k_s": math.nan}})
    ended(Jobs(), tmp_path)
    header, _, *rows = (
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in (tmp_path / "jobs.md").read_text().splitlines()
    )
    shown = {row[0]: dict(zip(header, row, strict=True)) for row in rows}
    assert shown["1"]["k_s/bound"] == shown["0"]["k_s/bound"] == shown["1"]["k_p/bound"] == "-"
    assert shown["0"]["k_p/bound"] == "6"


def test_table_of_jobs_has_a_column_for_each_swept_setting(tmp_path):
    sweep(tmp_path)
    for name, c, seed in (("0", 1, 0), ("1", 1, 1), ("3", 2, 0), ("4", 2, 1)):
        hydra = tmp_path / name / ".hydra"
        hydra.mkdir()
        words = [f"model.C={c}", f"+seed={seed}", "data.n_train=9"]
        (hydra / "overrides.yaml").write_text(yaml.safe_dump(words))
    ended(Jobs(), tmp_path)
    jobs = list(csv.DictReader((tmp_path / "jobs.csv").read_text().splitlines()))
    assert [(row["job"], row["model.C"], row["seed"]) for row in jobs] == [
        *(("3", "2", "0"), ("1", "1", "1"), ("0", "1", "0"), ("2", "", ""), ("4", "2", "1"))
    ]
    assert "data.n_train" not in jobs[0]
