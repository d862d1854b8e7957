"""docs/extending.md: its worked examples work where it says that they are entered."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspnet.cli.kinds import read_vehicles
from suspnet.curves.components import FEATURE_SETS
from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import TEST, Problem
from suspnet.estimation.checkpoint import load_model, save_model
from suspnet.learning import METHODS, LinearRegression
from suspnet.runs.fit import fit

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
SETTINGS = CurveSettings(400, 100, None)


def example(kind, words):
    """Return the one block of a language that holds some words."""
    found = [code for code in re.findall(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL) if words in code]
    assert len(found) == 1
    return found[0]


def defined(name):
    """Return a class that a block of the page defines."""
    namespace = {"__name__": "example"}
    exec(compile(example("python", f"class {name}"), "docs/extending.md", "exec"), namespace)
    return namespace[name]


def errors_percent(problem, model):
    """Return the mean absolute errors of a model's estimates of fresh curves."""
    fresh = problem.features(TEST).complete()
    return 100 * np.abs(model.predict(fresh.inputs) / fresh.outputs - 1).mean(axis=0)


def test_vehicle_is_read(tmp_path):
    (tmp_path / "vehicle").mkdir()
    code = example("yaml", "bogie_mass_kg")
    (tmp_path / "vehicle" / "mine.yaml").write_text(code)
    vehicle = read_vehicles(tmp_path)["mine"]
    assert vehicle.half_wheelbase_m == 1.05
    assert vehicle.source


def test_method_learns_and_is_stored(quarter_car, task, tmp_path, monkeypatch):
    method = defined("KernelRidge")
    monkeypatch.setitem(METHODS, "kernel_ridge", method)
    problem = Problem(quarter_car, task(), SETTINGS)
    model = fit(problem, method(), None)
    assert (errors_percent(problem, model) < [0.5, 5]).all()
    save_model(tmp_path, model)
    inputs = problem.features(TEST).complete().inputs
    assert np.array_equal(load_model(tmp_path).predict(inputs), model.predict(inputs))


def test_method_has_the_arguments_of_its_file():
    given = re.findall(r"^(\w+): (\S+)$", example("yaml", "kind: kernel_ridge"), re.MULTILINE)
    values = {key: None if text == "null" else float(text) for key, text in given[1:]}
    assert given[0] == ("kind", "kernel_ridge")
    assert defined("KernelRidge")().get_params() == values


def test_feature_set_learns_and_is_stored(quarter_car, task, tmp_path, monkeypatch):
    features = defined("Levels")
    monkeypatch.setitem(FEATURE_SETS, "levels", features)
    problem = Problem(quarter_car, replace(task(), extractor=features()), SETTINGS)
    model = fit(problem, LinearRegression(), None)
    assert (errors_percent(problem, model) < [3, 30]).all()
    save_model(tmp_path, model)
    assert load_model(tmp_path).task.extractor == features()


@pytest.mark.parametrize(
    "name", sorted(set(re.findall(r"`(_?[A-Z]+(?:_[A-Z]+)*)`", PAGE)) - {"NAME"})
)
def test_names_of_the_page_are_those_of_the_code(name):
    files = [*(ROOT / "suspnet").rglob("*.py"), *(ROOT / "tests").glob("*.py")]
    files += (ROOT / "benchmarks").glob("*.py")
    assert any(
        re.search(rf"^{name}\b.*= ", file.read_text(encoding="utf-8"), re.MULTILINE)
        for file in files
    )
