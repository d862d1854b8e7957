"""Configuration files: their folder, what they may hold, and the `--help` that is made of them.

The comment lines right above a key, at its indentation, are one sentence on the key that ends with
its unit and range in brackets: ``# Length of a trip [min; above 0]``. The first comment of a file
describes the file.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf

from suspnet.ground.core_yaml import MOST_BYTES, parse_yaml
from suspnet.ground.settings import check_flag, check_number
from suspnet.ground.storage import read_plain

_PACKAGED = Path(__file__).parents[1] / "configs"
CONFIGS = str(_PACKAGED if _PACKAGED.is_dir() else _PACKAGED.parents[1] / "configs")
"""Absolute path of the folder that Hydra composes from: the package's, else the checkout's."""
TABLES = {"reading": ("readings.yaml", "_global_"), "scenario": ("scenarios.yaml", "scenario")}
"""File and package of each group whose options are the entries of one file."""


def is_shipped(vehicle: str) -> bool:
    """Return whether a vehicle is one of suspnet's."""
    return any(vehicle == file.stem for file in (Path(CONFIGS) / "vehicle").glob("*.yaml"))


def own_vehicles(vehicle: str) -> Path | None:
    """Return the folder here that holds vehicle/NAME.yaml of a user's vehicle.

    None if the vehicle is one of suspnet's, or none or several of the folders have such a file.
    """
    if not vehicle or is_shipped(vehicle) or Path(vehicle).name != vehicle:
        return None
    file = Path("vehicle") / f"{vehicle}.yaml"
    folders = [folder for folder in (Path(), *Path().iterdir()) if (folder / file).is_file()]
    return folders[0] if len(folders) == 1 else None


def as_written(config: Any, *, resolve: bool = False) -> dict[str, Any]:
    """Return a configuration as plain values, with interpolations as text unless `resolve`."""
    content = OmegaConf.to_container(config, resolve=resolve)
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def register() -> None:
    """Give Hydra the options of ``TABLES``, and ${described:}, the help of a configuration.

    The first entry of a table holds the common settings, and the others change it. A file
    GROUP/NAME.yaml in a user's folder (`--config-dir`) is an option like any other.
    """
    for group, (file, package) in TABLES.items():
        table = OmegaConf.load(Path(CONFIGS) / file)
        first = next(iter(table))
        for name, entry in table.items():
            node = entry if name == first else {"defaults": [first, "_self_"], **entry}
            ConfigStore.instance().store(name=str(name), node=node, group=group, package=package)
    OmegaConf.register_new_resolver("described", _described, replace=True)


def read_settings(file: Path) -> tuple[str, dict[Any, Any]]:
    """Return the text of a configuration and its content, with interpolations as text.

    ValueError if it is not a regular file, or not YAML that `parse_yaml` reads: a mapping without
    tags, whose aliases are bounded.
    """
    text = read_plain(file, MOST_BYTES).decode("utf-8-sig", errors="replace")
    try:
        content = parse_yaml(text) or {}
        if not isinstance(content, dict):
            raise ValueError("it must hold keys with their values")
    except ValueError as error:
        raise ValueError(f"{file} is no configuration: {error}") from error
    return text, content


NO_WORDS = re.compile(r"@package |python |suspnet[- ]\w+ ")
"""Start of lines in a file's first comment that are commands, or directives for Hydra."""


def phrase(file: Path) -> str:
    """Return the first line of the first comment of a file; "" if it has none."""
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.lstrip("# ")
        if not line.startswith("#"):
            break
        if words and not NO_WORDS.match(words):
            return words.rstrip(".")
    return ""


def _described(_root_: DictConfig) -> str:
    """Return groups with their options, then the files that are composed, as a Hydra template."""
    hydra = _root_.hydra
    sources = hydra.runtime.config_sources
    folders = [Path(source.path) for source in sources if source.schema == "file"]
    lines = ["Groups, chosen as GROUP=OPTION; * is chosen here:", ""]
    for group, chosen in reversed(hydra.runtime.choices.items()):
        if not group.startswith("hydra/"):
            options = _options(group, folders).items()
            shown = [f"  {'*' if key == chosen else ' '} {key:20} {text}" for key, text in options]
            lines += [f"{group}:", *shown, ""]
    lines.append("Keys, set as KEY=VALUE, in the files chosen here; --cfg job shows their values:")
    loader, task = GlobalHydra.instance().config_loader(), list(hydra.overrides.task)
    composed = loader.compute_defaults_list(hydra.job.config_name, task, RunMode.RUN)
    for part in composed.defaults:
        group, _, name = str(part.config_path).rpartition("/")
        files = [folder / f"{part.config_path}.yaml" for folder in folders]
        texts = [file.read_text("utf-8", "replace") for file in files if file.is_file()]
        for text in [*texts, *(text for key, text in _table(group) if key == name)][:1]:
            keys = f", keys of {part.package}" if part.package else ""
            content = "".join(block for block in _blocks(text) if not block.startswith("hydra:"))
            lines += ["", f"{'-' * 20} {part.config_path}{keys}", content.rstrip("\n")]
    return "\n".join(lines).replace("$", "$$") + "\n"


def _options(group: str, folders: Iterable[Path]) -> dict[str, str]:
    """Return a phrase on each option of a group."""
    files = sorted(file for folder in folders for file in (folder / group).glob("*.yaml"))
    phrases = {file.stem: phrase(file) for file in files}
    for name, text in _table(group):
        phrases[name] = text.partition("\n")[0].partition("# ")[2]
    return phrases


def _table(group: str) -> list[tuple[str, str]]:
    """Return name and text of each option of a group of ``TABLES``; none for other groups."""
    if group not in TABLES:
        return []
    text = (Path(CONFIGS) / TABLES[group][0]).read_text("utf-8")
    return [(block.partition(":")[0], block) for block in _blocks(text)[1:]]


def _blocks(text: str) -> list[str]:
    """Return what stands before the first outermost key of a file, then each key with its value."""
    return re.split(r"^(?=\w)", text, flags=re.MULTILINE)


SWITCHES = frozenset(
    "by_part check_channels estimate_mass figures fit_intercept log_ratios mass_known once "
    "open_browser open_to_network progress refine standardised tls".split()
)
"""Keys that are either on or off, in whichever group they are."""


def check_values(config: DictConfig) -> None:
    """Raise TypeError or ValueError unless switches are booleans, and numbers finite."""
    stack: list[tuple[str, Any]] = [("", config)]
    while stack:  # ends: a configuration as written is a tree
        path, node = stack.pop()
        keys: Any = node.keys() if isinstance(node, DictConfig) else range(len(node))
        for key in keys if not node._is_none() and not node._is_interpolation() else ():
            if OmegaConf.is_interpolation(node, key) or OmegaConf.is_missing(node, key):
                continue
            name, value = f"{path}.{key}".lstrip("."), node[key]
            if key in SWITCHES:
                check_flag(name, value)
            elif isinstance(value, DictConfig | ListConfig):
                stack.append((name, value))
            elif isinstance(value, int | float) and not isinstance(value, bool):
                check_number(name, value)
