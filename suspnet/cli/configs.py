"""The folder of the configurations, and the options that it holds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from suspnet.ground.plain_files import read_plain
from suspnet.recordings.core_yaml import parse_yaml


def _configs() -> str:
    """Return the folder of the configurations: in the package if installed, else the checkout's."""
    packaged = Path(__file__).parents[1] / "configs"
    return str(packaged if packaged.is_dir() else packaged.parents[1] / "configs")


CONFIGS = _configs()
"""Absolute path of the folder that Hydra composes from."""
MOST_INTERPOLATED = 2**13
"""Largest number of characters of all texts with interpolations in a file."""
TABLES = {"ablation": ("ablations.yaml", "_global_"), "scenario": ("scenarios.yaml", "scenario")}
"""File and package of each group whose options are the entries of one file."""


def store_tables() -> None:
    """Make each entry of ablations.yaml and scenarios.yaml an option of its group.

    The first entry holds what all share; the others change it. A file GROUP/NAME.yaml in a folder
    of the user's (`--config-dir`) is an option like any other.
    """
    for group, (file, package) in TABLES.items():
        table = OmegaConf.load(Path(CONFIGS) / file)
        first = next(iter(table))
        for name, entry in table.items():
            node = entry if name == first else {"defaults": [first, "_self_"], **entry}
            ConfigStore.instance().store(name=str(name), node=node, group=group, package=package)


def check_file(file: Path) -> None:
    """Check that a configuration is a plain file which takes little time and memory to load.

    Raises
    ------
    ValueError
        If it waits, never ends, is no YAML without tags, grows by its aliases beyond what
        `parse_yaml` reads, or holds more interpolations than are parsed in seconds.
    """
    content = read_plain(file)
    try:
        values = walk(parse_yaml(content.decode(errors="replace")), "")
        texts = [one for _, _, one in values if isinstance(one, str) and "${" in one]
        if sum(map(len, texts)) > MOST_INTERPOLATED:
            raise ValueError(f"its interpolations have more than {MOST_INTERPOLATED} characters")
    except ValueError as error:
        raise ValueError(f"{file} is no configuration: {error}") from error


def walk(value: Any, path: str) -> Iterator[tuple[str, str, Any]]:
    """Yield key, path and value of each value below a mapping or list."""
    pairs: Any = ()
    if isinstance(value, dict):
        pairs = value.items()
    elif isinstance(value, list):
        pairs = enumerate(value)
    for key, one in pairs:
        name = f"{path}.{key}" if path else str(key)
        yield str(key), name, one
        yield from walk(one, name)
