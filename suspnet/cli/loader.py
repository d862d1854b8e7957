"""Hydra's loader of configurations, with checks of each one as soon as it is composed.

A configuration may come from someone else. The user therefore names the folders and stores to write
to, and the hosts that receive samples, estimates and credentials: on the command line, or for a
broker's host in an environment variable.
"""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from suspnet.cli.config_files import CONFIGS, as_written, check_file
from suspnet.cli.trusted import check_configuration
from suspnet.live.broker import HOST_VARIABLE, LOCAL
from suspnet.recordings.core_yaml import LOADER

BROKERS = ("source", "sink")
"""Groups whose options connect to a broker, configured below `broker`."""
PLACES = ("resume", "out", "data.cache_dir", "store", "journal", "tensorboard", "sink.folder")
"""Keys of paths that are written to; someone else's file may not choose them."""
CLUSTER = "monitor.cluster"
"""Key of the scheduler's address; its workers unpickle, and so run, what they receive."""
OF_ACCESS = ("user_header", "trusted_proxies", "engineers", "token_file")
"""Keys that say who may see and acknowledge; someone else's file may not choose them."""
RULES = "notify"
"""Key of the file that says where alarms, and passwords of servers, are sent."""
OF_HYDRA = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")


class _CheckedRepository(ConfigRepository):
    """Hydra's repository of configuration files; a user's files are checked before they are read.

    Aliases or an endless file could otherwise take all memory.
    """

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Load a configuration; ValueError if its path or its file is not allowed."""
        parts = Path(config_path)
        if parts.is_absolute() or ".." in parts.parts:
            raise ValueError(
                f"{config_path!r} leads out of the folder of configurations; name an option of a "
                "group"
            )
        source = self._find_object_source(config_path, ObjectType.CONFIG)
        if source is not None and source.provider == "command-line" and source.scheme() == "file":
            file = Path(source.path, source._normalize_file_name(config_path))
            check_file(file)
        found: ConfigResult | None = super().load_config(config_path)
        return found


class CheckedLoader(ConfigLoaderImpl):
    """Hydra's configuration loader, which refuses a configuration that would run foreign code."""

    _typed: frozenset[str] | None = None
    """Keys of the command line, from the first load; later loads are the jobs of a multirun."""

    def __init__(self, config_search_path: ConfigSearchPath) -> None:
        super().__init__(config_search_path)
        self.repository = _CheckedRepository(config_search_path)

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Compose and check a configuration, and each job of a multirun.

        ValueError if it is not trusted, or if a file in a user's folder is not a plain file or is
        far too large.
        """
        try:
            config = super().load_configuration(
                config_name, overrides, run_mode, from_shell, validate_sweep_overrides
            )
        except AttributeError as error:  # Hydra reads its own block even if it is null
            raise ValueError("`hydra` must be a mapping, as shipped, or be left out") from error
        check_configuration(config)
        keys = {one.key_or_group for one in OverridesParser.create().parse_overrides(overrides)}
        if self._typed is None:
            self._typed = frozenset(keys)
        # places and hosts count as the user's own only if the command line names them
        # Hydra's own keys are not swept: those of a job are typed, or what `OwnFolder` chose
        check_typed(config, self._typed | {key for key in keys if key.startswith("hydra.")})
        foreign = any(source.provider == "command-line" for source in self.get_sources())
        if run_mode == RunMode.MULTIRUN and validate_sweep_overrides and foreign:
            # the sweeper would write a file before it composes the jobs
            for job in _jobs(config, self):
                self.load_sweep_config(config, job)
        return config

    def load_sweep_config(
        self, master_config: DictConfig, sweep_overrides: list[str]
    ) -> DictConfig:
        """Compose and check the configuration of a multirun's job.

        ValueError if it is not trusted, or if its folder would not be inside that of the multirun.
        """
        config = super().load_sweep_config(master_config, sweep_overrides)
        _check_subfolder(config)
        return config

    def _process_config_searchpath(
        self,
        config_name: str | None,
        parsed_overrides: list[Override],
        repo: CachingConfigRepository,
    ) -> None:
        """Refuse more search paths: composing from a package imports, and so runs, it."""
        loaded = None if config_name is None else repo.load_config(config_path=config_name)
        named = None if loaded is None else OmegaConf.select(loaded.config, "hydra.searchpath")
        typed = any(one.get_key_element() == "hydra.searchpath" for one in parsed_overrides)
        if named or typed:
            raise ValueError(
                "`hydra.searchpath` cannot be set; name your folder with --config-dir FOLDER"
            )


def _check_subfolder(config: DictConfig) -> None:
    """Raise ValueError unless the folder of a job lies directly in that of its multirun."""
    probe = copy.deepcopy(config)
    with read_write(probe.hydra), open_dict(probe.hydra):
        probe.hydra.job.num, probe.hydra.job.id = 0, "0"  # Hydra numbers the jobs later
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(probe)
    try:
        name = str(probe.hydra.sweep.subdir)
    finally:
        HydraConfig.instance().cfg = before
    if name in ("", ".", "..") or Path(name).name != name:
        raise ValueError(
            f"`hydra.sweep.subdir` must give a plain name for the folder of a job, got {name!r}"
        )


def _jobs(config: DictConfig, loader: ConfigLoaderImpl) -> list[list[str]]:
    """Return the overrides of each job of a multirun, as Hydra's basic sweeper finds them."""
    swept = [f"{key}={value}" for key, value in (config.hydra.sweeper.params or {}).items()]
    typed = list(config.hydra.overrides.task)
    overrides = OverridesParser.create(config_loader=loader).parse_overrides(swept + typed)
    (jobs,) = BasicSweeper.split_arguments(overrides, None)
    return jobs


def check_typed(config: DictConfig, typed: Collection[str]) -> None:
    """Raise ValueError unless the user has named each path and host that would be written to.

    `typed` holds the keys of the command line, without those of files and of what a multirun
    varies.

    A path must be as shipped or on the command line. Settings of a broker must be as shipped,
    unless the command line or the environment names its host. Only the command line opens pages to
    the network.
    """
    _check_places(config, typed)
    written = as_written(config)
    for group in BROKERS:
        if group in written:
            _check_broker(group, written[group], typed)
    if written.get("open_to_network", False) is not False and "open_to_network" not in typed:
        raise ValueError(
            "pages are opened to the network on the command line only: open_to_network=true"
        )
    for name in OF_ACCESS:
        if written.get(name) and name not in typed:
            raise ValueError(f"`{name}`, who may do what, is given on the command line only")
    if written.get(RULES) and RULES not in typed:
        raise ValueError(f"`{RULES}`, where alarms are sent, is given on the command line only")
    swept = OmegaConf.to_container(config.hydra.sweeper.get("params") or DictConfig({}))
    for key in swept if isinstance(swept, dict) else ():
        setting = str(key).lstrip("+~").split(".")[0]
        if setting in (*BROKERS, *OF_ACCESS, RULES, "store", "open_to_network"):
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
    return as_written(OmegaConf.load(Path(CONFIGS) / "base" / "broker.yaml"))


def _check_places(config: DictConfig, typed: Collection[str]) -> None:
    """Raise ValueError if a file, not the command line, sets a path that is written to."""
    for key in (*PLACES, *OF_HYDRA, CLUSTER):
        above, _, last = key.rpartition(".")
        node = OmegaConf.select(config, above) if above else config
        if key in typed or not isinstance(node, DictConfig) or last not in node:
            continue
        value = as_written(node)[last]
        if value not in _shipped_places(key) and (value is not None or key in OF_HYDRA):
            why = "what a scheduler sends is run" if key == CLUSTER else "files are written there"
            raise ValueError(
                f"`{key}` can be named on the command line only, as {why}; got {value!r}"
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
