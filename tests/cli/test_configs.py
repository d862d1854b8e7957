"""Every configuration composes, instantiates and agrees with its class."""

import inspect
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf

from suspnet.cli.options import TABLES
from suspnet.cli.program import check_targets
from suspnet.data import Protocol
from suspnet.features import PeakFeatures
from suspnet.learning import METHODS

CONFIGS = Path(__file__).parents[2] / "configs"
NAMES = {
    group: sorted(file.stem for file in (CONFIGS / group).glob("*.yaml"))
    for group in (
        "vehicle",
        "protocol",
        "model",
        "experiment",
        "study",
        "search",
        "generator",
        "data",
    )
}
NAMES |= {group: list(OmegaConf.load(CONFIGS / file)) for group, (file, _) in TABLES.items()}
PROGRAM = {"study": "evaluate", "scenario": "simulate"}
"""The program of each group that is not train.py's."""
OPTIONS = [
    (group, name)
    for group, names in NAMES.items()
    for name in names
    if group not in ("ablation", "experiment")  # they differ from the defaults on purpose
]
OF_THE_OPTION = {"Protocol", "Scenario", "Vehicle"}
"""Classes whose options differ from each other on purpose."""


def targets(node):
    """Return every mapping with a `_target_` at or below a node."""
    found = [node] if isinstance(node, dict) and "_target_" in node else []
    parts = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return found + [target for part in parts for target in targets(part)]


def composed(*overrides, name="train"):
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        return compose(name, overrides=list(overrides))


@pytest.mark.parametrize("name", NAMES["model"])
@pytest.mark.parametrize("protocol", NAMES["protocol"])
def test_every_model_instantiates_under_every_protocol(name, protocol):
    config = composed(f"model={name}", f"protocol={protocol}")
    groups = instantiate(config.protocol).groups
    for group in groups:
        config.group = group
        assert type(instantiate(config.model)) is METHODS[name.removesuffix("_table5")]


@pytest.mark.parametrize(("group", "name"), OPTIONS)
def test_every_option_shows_every_argument_and_the_same_defaults(group, name):
    program = PROGRAM.get(group, "train")
    config = composed(f"{group}={name}", name=program)
    check_arguments(OmegaConf.to_container(config, resolve=False))


def test_programs_and_bases_show_the_same_defaults():
    check_arguments(OmegaConf.to_container(composed(name="evaluate"), resolve=False))
    base = OmegaConf.to_container(OmegaConf.load(CONFIGS / "base" / "protocol.yaml"))
    first = OmegaConf.to_container(OmegaConf.load(CONFIGS / "scenarios.yaml")).pop("healthy")
    for node in (base, first):
        check_arguments(node, differing=())


def check_arguments(config, differing=OF_THE_OPTION):
    """Assert that every object of a configuration has the arguments and defaults of its class."""
    nodes = targets(config)
    assert nodes or "_target_" not in str(config)
    for node in nodes:
        target = get_object(node["_target_"])
        given = {key: value for key, value in node.items() if key not in ("_target_", "_convert_")}
        parameters = inspect.signature(target).parameters
        if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            assert {key for key in parameters if key != "options"} <= set(given)
        else:
            missing = set(parameters) - set(given)
            assert not missing - {"folder"}, target  # the program gives a study its folder
            assert set(given) <= set(parameters), target
        if target.__name__ in differing:
            continue
        for key, value in given.items():
            default = getattr(parameters.get(key), "default", inspect.Parameter.empty)
            if default is not inspect.Parameter.empty and "${" not in str(value):
                assert value == default, (target, key)


@pytest.mark.parametrize("name", NAMES["protocol"])
def test_protocol_file_shows_every_setting_of_peaks_and_its_default(name):
    settings = OmegaConf.to_container(composed(f"protocol={name}").protocol.features)
    parameters = inspect.signature(PeakFeatures).parameters
    assert settings == {key: p.default for key, p in parameters.items() if key != "peaks"}


@pytest.mark.parametrize("name", NAMES["ablation"])
def test_every_ablation_composes_with_trusted_targets(name):
    config = composed("experiment=ablation", f"ablation={name}")
    check_targets(config)
    assert instantiate(config.protocol).task(config.group).outputs
    assert type(instantiate(config.model)) is METHODS["msvr"]
    assert instantiate(config.data).n_calibrate is None


@pytest.mark.parametrize("name", NAMES["vehicle"])
def test_every_vehicle_is_valid_and_names_its_source(name):
    vehicle = instantiate(composed(f"vehicle={name}").vehicle)
    assert vehicle.name == name
    assert vehicle.source


@pytest.mark.parametrize("name", NAMES["protocol"])
def test_every_protocol_has_tuned_values_for_its_groups(name):
    config = composed(f"protocol={name}")
    protocol = instantiate(config.protocol)
    assert isinstance(protocol, Protocol)
    assert protocol.name == name
    assert set(config.tuned) == set(protocol.groups) == set(config.groups.split(","))
    assert config.group in protocol.groups
    methods = {"msvr", "msvr_table5", "svr", "mvgpr"}
    assert all(set(values) == methods for values in config.tuned.values())


@pytest.mark.parametrize("protocol", [name for name in NAMES["protocol"] if name != "trips"])
def test_tuned_values_lie_in_table_v_or_in_the_widened_box(protocol):
    ranges = {"C": (1, 100), "sigma": (1e-3, 100), "epsilon": (1e-6, 1e-3)}
    caps = composed("search=widened").search.caps
    for methods in composed(f"protocol={protocol}").tuned.values():
        for key, value in methods.msvr_table5.items():
            assert ranges[key][0] <= value <= ranges[key][1]
        for name, values in methods.items():
            for key, value in values.items():
                cap = caps.get(name, {}).get(key, {})
                assert 0 < value <= cap.get("high", 1e12)


def test_widened_search_tells_why_a_cap_is_one():
    search = instantiate(composed("search=widened").search)
    assert search.widen > 0
    assert set(search.grids) == {"msvr", "svr", "mvgpr"}
    assert all(cap["reason"] for caps in search.caps.values() for cap in caps.values())


def test_search_grid_spans_table_v():
    grids = composed("search=table5").search.grids
    for name in ("msvr", "svr"):
        assert (min(grids[name].C), max(grids[name].C)) == (1, 100)
        assert (min(grids[name].sigma), max(grids[name].sigma)) == (1e-3, 100)
        assert (min(grids[name].epsilon), max(grids[name].epsilon)) == (1e-6, 1e-3)
    assert (min(grids.mvgpr.length_scale), max(grids.mvgpr.length_scale)) == (1e-2, 10)
    assert (min(grids.mvgpr.signal_variance), max(grids.mvgpr.signal_variance)) == (1e-3, 100)
    assert (min(grids.mvgpr.noise_variance), max(grids.mvgpr.noise_variance)) == (1e-4, 1e-1)
    assert len(grids.msvr.C) * len(grids.msvr.sigma) * len(grids.msvr.epsilon) >= 60


@pytest.mark.parametrize("name", NAMES["experiment"])
def test_every_experiment_composes_with_trusted_targets(name):
    study = "study" in OmegaConf.load(CONFIGS / "experiment" / f"{name}.yaml")
    config = composed(f"experiment={name}", name="evaluate" if study else "train")
    assert config.job == name
    check_targets(config)


def test_command_line_beats_experiment():
    assert composed("experiment=table6", "data.n_train=77").data.n_train == 77


def test_foreign_target_is_rejected():
    config = composed("model._target_=os.system")
    with pytest.raises(ValueError, match=r"must lie in suspnet, got 'os\.system'"):
        check_targets(config)


def test_evaluate_composes_with_and_without_a_protocol():
    assert composed(name="evaluate").get("protocol") is None
    assert composed("protocol=joint", name="evaluate").protocol.name == "joint"


def test_slurm_preset_asks_for_modest_jobs():
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        config = compose("train", ["hydra/launcher=slurm"], return_hydra_config=True)
    launcher = config.hydra.launcher
    assert launcher._target_.endswith("SlurmLauncher")
    assert (launcher.timeout_min, launcher.cpus_per_task, launcher.mem_gb) == (60, 8, 8)
