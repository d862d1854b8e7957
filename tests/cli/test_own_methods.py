"""Methods and feature sets of a user: registered by a script of theirs, and saved."""

import json
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from cli_runner import typed
from hydra.core.config_store import ConfigStore
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.ensemble import RandomForestRegressor
from sklearn.linear_model import Ridge

import suspnet
from suspnet import TEST, LinearRegression, Problem, load_model, save_model, train
from suspnet.cli import kinds
from suspnet.cli import train as program
from suspnet.curves.components import FEATURE_SETS
from suspnet.curves.curves import CurveSettings
from suspnet.curves.extraction import FeatureSet, FeatureTable
from suspnet.estimation.fitted import ModelFileError
from suspnet.learning import METHODS
from suspnet.runs.fit import fit
from suspnet.runs.tables import MODEL_TITLES

PAGE = (Path(__file__).parents[2] / "docs" / "extending.md").read_text(encoding="utf-8")
CODE = "\n".join(
    next(one for one in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if words in one)
    for words in ("class KernelRidge", "class Levels")
)
MODULE = f"""{CODE}
import suspnet

from suspnet.cli.command import main

suspnet.register_method("kernel_ridge", KernelRidge, "kernel ridge")
suspnet.register_features(Levels)
if __name__ == "__main__":
    main()
"""
SETTINGS = CurveSettings(200, 100, None)
TINY = ("data.n_train=200", "data.n_test=100", "data.n_calibrate=null", "figures=false")


@pytest.fixture(autouse=True)
def _registered_here_only(monkeypatch):
    tables = (METHODS, MODEL_TITLES, FEATURE_SETS, kinds.KINDS["model"])
    before = [dict(one) for one in tables]
    stored = (
        dict(ConfigStore.instance().repo["model"])
        if "model" in (ConfigStore.instance().repo)
        else None
    )
    yield
    for one, old in zip(tables, before, strict=True):
        one.clear()
        one.update(old)
    if stored is None:
        ConfigStore.instance().repo.pop("model", None)
    else:
        ConfigStore.instance().repo["model"] = stored


class Mean(RegressorMixin, BaseEstimator):
    def __init__(self, shift=0.0):
        self.shift = shift

    def fit(self, X, y):
        self.mean_ = np.mean(y, axis=0)
        return self

    def predict(self, X):
        return np.tile(self.mean_ + self.shift, (len(X), 1))

    def state(self):
        return {"mean": self.mean_}

    def restore(self, state):
        self.mean_ = state["mean"]
        return self


def test_registered_method_is_trained_saved_and_refused_where_it_is_not_known(
    quarter_car, task, tmp_path
):
    suspnet.register_method("mean", Mean, "the mean")
    problem = Problem(quarter_car, task(), SETTINGS)
    metrics = train(problem, Mean(), str(tmp_path / "run"), figures=False)
    assert metrics["model"] == "mean"
    model = load_model(tmp_path / "run")
    assert type(model.estimator) is Mean
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["rms_ratio"]
    del METHODS["mean"]
    with pytest.raises(ModelFileError, match=r"'mean'; if it is your own.*register_method in a"):
        load_model(tmp_path / "run")


def test_any_regressor_is_scored_without_a_folder_and_writes_nothing(
    quarter_car, task, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    problem = Problem(quarter_car, task(), SETTINGS)
    found = train(problem, Ridge(alpha=1e-12))
    ours = train(problem, LinearRegression(), tmp_path / "run", figures=False)
    assert found["model"] == "Ridge"
    for name in ("rms_percent", "rms_ratio"):
        assert found[name] == pytest.approx(ours[name], rel=1e-6)
    assert [one.name for one in tmp_path.iterdir()] == ["run"]


FORMS = {
    "flat": (lambda found: found[:, 0], r"\(100, 2\), got shape \(100,\)"),
    "empty": (lambda found: found * np.nan, r"\(100, 2\), got numbers that are not finite"),
}
"""What a method may return instead of (n_curves, n_outputs), and the words on it."""


@pytest.mark.parametrize("form", FORMS)
def test_predictions_of_another_shape_are_refused(form, quarter_car, task, monkeypatch):
    change, words = FORMS[form]
    predict = Mean.predict
    monkeypatch.setattr(Mean, "predict", lambda self, X: change(predict(self, X)))
    with pytest.raises(ValueError, match=rf"predict of the method 'Mean' must.*finite.*{words}"):
        train(Problem(quarter_car, task(), SETTINGS), Mean())


def test_trees_of_the_page_are_fitted_again_when_they_are_loaded(quarter_car, task, tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "datasets.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(from sklearn[^`]*class Trees.*?)```", page, re.DOTALL)
    namespace = {"__name__": "example"}
    exec(compile(code, "docs/datasets.md", "exec"), namespace)
    suspnet.register_method("trees", namespace["Trees"])
    problem = Problem(quarter_car, task(), SETTINGS)
    model = fit(problem, namespace["Trees"](n_estimators=10), None)
    save_model(tmp_path, model)
    inputs = problem.features(TEST).complete().inputs
    assert np.array_equal(load_model(tmp_path).predict(inputs), model.predict(inputs))


UNSAVEABLE = {
    "text": (
        lambda self: {"mean": self.mean_, "names": np.array(["a", "b"])},
        Mean.restore,
        "array 'names' is of <U1",
    ),
    "nothing": (lambda self: {}, Mean.restore, "must return all that predict needs"),
    "forgotten": (Mean.state, lambda self, state: self, "no attribute 'mean_'"),
    "other": (
        Mean.state,
        lambda self, state: vars(self).update(mean_=state["mean"] + 0.01),
        "predicts numbers that differ by 0.01",
    ),
}
"""Ways of `state` and `restore` that lose a method, and the words on each."""


@pytest.mark.parametrize("way", UNSAVEABLE)
def test_method_that_is_not_restored_is_not_saved(way, quarter_car, task, tmp_path, monkeypatch):
    state, restore, words = UNSAVEABLE[way]
    suspnet.register_method("mean", Mean)
    problem = Problem(quarter_car, task(), SETTINGS)
    model = fit(problem, Mean(), None)
    monkeypatch.setattr(Mean, "state", state)
    monkeypatch.setattr(Mean, "restore", restore)
    with pytest.raises(ValueError, match=rf"the method 'mean' cannot be saved.*{words}"):
        save_model(tmp_path, model)
    monkeypatch.setattr("suspnet.runs.train.calibrated", None)  # refused before it is called
    with pytest.raises(ValueError, match=rf"the method 'mean' cannot be saved.*{words}"):
        train(problem, Mean(), tmp_path / "run")
    assert not list(tmp_path.rglob("model.*"))


@pytest.mark.parametrize(
    ("name", "cls", "title", "error", "words"),
    [
        ("msvr", Mean, None, ValueError, "one of suspnet's own"),
        ("Mean", Mean, None, ValueError, "lower-case"),
        ("../mean", Mean, None, ValueError, "lower-case"),
        ("mean", Mean, "MSVR", ValueError, "that of another method"),
        ("forest", RandomForestRegressor, None, TypeError, "lacks state, restore"),
        ("mean", Mean(), None, TypeError, "lacks a class"),
    ],
)
def test_method_that_would_not_work_is_not_registered(name, cls, title, error, words):
    before = dict(METHODS)
    with pytest.raises(error, match=words):
        suspnet.register_method(name, cls, title)
    assert before == METHODS


@dataclass(frozen=True)
class Middle(FeatureSet):
    """Mean magnitudes of both responses; none where that of G_p is above a threshold."""

    threshold: float = 1e9

    kind: ClassVar[str] = "middle"
    positive: ClassVar[bool] = True
    parts: ClassVar[tuple[str, ...]] = ("middle",)
    names: ClassVar[tuple[str, ...]] = ("G_p", "G_s")

    def extract(self, curves, frequencies_hz):
        values = curves.abs().mean(dim=2)
        is_missing = (values[:, :1] > self.threshold) & (len(curves) > 1)  # but of the healthy one
        return FeatureTable(torch.where(is_missing, torch.nan, values), is_missing.long())

    def missing(self, reasons):
        return "the middle (too high)" if reasons.any() else ""

    def relative(self, values, healthy):
        return values / healthy


@pytest.mark.parametrize("part", ["kind", "extract", "relative"])
def test_feature_set_that_lacks_a_part_is_not_registered(part, monkeypatch):
    with pytest.raises(TypeError, match="dataclass"):
        suspnet.register_features(Mean)
    suspnet.register_features(Middle)
    monkeypatch.delattr(Middle, part)
    with pytest.raises(
        TypeError, match=rf"the feature set Middle lacks {part}; suspnet.FeatureSet"
    ):
        suspnet.register_features(Middle)


@pytest.mark.parametrize("part", ["names", "parts"])
def test_table_of_another_width_than_its_names_is_refused(part, quarter_car, task, monkeypatch):
    problem = Problem(quarter_car, replace(task(), extractor=Middle()), SETTINGS)
    monkeypatch.setattr(Middle, part, ("G_p", "G_s", "G_t"))
    width = {"names": 2, "parts": 1}[part]
    with pytest.raises(
        ValueError, match=rf"'middle' .* its `{part}`, \(1, 3\), got \(1, {width}\)"
    ):
        train(problem, LinearRegression())


@pytest.mark.slow
def test_script_of_the_user_trains_and_searches_its_method_with_its_features(tmp_path):
    (tmp_path / "mine.py").write_text(MODULE)
    run = tmp_path / "run"
    subprocess.run(
        [
            *(sys.executable, "mine.py", "train", "model=kernel_ridge", "search=table5", *TINY),
            *("protocol.feature_set=levels", "protocol.feature_settings={half_width_hz: 0.2}"),
            *("+search.grids.kernel_ridge={alpha: [1e-6, 1e-5]}", f"hydra.run.dir={run}"),
        ],
        cwd=tmp_path,
        check=True,
    )
    searched = json.loads((run / "metrics.json").read_text())["search"]
    assert [one["alpha"] for one in searched["settings"]] == [1e-6, 1e-5]
    exec(compile(MODULE, "mine.py", "exec"), {"__name__": "mine"})
    model = load_model(run)
    assert model.name == "kernel_ridge"
    assert model.task.extractor.half_width_hz == 0.2


def test_configuration_names_no_module(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "mine.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    (tmp_path / "model" / "foreign.yaml").write_text("kind: mine.Mean\nplugin: mine.py\n")
    ended = typed(program, "--config-dir", tmp_path, "model=foreign", *TINY, cwd=tmp_path)
    assert ended.returncode == 1
    assert "`model.kind` must be one of" in ended.stderr
    assert not (tmp_path / "ran").exists()
