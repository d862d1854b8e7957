"""Values of a configuration: switches, numbers, and what only the command line may set.

A configuration may come from someone else. The user therefore names the folders and stores to write
to, and the hosts that receive samples, estimates and credentials: on the command line, or for a
broker's host in an environment variable.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, ListConfig, OmegaConf

from suspnet.cli.config_files import CONFIGS, LOADER
from suspnet.ground.checks import check_number
from suspnet.live.broker import HOST_VARIABLE, LOCAL

SWITCHES = frozenset(
    {
        "check_channels",
        "distributed",
        "estimate_mass",
        "figures",
        "fit_intercept",
        "log_ratios",
        "mass_known",
        "once",
        "open_browser",
        "open_to_network",
        "progress",
        "refine",
        "short_waves",
        "tls",
    }
)
"""Keys that are either on or off, in whichever group they are."""
WORDS = {"yes": True, "on": True, "true": True, "no": False, "off": False, "false": False}
"""Values of a switch written as text; Hydra's command line knows true and false only."""


def read_values(config: DictConfig) -> None:
    """Make each switch of a configuration a boolean; check that each number is finite.

    TypeError or ValueError for any other value of a switch, and for a number that is NaN, infinite
    or beyond `LARGEST` of ``suspnet.ground.checks``.
    """
    stack: list[tuple[str, Any]] = [("", config)]
    while stack:  # ends: a configuration as written is a tree
        path, node = stack.pop()
        keys: Any = node.keys() if isinstance(node, DictConfig) else range(len(node))
        for key in keys if not node._is_none() and not node._is_interpolation() else ():
            if OmegaConf.is_interpolation(node, key) or OmegaConf.is_missing(node, key):
                continue
            name, value = f"{path}.{key}".lstrip("."), node[key]
            if key in SWITCHES:
                node[key] = _switch(name, value)
            elif isinstance(value, DictConfig | ListConfig):
                stack.append((name, value))
            elif isinstance(value, int | float) and not isinstance(value, bool):
                check_number(name, value)


def _switch(name: str, value: Any) -> bool:
    if isinstance(value, bool):
        return value
    known = WORDS.get(value.lower()) if isinstance(value, str) else None
    if known is None:
        raise ValueError(f"`{name}` must be one of {', '.join(WORDS)}; got {value!r}")
    return known


BROKERS = ("source", "sink")
"""Groups whose options connect to a broker, configured below `broker`."""
PLACES = ("resume", "out", "data.cache_dir", "store", "journal", "tensorboard", "sink.folder")
"""Keys of paths that are written to; someone else's file may not choose them."""
OF_HYDRA = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")


def check_typed(config: DictConfig, typed: Collection[str]) -> None:
    """Raise ValueError unless the user has named each path and host that would be written to.

    `typed` holds the keys of the command line, without those of files and of what a multirun
    varies.

    A path must be as shipped or on the command line. Settings of a broker must be as shipped,
    unless the command line or the environment names its host. Only the command line opens pages to
    the network.
    """
    _check_places(config, typed)
    written = OmegaConf.to_container(config, resolve=False)
    assert isinstance(written, dict)
    for group in BROKERS:
        if group in written:
            _check_broker(group, written[group], typed)
    if written.get("open_to_network", False) is not False and "open_to_network" not in typed:
        raise ValueError(
            "pages are opened to the network on the command line only: open_to_network=true"
        )
    swept = OmegaConf.to_container(config.hydra.sweeper.get("params") or DictConfig({}))
    for key in swept if isinstance(swept, dict) else ():
        if str(key).lstrip("+~").split(".")[0] in (*BROKERS, "store", "open_to_network"):
            raise ValueError(f"`hydra.sweeper.params.{key!s}` is swept on the command line only")


def _check_broker(group: str, option: Any, typed: Collection[str]) -> None:
    """Raise ValueError if a broker is not as shipped and the user has not named its host."""
    broker = option.get("broker", {}) if isinstance(option, dict) else option
    if not isinstance(broker, dict):  # an interpolation would hide the value
        raise ValueError(f"`{group}` must be an option of the group {group}, got {broker!r}")
    shipped = _shipped_broker()
    host = broker.get("host")
    if host == LOCAL:
        shipped = shipped | {"host": LOCAL}
    foreign = [
        key
        for key, value in broker.items()
        if f"{group}.broker.{key}" not in typed and (key not in shipped or value != shipped[key])
    ]
    in_environment = os.environ.get(HOST_VARIABLE)
    is_named = f"{group}.broker.host" in typed or (
        bool(in_environment) and host in (None, in_environment)
    )
    if foreign and not is_named:
        raise ValueError(
            f"`{group}.broker.{foreign[0]}` is {broker[foreign[0]]!r} in a configuration: name the "
            f"broker's host yourself, {group}.broker.host=NAME on the command line or "
            f"export {HOST_VARIABLE}=NAME"
        )


@functools.cache
def _shipped_broker() -> dict[str, Any]:
    shipped = OmegaConf.to_container(OmegaConf.load(Path(CONFIGS) / "base" / "broker.yaml"))
    assert isinstance(shipped, dict)
    return {str(key): value for key, value in shipped.items()}


def _check_places(config: DictConfig, typed: Collection[str]) -> None:
    """Raise ValueError if a file, not the command line, sets a path that is written to."""
    for key in (*PLACES, *OF_HYDRA):
        above, _, last = key.rpartition(".")
        node = OmegaConf.select(config, above) if above else config
        if key in typed or not isinstance(node, DictConfig) or last not in node:
            continue
        written = OmegaConf.to_container(node, resolve=False)
        assert isinstance(written, dict)
        value = written[last]
        if value not in _shipped_places(key) and (value is not None or key in OF_HYDRA):
            raise ValueError(
                f"`{key}` can be named on the command line only, as files are written there; got "
                f"{value!r}"
            )
        if key in PLACES and not OmegaConf.is_missing(node, last) and value is not None:
            place = Path(str(node[last]))
            if place.is_absolute() or ".." in place.parts:
                raise ValueError(
                    f"`{key}` leads to {place}: what its name is made of must be plain names; "
                    f"{key}= on the command line names another place"
                )


@functools.cache
def _shipped() -> list[tuple[Path, Any]]:
    files = Path(CONFIGS).rglob("*.yaml")
    return [(file, yaml.load(file.read_bytes(), LOADER)) for file in files]


@functools.cache
def _shipped_places(key: str) -> list[Any]:
    """Return the values of a key in the shipped configurations, uninterpolated."""
    found = []
    group, _, rest = key.partition(".")
    for file, content in _shipped():
        value: Any = content
        for part in rest.split(".") if file.parent.name == group else key.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if value is not None:
            found.append(value)
    return found
