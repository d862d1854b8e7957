"""Every method learns every protocol as shipped: calibrated, tested, saved."""

import itertools
import math
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from suspnet.cli.kinds import build
from suspnet.curves.problem import Problem
from suspnet.estimation.checkpoint import load_model
from suspnet.runs.train import train

CONFIGS = Path(__file__).parents[2] / "configs"
MODELS = sorted(file.stem for file in (CONFIGS / "model").glob("*.yaml"))
PROTOCOLS = {
    "multi_location": ("primary", "secondary"),
    "paper": ("I", "II"),
    "joint": ("all",),
    "trips": ("all",),
}
SMALL = ["data.n_train=200", "data.n_test=100", "data.n_calibrate=200", "data.step_hz=0.08"]


def trained(model, protocol, group, folder, *overrides):
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        chosen = [f"protocol={protocol}", f"group={group}", f"model={model}", *overrides]
        config = compose("train", overrides=chosen)
    task = build(config, "protocol").task(group)
    problem = Problem(
        build(config, "generator"), task, build(config, "data"), config.seed, progress=False
    )
    return train(problem, build(config, "model"), folder, figures=False)


def test_every_protocol_is_tried():
    assert set(PROTOCOLS) == {file.stem for file in (CONFIGS / "protocol").glob("*.yaml")}


def cases():
    """Yield method, protocol and group; slow are those whose code others of the method run too."""
    for (name, groups), model in itertools.product(PROTOCOLS.items(), MODELS):
        for group in groups:
            if model == "linear":  # test_predict.py has the others, calibrated
                again = name != "trips"
            elif model == "msvr_table5":  # msvr, with other numbers
                again = (name, group) != ("paper", "I")
            else:  # msvr reads trips in tests/trips, and tests/learning has the other methods
                again = name != "joint" or model != "msvr"
            yield pytest.param(model, name, group, marks=[pytest.mark.slow] * again)


@pytest.mark.parametrize(("model", "protocol", "group"), [*cases()])
def test_every_method_is_calibrated_under_every_protocol(model, protocol, group, tmp_path):
    metrics = trained(model, protocol, group, tmp_path, *SMALL)
    outputs = metrics["scores"]
    # 100 scores and 100 curves: 3 % and 3 %, four of their root sum
    assert metrics["intervals"]["joint_coverage_percent"] == pytest.approx(90, abs=17)
    for name, values in metrics["intervals"]["outputs"].items():
        assert outputs[name]["mape_percent"] > 0
        assert math.isfinite(values["half_width_percent"])
        assert values["coverage_percent"] == pytest.approx(90, abs=17)
    model = load_model(tmp_path)
    assert model.task.outputs == tuple(outputs)
    assert model.intervals is not None
    assert model.ood is not None


def test_curve_fit_cannot_be_used_with_trips(tmp_path):
    few = ["data.n_train=20", "data.n_test=5", "data.n_calibrate=null"]
    small = ["data=trips", "generator=best", *few]
    with pytest.raises(ValueError, match=r"model=curve_fit .* cannot be used with data=trips"):
        trained("curve_fit", "trips", "all", tmp_path, *small)
    assert not (tmp_path / "model.json").exists()


@pytest.mark.parametrize(
    ("model", "setting", "message"),
    [
        ("msvr", "model.C=-1", "`C` must be a finite number > 0, got -1"),
        ("msvr", "model.sigma=0", "`sigma` must be a finite number > 0, got 0"),
        ("svr", "model.epsilon=-1", "`epsilon` must be a finite number >= 0"),
        ("mvgpr", "model.device=cuda:99", "`device`='cuda:99' cannot be used here"),
    ],
)
def test_hyperparameters_are_checked_before_curves_are_made(
    model, setting, message, monkeypatch, tmp_path
):
    monkeypatch.setattr(Problem, "curves", lambda *_: pytest.fail("curves are made"))
    for folder in (None, tmp_path / "run"):
        with pytest.raises(ValueError, match=message):
            trained(model, "multi_location", "primary", folder, *SMALL, setting)


def test_a_folder_with_files_of_others_is_left_as_it_is(tmp_path):
    (tmp_path / "metrics.json").write_text("mine")
    with pytest.raises(FileExistsError, match="suspnet did not write it here"):
        trained("linear", "multi_location", "primary", tmp_path, *SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]
    # an earlier run of ours is replaced
    for model in ("linear", "svr"):
        quick = *SMALL, "data.n_calibrate=null"
        trained(model, "multi_location", "primary", tmp_path / "run", *quick)
    assert type(load_model(tmp_path / "run").estimator).__name__ == "SVR"
