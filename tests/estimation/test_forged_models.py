"""Model files with hashes that fit and contents that do not: refused in one line, or harmless."""

import hashlib
import json
import math
import random
from functools import cache

import numpy as np
import pytest
import torch
from protocols import shipped_protocol
from trip_fixtures import BAND, NoLog
from vehicles import AM96

from suspnet.curves.curves import CurveSettings
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.problem import Problem
from suspnet.estimation.checkpoint import load_model, save_model
from suspnet.estimation.fitted import ModelFileError
from suspnet.ground.storage import content_hash, dump_arrays, read_arrays
from suspnet.learning import MSVR, MVGPR, SVR, CurveFit, LinearRegression
from suspnet.runs.fit import fit
from suspnet.runs.predict import calibrated
from suspnet.vehicle import QuarterCar, VerticalVehicle

METHODS = {
    "linear": lambda: LinearRegression(),
    "msvr": lambda: MSVR(1e4, 5.0, 1e-3, n_components=32),
    "svr": lambda: SVR(10.0, 5.0, 1e-2),
    "mvgpr": lambda: MVGPR(n_optimize=40, n_restarts=0),
    "curve_fit": lambda: CurveFit(n_starts=16),
    "trips": lambda: MSVR(1e4, 8.0, 1e-3, "nystroem", 64),
}
NONSENSE = [
    *(math.nan, math.inf, 1e30, -1e300, 1e12, -1, 0, 0.5, "x", "", None, True, False),
    *([], {}, [[[1.0]]], [1.0, "x"], {"x": 1}),
]
"""What a value of model.json is set to; the hash is made to fit."""
ARRAY_NONSENSE = {
    "nan": lambda a: np.full_like(a, np.nan),
    "infinite": lambda a: np.full_like(a, np.inf),
    "huge": lambda a: np.full_like(a, 1e300),
    "negative": lambda a: -a - 1,
    "empty": lambda a: a[:0] if a.ndim else np.zeros(0),
    "deeper": lambda a: a[None],
    "three_dimensional": lambda a: np.zeros((2, 2, 2)),
    "four_dimensional": lambda a: np.zeros((2, 2, 2, 2)),
    "scalar": lambda a: np.array(1.0),
    "longer": lambda a: np.concatenate([np.atleast_1d(a)] * 2),
    "whole_numbers": lambda a: np.ones(a.shape, dtype=np.int64),
    "truth": lambda a: np.ones(a.shape, dtype=bool),
    "gone": lambda a: None,
}


@cache
def model_of(name):
    """Return a small calibrated model."""
    if name == "trips":
        settings = EstimateSettings(400, 50, 150, **BAND)
        generator, task = VerticalVehicle(AM96), shipped_protocol("trips").task("all")
    else:
        settings = CurveSettings(400, 50, 150, step_hz=0.05)
        generator, task = QuarterCar(AM96), shipped_protocol("multi_location").task("primary")
    problem = Problem(generator, task, settings, progress=False)
    return calibrated(problem, fit(problem, METHODS[name](), NoLog()))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a function that gives the folder of a saved model, made once."""
    folder = tmp_path_factory.mktemp("models")

    def of(name):
        if not (folder / name).exists():
            save_model(folder / name, model_of(name))
        return folder / name

    return of


def curves_of(model):
    """Return two curves of a worn vehicle without noise."""
    ratios = torch.tensor([[0.9, 1.1, 1.0, 0.95, 1.02], [1.0, 0.8, 1.0, 1.0, 1.0]])
    return model.settings.observer(model.generator).noise_free(ratios.double())


def forge(folder, content, arrays):
    """Write a model's files, with hashes that fit whatever they hold."""
    folder.mkdir(parents=True, exist_ok=True)
    data = dump_arrays({name: array for name, array in arrays.items() if array is not None})
    (folder / "model.safetensors").write_bytes(data)
    content = {key: value for key, value in content.items() if key != "description_sha256"}
    if "arrays_sha256" in content:
        content["arrays_sha256"] = hashlib.sha256(data).hexdigest()
    content["description_sha256"] = content_hash(content)
    (folder / "model.json").write_text(json.dumps(content))


def places(node, path=()):
    """Return the path of every value at or below a node."""
    if not isinstance(node, dict | list):
        return []
    found = []
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        found += [(*path, key), *places(value, (*path, key))]
    return found


def mutations(content, arrays):
    """Yield what is changed in words, and the content and arrays of each forged model."""
    text = json.dumps(content)
    for path in places(content):
        if path[0] in ("description_sha256", "arrays_sha256") or (path[0], path[-1]) == (
            "units",
            0,
        ):
            continue
        for value in (*NONSENSE, "gone", "more"):
            forged = json.loads(text)  # a fraction of the time of copy.deepcopy
            node = forged
            for key in path[:-1]:
                node = node[key]
            if value == "gone":
                del node[path[-1]]
            elif value == "more":
                if not isinstance(node[path[-1]], dict | list):
                    continue
                part = node[path[-1]]
                part.append(1.0) if isinstance(part, list) else part.update(more=1.0)
            else:
                node[path[-1]] = value
            yield f"{path} {value!r}", forged, arrays
    for name, change in ((n, c) for n in sorted(arrays) for c in ARRAY_NONSENSE.items()):
        yield f"{name} {change[0]}", content, arrays | {name: change[1](arrays[name])}
    for name in sorted(arrays):  # safetensors gives them in any order
        yield (
            f"{name} renamed",
            content,
            {f"{k}x" if k == name else k: v for k, v in arrays.items()},
        )
    yield "more arrays", content, arrays | {"more": np.ones(3)}


def outcome(folder, curves, estimate):
    """Return how a model file ends: refused, the same estimate, or another finite one."""
    try:
        model = load_model(folder)
    except ModelFileError as error:
        return "refused" if "\n" not in str(error) else f"many lines: {error}"
    try:
        found = model.estimate(curves)
    except ValueError as error:  # another model, which these curves do not fit
        return "refused when used" if "\n" not in str(error) else f"many lines: {error}"
    assert np.isfinite(found.values).all() or all(found.flags.reasons), "NaN and not flagged"
    same = found.values.shape == estimate.values.shape and np.allclose(
        found.values, estimate.values, rtol=1e-9, atol=0
    )
    return "same" if same else "another"


def tried(name, folders, folder, n_mutations, seed):
    """Return how many forged models of a method end how."""
    source = folders(name)
    content = json.loads((source / "model.json").read_text())
    arrays = read_arrays(source / "model.safetensors")
    model = load_model(source)
    curves = curves_of(model)
    estimate = model.estimate(curves)
    every = list(mutations(content, arrays))
    counts = {"refused": 0, "refused when used": 0, "same": 0, "another": 0}
    others = []
    for words, *forged in random.Random(seed).sample(every, min(n_mutations, len(every))):
        forge(folder / "forged", *forged)
        try:
            ended = outcome(folder / "forged", curves, estimate)
        except Exception as error:
            raise AssertionError(f"{name}: {words}: {error!r}") from error
        counts[ended] += 1
        if ended in ("another", "refused when used"):
            others.append(words)
    assert sorted(path.name for path in folder.iterdir()) == ["forged"]
    return counts, others


@pytest.mark.parametrize(
    ("name", "n", "n_refused"),
    [("linear", 12, 6), *(pytest.param(m, 200, 120, marks=pytest.mark.slow) for m in METHODS)],
)
def test_forged_models_are_refused_or_harmless(name, n, n_refused, folders, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    counts, others = tried(name, folders, tmp_path, n, n // 200)
    print(name, counts, *others, sep="\n  ")
    assert sum(counts.values()) <= n
    assert counts["refused"] >= n_refused
    assert counts["another"] + counts["refused when used"] <= 6


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("outputs", "log"), 0, "`outputs.log` must be True or False"),
        (("outputs", "log"), False, "`outputs.log` must be True, as the task says"),
        (("training",), {}, "KeyError\\('seed'\\)"),
        (("settings", "high_hz"), 1e12, "`data.high_hz` must be at most"),
        (("task", "extractor", "high_hz"), 1e12, "`high_hz` must be at most"),
        (("inputs", "mean"), [[[1.0]]], "`inputs.mean` must be 9 numbers"),
        (("healthy_features", 0), 7.0, "`healthy_features` are not those of the vehicle"),
        (("settings", "snr_db"), math.nan, "`model.json.settings.snr_db` must be a finite number"),
        (("generator", "vehicle", "more"), 1.0, "unexpected keyword argument"),
        (("task", "more"), 1.0, "unexpected keyword argument"),
    ],
)
def test_forged_setting_is_named(path, value, message, folders, tmp_path):
    content, arrays = read_files(folders("linear"))
    node = content
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    forge(tmp_path, content, arrays)
    with pytest.raises(ModelFileError, match=message):
        load_model(tmp_path)


@pytest.mark.parametrize(
    ("model", "name", "changed"),
    [
        ("trips", "features.healthy", lambda a: a[..., 0]),
        ("trips", "features.mean", lambda a: a[:-1]),
        ("trips", "features.noise", lambda a: a[: len(a) // 2]),
        ("trips", "features.directions", lambda a: a[:-1]),
        ("trips", "features.directions", lambda a: a[:, :-1]),
        ("trips", "coef", lambda a: a[:-1]),
        ("linear", "coef", lambda a: a[:, :-1]),
        ("linear", "intercept", lambda a: np.append(a, 0.0)),
        ("msvr", "coef", lambda a: a[:-1]),
        ("svr", "dual_coef.1", lambda a: a[:-1]),
        ("mvgpr", "weights", lambda a: a[:-1]),
        ("mvgpr", "kernel", lambda a: a[:-1]),
    ],
)
def test_array_that_does_not_fit_the_others_is_refused(model, name, changed, folders, tmp_path):
    content, arrays = read_files(folders(model))
    forge(tmp_path, content, arrays | {name: changed(arrays[name])})
    with pytest.raises(ModelFileError, match=r"not a suspnet model|do not fit together"):
        load_model(tmp_path)


def test_deep_json_is_refused(folders, tmp_path):
    forge(tmp_path, *read_files(folders("linear")))
    (tmp_path / "model.json").write_text('{"a":' * 100_000 + "1" + "}" * 100_000)
    with pytest.raises(ModelFileError, match="is nested too deeply"):
        load_model(tmp_path)


def read_files(folder):
    """Return the content of model.json and the arrays of a model."""
    content = json.loads((folder / "model.json").read_text())
    return content, read_arrays(folder / "model.safetensors")
