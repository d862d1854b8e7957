"""The registry of kinds: what a configuration may name, and the object that is built from it.

A configuration names a kind (``kind: msvr``) and its settings, but nothing to import or call.
Modules take seconds to import, so each is imported only when it is needed.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf

from suspnet.cli.config_files import CONFIGS, read_settings
from suspnet.ground.parameters import DEFAULT_LIMITS, Limits, read_limits
from suspnet.ground.settings import check_choice

if TYPE_CHECKING:
    from suspnet.curves.protocols import Protocol
    from suspnet.trains.pages.board import BoardSettings
    from suspnet.vehicle import Vehicle
    from suspnet.vehicle.rig import Rig

KINDS: dict[str, dict[str, str | type]] = {
    "data": {
        "curves": "suspnet.curves.curves.CurveSettings",
        "trips": "suspnet.curves.estimates.EstimateSettings",
    },
    "generator": {
        "best": "suspnet.vehicle.best_generator",
        "quarter_car": "suspnet.vehicle.QuarterCar",
        "vertical_vehicle": "suspnet.vehicle.VerticalVehicle",
    },
    "model": {
        "curve_fit": "suspnet.learning.CurveFit",
        "linear": "suspnet.learning.LinearRegression",
        "msvr": "suspnet.learning.MSVR",
        "mvgpr": "suspnet.learning.MVGPR",
        "ridge": "suspnet.learning.KernelRidge",
        "svr": "suspnet.learning.SVR",
    },
    "source": {
        "folder": "suspnet.depot.live.drop_folder.DropFolder",
        "mqtt": "suspnet.depot.live.mqtt.Mqtt",
    },
    # where there is one kind only, a configuration need not name it
    "broker": {"": "suspnet.depot.live.broker.Broker"},
    "changes": {"": "suspnet.trains.maintenance.change.ChangeSettings"},
    "fleet": {"": "suspnet.trains.simulation.fleet.Fleet"},
    "live": {"": "suspnet.depot.live.sections.LiveSettings"},
    "monitor": {"": "suspnet.trains.jobs.fleet.FleetSettings"},
    "order": {"": "suspnet.trains.recordings.assembler.OrderSettings"},
    "plan": {"": "suspnet.trains.maintenance.plan.PlanSettings"},
    "protocol": {"": "suspnet.curves.protocols.Protocol"},
    "scenario": {"": "suspnet.trains.simulation.fleet.Scenario"},
    "search": {"": "suspnet.learning.search.GridSearch"},
    "trips": {"": "suspnet.estimation.trip_settings.TripSettings"},
    "vehicle": {"": "suspnet.vehicle.Vehicle", "rig": "suspnet.vehicle.rig.Rig"},
}
"""Kinds and the class of each, by the key below which the object is configured; a class itself
where ``suspnet.register_method`` has added it."""
PARTS: Mapping[str, tuple[str, ...]] = {
    "generator": ("vehicle",),
    "live": ("order",),
    "monitor": ("changes", "trips"),
    "source": ("broker",),
}
"""Keys of an object's settings that are objects themselves."""


def build(config: DictConfig, name: str) -> Any:
    """Return the object that is configured below a key, such as ``model`` or ``monitor.changes``.

    ValueError if nothing is configured there, or a kind or a setting is unknown.
    """
    node, place = OmegaConf.select(config, name), name.rpartition(".")[2]
    if not isinstance(node, DictConfig):
        raise ValueError(f"`{name}` must be an option of the group {place}, got {node!r}")
    missing = sorted(OmegaConf.missing_keys(node))
    if missing:
        raise ValueError(f"Missing mandatory value: {missing[0]}")
    choices = HydraConfig.get().runtime.choices if HydraConfig.initialized() else {}
    return _built(plain(node), name, choices.get("vehicle"))


def plain(node: Any) -> Any:
    """Return a value of a configuration as plain lists, mappings and values."""
    if not OmegaConf.is_config(node):
        return node
    return OmegaConf.to_container(node, resolve=True, throw_on_missing=True)


def class_of(place: str, kind: Any = None) -> Callable[..., Any]:
    """Return what builds an object: the class of a kind, or the only one of its place."""
    path = KINDS[place][kind or ""]
    if not isinstance(path, str):
        return path
    home, _, name = path.rpartition(".")
    class_: Callable[..., Any] = getattr(import_module(home), name)
    return class_


def _built(values: Mapping[str, Any], name: str, vehicle: str | None = None) -> Any:
    """Return an object built from its settings, after the objects among them."""
    place = name.rpartition(".")[2]
    kind = values.get("kind", "")
    if not isinstance(kind, str) or kind not in KINDS[place]:
        named = [key for key in KINDS[place] if key]
        rule = f"one of {', '.join(named)}" if named else "left out"
        rule += ", or left out" if named and "" in KINDS[place] else ""
        raise ValueError(f"`{name}.kind` must be {rule}, got {kind!r}")
    class_ = class_of(place, kind)
    if kind == "rig" and any(key.endswith(("_n_per_m", "_ns_per_m")) for key in values):
        numbers = {key: value for key, value in values.items() if key != "kind"}
        return class_.of(_built(numbers, name, vehicle))  # type: ignore[attr-defined]
    arguments = {
        key: _built(value, f"{name}.{key}", vehicle)
        if key in PARTS.get(place, ()) and isinstance(value, dict)
        else value
        for key, value in values.items()
        if key != "kind"
    }
    file = f"vehicle/{vehicle}.yaml: " if vehicle and place == "vehicle" else ""
    # name what is unknown or missing here: the class would name itself, and no key
    parameters = inspect.signature(class_).parameters
    unknown = [key for key in arguments if key not in parameters]
    if unknown and not any(p.kind == p.VAR_KEYWORD for p in parameters.values()):
        near = difflib.get_close_matches(unknown[0], parameters.keys() - arguments.keys(), 1)
        meant = f"; did you mean {near[0]}?" if near else ""
        raise ValueError(
            f"{file}`{name}.{unknown[0]}` is no setting of {place}: --help lists them{meant}"
        )
    required = [
        key
        for key, parameter in parameters.items()
        if parameter.default is parameter.empty
        and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    ]
    if missing := [key for key in required if key not in arguments]:
        raise ValueError(f"{file}`{name}.{missing[0]}` is missing")
    try:
        return class_(**arguments)
    except (AttributeError, LookupError) as error:  # a value of an unexpected type
        raise ValueError(f"{file}`{name}` cannot be built: {error}") from error
    except (TypeError, ValueError) as error:
        if not file:
            raise
        raise type(error)(f"{file}{error}") from error


def read_vehicles(folder: str | Path = CONFIGS) -> dict[str, Vehicle]:
    """Return the vehicles in the group `vehicle` of a folder, by file name.

    Rigs are left out. Nothing else is built from the files, and interpolations are not resolved.

    Raises
    ------
    FileNotFoundError, TypeError, ValueError
        If the folder has no ``vehicle/NAME.yaml``, or a number of one is missing or wrong.
    """
    return _of_kind(folder, of_rigs=False)


def read_rigs(folder: str | Path) -> dict[str, Rig]:
    """Return the rigs in the group `vehicle` of a folder, by file name; raises as `read_vehicles`.

    They are the files with ``kind: rig``.
    """
    return _of_kind(folder, of_rigs=True)


def _of_kind(folder: str | Path, of_rigs: bool) -> dict[str, Any]:
    files = dict(_vehicle_files(folder))
    if not files:
        raise FileNotFoundError(
            f"{folder} holds no vehicles: each is a file vehicle/NAME.yaml in it"
        )
    vehicles: dict[str, Any] = {}
    for file, numbers in files.items():
        try:
            vehicle = _built(numbers, "vehicle")
        except (TypeError, ValueError) as error:
            raise type(error)(f"{file}: {error}") from error
        if (numbers.get("kind") == "rig") == of_rigs:
            vehicles[file.stem] = vehicle
    return vehicles


def _vehicle_files(folder: str | Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield each file of a vehicle, and its numbers."""
    for file in sorted((Path(folder) / "vehicle").glob("*.yaml")):
        _, content = read_settings(file)
        vehicle = content.get("vehicle", content)  # a road's file also sets a speed and a track
        if not isinstance(vehicle, dict):
            raise ValueError(f"{file} is no vehicle: its numbers are missing")
        yield file, {str(key): vehicle[key] for key in vehicle}


def _limits_of_vehicles(folder: Path) -> dict[str, dict[str, Limits]]:
    """Return ``Vehicle.known_limits`` by name of vehicle; torch is not imported, which is slow."""
    limits = {}
    for file, numbers in _vehicle_files(folder):
        try:
            name = numbers["name"]
            limits[name] = read_limits(
                numbers.get("limits") or {}, DEFAULT_LIMITS, f"the file of vehicle {name}"
            )
        except (LookupError, TypeError, ValueError) as error:
            raise ValueError(f"{file}: {error}") from error
    return limits


def vehicles_with(folder: Path | None) -> dict[str, Vehicle]:
    """Return suspnet's vehicles, and those of a user's folder (`--config-dir`) if there is one."""
    return read_vehicles() | (read_vehicles(folder) if folder else {})


def board_settings(config: DictConfig, alarms: DictConfig) -> BoardSettings:
    """Return the settings of a fleet's states and plan; `alarms` holds limits and changes."""
    from suspnet.trains.pages.board import BoardSettings  # imports the store

    sources = (Path(source.path) for source in HydraConfig.get().runtime.config_sources)
    folders = (folder for folder in sources if (folder / "vehicle").is_dir())
    return BoardSettings(
        vehicles={
            name: limits
            for folder in folders
            for name, limits in _limits_of_vehicles(folder).items()
        },
        limits=plain(alarms.limits),
        changes=build(alarms, "changes"),
        plan=build(config, "plan"),
        today=config.today,
        seed=config.seed,
    )


def read_protocol(name: str) -> Protocol:
    """Return one of the protocols that ``protocol=NAME`` chooses on the command line.

    Raises
    ------
    ValueError
        If `name` is none of them.

    Examples
    --------
    >>> read_protocol("trips").task("all").outputs
    ('k_p', 'c_p', 'k_s', 'c_s', 'M_s')
    """
    check_choice("name", name, sorted(f.stem for f in (Path(CONFIGS) / "protocol").glob("*.yaml")))
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        protocol: Protocol = build(compose(overrides=[f"+protocol={name}"]), "protocol")
    return protocol


def named_runs(named: Any) -> list[Path]:
    """Return the model folders that `run=` names: a run, a multirun or a list of these."""
    from suspnet.runs.evaluate import find_runs  # with torch, which takes seconds

    several = named if isinstance(named, ListConfig | list) else [named]
    return list(dict.fromkeys(run for path in several for run in find_runs(Path(path))))
