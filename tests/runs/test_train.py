"""Every method learns every protocol as shipped: calibrated, tested, saved."""

import math
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from suspnet.model.checkpoint import load_model
from suspnet.runs.fit import Problem
from suspnet.runs.train import train

CONFIGS = Path(__file__).parents[2] / "configs"
MODELS = sorted(file.stem for file in (CONFIGS / "model").glob("*.yaml"))
PROTOCOLS = {
    "multi_location": ("primary", "secondary"),
    "paper": ("primary", "secondary"),
    "joint": ("all",),
    "trips": ("all",),
}
SMALL = ["data.n_train=300", "data.n_test=100", "data.n_calibrate=200", "data.step_hz=0.04"]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Features are made once for all methods."""
    return tmp_path_factory.mktemp("cache")


def trained(model, protocol, group, cache, folder, *overrides):
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        chosen = [f"protocol={protocol}", f"group={group}", f"model={model}", *overrides]
        config = compose("train", overrides=[*chosen, f"data.cache_dir={cache}"])
    task = instantiate(config.protocol).task(group)
    problem = Problem(
        instantiate(config.generator), task, instantiate(config.data), config.seed, progress=False
    )
    return train(problem, instantiate(config.model), folder, figures=False)


def test_every_protocol_is_tried():
    assert set(PROTOCOLS) == {file.stem for file in (CONFIGS / "protocol").glob("*.yaml")}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    ("protocol", "group"), [(name, group) for name, groups in PROTOCOLS.items() for group in groups]
)
def test_every_method_is_calibrated_under_every_protocol(model, protocol, group, cache, tmp_path):
    metrics = trained(model, protocol, group, cache, tmp_path, *SMALL)
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


def test_curve_fit_cannot_be_used_with_trips(cache, tmp_path):
    small = ["data=trips", "generator=best", *SMALL[:3]]
    with pytest.raises(ValueError, match=r"model=curve_fit .* cannot be used with data=trips"):
        trained("curve_fit", "trips", "all", cache, tmp_path, *small)
    assert not (tmp_path / "model.json").exists()
