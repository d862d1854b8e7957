"""Every configuration composes, instantiates and agrees with its class."""

import inspect
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from suspnet.cli.config_files import TABLES
from suspnet.cli.kinds import KINDS, PARTS, build, class_of, read_protocol, read_vehicles
from suspnet.curves.extraction import PeakFeatures
from suspnet.curves.protocols import Protocol
from suspnet.learning import METHODS
from suspnet.vehicle import Vehicle, VerticalVehicle, best_generator
from suspnet.vehicle.vehicle import GEOMETRY

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
    if group not in ("experiment", "reading")  # they differ from the defaults on purpose
    and (group, name) != ("search", "stored")  # nothing is tuned: the grids are all there is
]
OF_THE_OPTION = {"GridSearch", "Protocol", "Scenario", "Vehicle"}
"""Classes whose options differ from each other on purpose."""


def objects(config):
    """Return place and settings of every object that is configured."""
    found = [(key, node) for key, node in config.items() if key in KINDS and isinstance(node, dict)]
    found = [one for one in found if one[0] != "data" or "kind" in one[1]]  # evaluate.py's has none
    parts = [
        (key, node[key])
        for place, node in found
        for key in PARTS.get(place, ())
        if isinstance(node.get(key), dict)
    ]
    return found + parts


def composed(*overrides, name="train"):
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        return compose(name, overrides=list(overrides))


@pytest.mark.representatives(3)
@pytest.mark.every_value
@pytest.mark.parametrize("name", NAMES["model"])
@pytest.mark.parametrize("protocol", NAMES["protocol"])
def test_every_model_instantiates_under_every_protocol(name, protocol):
    config = composed(f"model={name}", f"protocol={protocol}")
    groups = build(config, "protocol").groups
    for group in groups:
        config.group = group
        assert type(build(config, "model")) is METHODS[name.removesuffix("_table5")]


@pytest.mark.representatives(10)
@pytest.mark.parametrize(("group", "name"), OPTIONS)
def test_every_option_shows_every_argument_and_the_same_defaults(group, name):
    program = PROGRAM.get(group, "train")
    config = composed(f"{group}={name}", name=program)
    check_arguments(OmegaConf.to_container(config, resolve=False))


def test_programs_and_bases_show_the_same_defaults():
    check_arguments(OmegaConf.to_container(composed(name="evaluate"), resolve=False))
    check_arguments(OmegaConf.to_container(composed(name="serve"), resolve=False))
    base = OmegaConf.to_container(OmegaConf.load(CONFIGS / "base" / "protocol.yaml"))
    first = OmegaConf.to_container(OmegaConf.load(CONFIGS / "scenarios.yaml")).pop("healthy")
    check_arguments({"protocol": base, "scenario": first}, of_the_option=())


def check_arguments(config, of_the_option=OF_THE_OPTION):
    """Assert that every object of a configuration has the arguments and defaults of its class."""
    for place, settings in objects(config):
        node = dict(settings)
        target = class_of(place, node.pop("kind", None))
        if target is best_generator:
            target = VerticalVehicle  # which it hands its settings to
        parameters = dict(inspect.signature(target).parameters)
        optional = (*GEOMETRY, "limits") if target is Vehicle else ()
        assert set(parameters) - set(optional) <= set(node) <= set(parameters), target
        if target.__name__ in of_the_option:
            continue
        defaults = {key: default(target, key, p.default) for key, p in parameters.items()}
        for key, value in node.items():
            if defaults[key] is inspect.Parameter.empty or "${" in str(value):
                continue
            if isinstance(value, dict) and not defaults[key]:
                continue  # spelled out; nothing stands for the same, see the next tests
            if key in PARTS.get(place, ()):
                continue  # an object of its own, which is checked by itself
            if target is VerticalVehicle and key == "parts" and value:
                continue  # what generator=family is there to change, see below
            if (target.__name__, key) != ("FleetSettings", "workers"):  # none unasked in a library
                assert value == defaults[key], (target, key)


def default(target, key, value):
    """Return the default of an argument as YAML holds it."""
    if is_dataclass(target):
        (field,) = (field for field in fields(target) if field.name == key)
        value = value if field.default_factory is MISSING else field.default_factory()
    return plain(value)


def plain(value):
    """Return a value as YAML holds it."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, tuple) else value


def test_mappings_that_are_spelled_out_say_what_their_class_does_without():
    config = composed(name="simulate")
    fleet = build(config, "fleet")
    assert fleet.loggers() == replace(fleet, sensors=None).loggers()


def test_family_is_the_best_generator_with_more_parts_and_sensors_off_the_middle():
    best, family = (composed(f"generator={name}", name="simulate") for name in ("best", "family"))
    found = [OmegaConf.to_container(one.generator, resolve=True) for one in (best, family)]
    changed = {key for key, value in found[1].items() if value != found[0][key]}
    assert found[0].keys() == found[1].keys()
    assert changed == {"parts", "sensor_lateral_m"}
    assert found[0]["parts"] == []
    assert composed("generator=family").generator.sensor_lateral_m == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("name", NAMES["protocol"])
def test_protocol_file_shows_every_setting_of_peaks_and_its_default(name):
    settings = OmegaConf.to_container(composed(f"protocol={name}").protocol.features)
    parameters = inspect.signature(PeakFeatures).parameters
    assert settings == {key: p.default for key, p in parameters.items() if key != "peaks"}


@pytest.mark.parametrize(
    "name",
    [
        *NAMES["reading"][:3],
        *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES["reading"][3:]),
    ],
)
def test_every_reading_composes(name):
    config = composed("experiment=readings", f"reading={name}", "group=II")
    assert build(config, "protocol").task("II").outputs
    assert build(config, "search").settings_of("linear") == [{}]


def test_vehicles_are_read_from_their_files():
    vehicles = read_vehicles()
    assert list(vehicles) == NAMES["vehicle"] == [one.name for one in vehicles.values()]
    assert all(vehicle.source for vehicle in vehicles.values())
    for name in ("am96", "sedan"):
        assert vehicles[name] == build(composed(f"vehicle={name}"), "vehicle")


@pytest.mark.parametrize("name", NAMES["protocol"])
def test_every_protocol_has_tuned_values_for_its_groups(name):
    config = composed(f"protocol={name}")
    protocol = build(config, "protocol")
    assert isinstance(protocol, Protocol)
    assert protocol.name == name
    others = {"all"} if name == "paper" else set()  # which reads trips; experiments train I and II
    assert set(config.tuned) == set(protocol.groups) == set(config.groups.split(",")) | others
    assert config.group in protocol.groups
    methods = {"msvr", "msvr_table5", "svr", "mvgpr"}
    assert all(set(values) == methods for values in config.tuned.values())


@pytest.mark.parametrize("protocol", [name for name in NAMES["protocol"] if name != "trips"])
def test_tuned_values_lie_in_table_v_or_in_the_widened_box(protocol):
    ranges = {"C": (1, 100), "sigma": (1e-3, 100), "epsilon": (1e-6, 1e-3)}
    for methods in composed(f"protocol={protocol}").tuned.values():
        for key, value in methods.msvr_table5.items():
            assert ranges[key][0] <= value <= ranges[key][1]
        assert all(0 < value <= 1e9 for values in methods.values() for value in values.values())


@pytest.mark.parametrize("group", ["experiment", "study"])
def test_every_experiment_and_study_composes(group):
    for name in NAMES[group]:
        config = composed(f"{group}={name}", name=PROGRAM.get(group, "train"))
        assert config.job == name


@pytest.mark.parametrize("kind", ["svm", "null", "[msvr]", "suspnet.learning.MSVR"])
def test_unknown_kind_is_refused_with_those_there_are(kind):
    with pytest.raises(ValueError, match=r"`model\.kind` must be one of curve_fit, linear, msvr"):
        build(composed(f"model.kind={kind}"), "model")


def test_slurm_preset_asks_for_modest_jobs():
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        config = compose("train", ["hydra/launcher=slurm"], return_hydra_config=True)
    launcher = config.hydra.launcher
    assert launcher._target_.endswith("SlurmLauncher")
    assert (launcher.timeout_min, launcher.cpus_per_task, launcher.mem_gb) == (60, 8, 8)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("name", NAMES["protocol"])
def test_protocol_by_name_is_that_of_the_command_line(name):
    protocol, composed_one = read_protocol(name), build(composed(f"protocol={name}"), "protocol")
    assert vars(protocol) == vars(composed_one)
    assert all(protocol.task(group) == composed_one.task(group) for group in protocol.groups)


def test_protocol_of_an_unknown_name_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match=r"'multi_location', .*got 'trip'"):
        read_protocol("trip")
