"""Hydra's loader of configurations; a file of ``--config-dir`` sets what `ALLOWED` lists, no more.

Such a file may come from someone else: it holds numbers and words that say what is simulated,
learnt and watched. Places to write to, hosts, credentials and Hydra's own settings are given on the
command line, which is the user's.
"""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from suspnet.cli.config_files import CONFIGS, read_settings
from suspnet.depot.live.broker import HOST_VARIABLE

ALLOWED = frozenset(
    """
    changes figures fleet generator group groups job limits live model plan protocol
    refine scenario search seed sensor_lateral_m speed_m_per_s track tuned vehicle
    data.body_high_hz data.high_hz data.kind data.low_hz data.method data.minutes data.n_calibrate
    data.n_test data.n_train data.noise_on data.overlap data.rates_hz data.segment_s
    data.snr_db
    data.speed_half_width data.speed_m_per_s data.step_hz data.track data.window
    monitor.changes monitor.limits monitor.trips
    source.broker.ca_file source.broker.port source.broker.tls source.broker.user
    """.split()
)
"""Keys that a file of ``--config-dir`` may set, with all that is below them."""
GROUPS = "data experiment generator model protocol reading scenario search vehicle".split()
"""Groups whose options the list of defaults in such a file may choose."""
TEXTS = ("ca_file", "reason", "source", "why")
"""Last keys of free texts, and of a path that is only read; other texts are plain words."""
NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
WORDS = re.compile(r"(?!\.)[\w ,.:;+-]*")
"""Text that is neither a path, nor an interpolation, nor a function of Hydra's command line."""
SHARED = re.compile(r"\$\{(device|group|seed|speed_m_per_s|track)\}")
"""Interpolations that may take the place of a value."""
OPTION = re.compile(r"\w[\w.+-]*")
OF_HEALTHY = "experiment=trips"  # experiment of models that are commissioned on healthy trips


def check_settings(settings: dict[Any, Any]) -> None:
    """Raise ValueError unless a part of a whole configuration sets plain values of `ALLOWED` only.

    What is below a key of `ALLOWED` is allowed, if all its names and texts are plain.
    """
    stack: list[tuple[str, Any, bool]] = [("", settings, False)]
    while stack:  # ends: each value of the file is taken off once
        key, value, is_allowed = stack.pop()
        is_allowed |= key in ALLOWED
        leads_on = isinstance(value, dict) and any(entry.startswith(f"{key}.") for entry in ALLOWED)
        if key and not is_allowed and not leads_on:
            below = ".KEY" if isinstance(value, dict) else ""
            raise ValueError(
                f"`{key}` cannot be set in a file of --config-dir, which may come from someone "
                f"else: give it on the command line, {key}{below}=VALUE"
            )
        if isinstance(value, dict):
            for name, entry in value.items():
                below = f"{key}.{name}".lstrip(".")
                if not isinstance(name, str) or not NAME.fullmatch(name):
                    raise ValueError(f"`{below}` is no setting: names are letters, digits and _")
                stack.append((below, entry, is_allowed))
        elif isinstance(value, list):
            stack += [(key, entry, is_allowed) for entry in value]
        elif isinstance(value, str):
            _check_text(key, value)


def _check_text(key: str, value: str) -> None:
    is_free = key.rpartition(".")[2] in TEXTS and "$" not in value
    if not (is_free or WORDS.fullmatch(value) or SHARED.fullmatch(value)):
        raise ValueError(
            f"`{key}` must be a number, or words of letters, digits and , . : ; + - without a dot "
            f"in front; got {value!r}: give it on the command line"
        )


def _check_defaults(defaults: Any) -> None:
    """Raise ValueError unless a list of defaults names plain options of known groups.

    It names one option of the file's own group at most: several in each file would multiply.
    """
    n_own = 0
    for entry in defaults if isinstance(defaults, list) else [defaults]:
        (choice,) = entry.items() if isinstance(entry, dict) and len(entry) == 1 else [("", entry)]
        n_own += choice[0] == "" and entry != "_self_"
        is_known = choice[0] in ("", *(f"override /{group}" for group in GROUPS))
        if n_own > 1 or not is_known or not OPTION.fullmatch(str(choice[1])):
            raise ValueError(
                "`defaults` may hold _self_, one option of the same group, and `override /GROUP: "
                f"OPTION` of {', '.join(GROUPS)}; got {entry!r}"
            )


def _check_package(package: str | None, group: str) -> None:
    """Raise ValueError unless the keys of a file are those of its group, or ``_global_``."""
    if not group or package not in (None, "_global_"):
        raise ValueError("it must be GROUP/NAME.yaml, with no `# @package` but `_global_`")
    if package is None and group not in {key.partition(".")[0] for key in ALLOWED}:
        raise ValueError(
            f"an option of `{group}` has no keys of its own to set here; with a first line "
            "`# @package _global_` keys are those of the whole configuration"
        )


class _TheirFolder(FileConfigSource):
    """A folder of ``--config-dir``, of whose files Hydra gets checked content only."""

    has_broker = False  # whether the user has named the broker's host

    def load_config(self, config_path: str) -> ConfigResult:
        """Return the content of a file; ValueError if it sets more than it may."""
        file = Path(self.path, self._normalize_file_name(config_path))
        text, content = read_settings(file)
        try:
            header = self._get_header_dict(text[:512])
            group = config_path.rpartition("/")[0].replace("/", ".")
            _check_package(header["package"], group)
            _check_defaults(content.get("defaults", []))
            settings = {key: value for key, value in content.items() if key != "defaults"}
            if header["package"] is None:
                settings = {group: settings}
            check_settings(settings)
            if "source" in settings and not self.has_broker:
                raise ValueError(
                    "it sets `source.broker`: name the broker's host yourself, source.broker.host="
                    f"NAME on the command line, or export {HOST_VARIABLE}=NAME"
                )
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from error
        return ConfigResult(self.provider, f"file://{self.path}", OmegaConf.create(content), header)


class _CheckedRepository(ConfigRepository):
    """Hydra's repository of configurations; all files but suspnet's own are checked."""

    def initialize_sources(self, config_search_path: ConfigSearchPath) -> None:
        """Let a checked folder take the place of each that is not suspnet's own."""
        super().initialize_sources(config_search_path)
        self.sources = [
            _TheirFolder(source.provider, source.path)
            if source.scheme() == "file" and not os.path.samefile(source.path, CONFIGS)
            else source
            for source in self.sources
        ]

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Load a configuration; ValueError if its path leads out of its folder."""
        if Path(config_path).is_absolute() or ".." in Path(config_path).parts:
            raise ValueError(
                f"{config_path!r} leads out of the folder of configurations; name an option of a "
                "group"
            )
        result: ConfigResult | None = super().load_config(config_path)
        return result


class CheckedLoader(ConfigLoaderImpl):
    """Hydra's configuration loader, which takes settings alone from the files of others."""

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
        """Compose a configuration, and of a multirun each job; ValueError for what is refused."""
        parsed = OverridesParser.create().parse_overrides(overrides)
        typed = {override.key_or_group for override in parsed}
        if "hydra.searchpath" in typed:  # a package on it would be imported, and so run
            raise ValueError(
                "`hydra.searchpath` cannot be set; name your folder with --config-dir FOLDER"
            )
        if config_name == "train":
            values = {override.key_or_group: _text(override) for override in parsed}
            vehicles = self.repository.get_group_options("vehicle")
            overrides = [*overrides, *of_healthy(values, vehicles, self._vehicle_name)]
        theirs = [source for source in self.get_sources() if isinstance(source, _TheirFolder)]
        for source in theirs:
            is_named = "source.broker.host" in typed
            source.has_broker = is_named or bool(os.environ.get(HOST_VARIABLE))
        config = super().load_configuration(
            config_name, overrides, run_mode, from_shell, validate_sweep_overrides
        )
        if run_mode == RunMode.MULTIRUN and validate_sweep_overrides and theirs:
            # the sweeper would write a file before it composes the jobs
            swept = [f"{key}={value}" for key, value in (config.hydra.sweeper.params or {}).items()]
            parser = OverridesParser.create(config_loader=self)
            all_of_them = parser.parse_overrides([*swept, *config.hydra.overrides.task])
            for job in BasicSweeper.split_arguments(all_of_them, None)[0]:
                self.load_sweep_config(config, job)
        return config

    def _vehicle_name(self, option: str) -> str | None:
        result = self.repository.load_config(f"vehicle/{option}")
        return None if result is None else OmegaConf.select(result.config, "name")


def _text(override: Override) -> str:
    """Return the value of an override as text, without the quotes that are around it."""
    value = None if override.is_sweep_override() else override.value()
    return value if isinstance(value, str) else (override.input_line or "").partition("=")[2]


def of_healthy(
    typed: Mapping[str, str | None], options: Sequence[str], name_of: Callable[[str], str | None]
) -> list[str]:
    """Return the overrides that a folder of healthy trips implies where the user gives none.

    `typed` are the values of the keys and groups that the command line sets, as text. `options`
    are those of the group `vehicle`, of which `name_of` returns the name of the vehicle.
    """
    folder = typed.get("healthy")
    if not folder or folder == "null" or "experiment" in typed:
        return []
    overrides = [OF_HEALTHY]
    if "vehicle" not in typed and (vehicle := _vehicle_in(Path(folder))):
        named = [vehicle] if vehicle in options else []
        named += [option for option in options if name_of(option) == vehicle]
        overrides += [f"vehicle={option}" for option in named[:1]]
    return overrides


def _vehicle_in(folder: Path) -> str | None:
    """Return the vehicle of the first manifest in a folder or its subfolders; None without one.

    What is wrong with the folder, or missing to read trips, is said when they are read.
    """
    with suppress(ImportError, OSError, ValueError):
        from suspnet.trains.recordings.manifest_files import ManifestFile, find_manifests

        for place in (folder, *sorted(path for path in folder.iterdir() if path.is_dir())):
            with suppress(OSError, ValueError):
                content = ManifestFile(find_manifests(place)[0]).content
                return content.get("vehicle") if isinstance(content, dict) else None
    return None
