"""Configuration files: their folder, what they may hold, and their comments.

The comment lines right above a key, at its indentation, are one sentence on the key that ends with
its unit and range in brackets: ``# Length of a trip [min; above 0]``. The first comment of a file
describes the file; a comment behind a value describes the value.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, ListConfig, OmegaConf

from suspnet.ground.core_yaml import LOADER, MOST_BYTES, parse_yaml
from suspnet.ground.settings import check_number
from suspnet.ground.storage import read_plain


def _configs() -> str:
    """Return the folder of the configurations: in the package if installed, else the checkout's."""
    packaged = Path(__file__).parents[1] / "configs"
    return str(packaged if packaged.is_dir() else packaged.parents[1] / "configs")


CONFIGS = _configs()
"""Absolute path of the folder that Hydra composes from."""
TABLES = {
    "reading": ("readings.yaml", "_global_"),
    "scenario": ("scenarios.yaml", "scenario"),
}
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


def store_tables() -> None:
    """Make each entry of the files of ``TABLES`` an option of its group.

    The first entry holds the common settings, and the others change it. A file GROUP/NAME.yaml in a
    user's folder (`--config-dir`) is an option like any other.
    """
    for group, (file, package) in TABLES.items():
        table = OmegaConf.load(Path(CONFIGS) / file)
        first = next(iter(table))
        for name, entry in table.items():
            node = entry if name == first else {"defaults": [first, "_self_"], **entry}
            ConfigStore.instance().store(name=str(name), node=node, group=group, package=package)


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


Keys = tuple[str, ...]
"""A key, after those that lead to it."""
MERGE = "tag:yaml.org,2002:merge"
NO_WORDS = re.compile(r"@package |python |suspnet-\w+ ")
"""Start of lines in a file's first comment that are commands, or directives for Hydra."""
BEHIND = re.compile(r"\s#\s*(.*)$")


@dataclass(frozen=True)
class Comments:
    """Comments of a file, by the keys that lead to each key.

    `above` holds the sentence on a key, `behind` the comment behind its value, `kinds` the `kind`
    directly below it, `names` the outermost keys and `lines` the line and the column of each key,
    from 0. Items of a list have the keys of the list. What an alias or a merged mapping repeats is
    left out. `is_global`: the keys are those of a whole configuration, not of the file's group.
    """

    above: dict[Keys, str]
    behind: dict[Keys, str]
    kinds: dict[Keys, str]
    names: list[str]
    lines: dict[Keys, tuple[int, int]]
    is_global: bool


@functools.cache
def read_comments(file: Path) -> Comments:
    r"""Return the comments of a file.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "trip.yaml"
    ...     _ = file.write_text("# A trip\n\n# Its length\n# [min]\nminutes: 20 # usable\n")
    ...     phrase(file), read_comments(file).above, read_comments(file).behind
    ('A trip', {('minutes',): 'Its length [min]'}, {('minutes',): 'usable'})
    """
    text = file.read_text(encoding="utf-8", errors="replace")
    lines = text.splitlines()
    comments = Comments({}, {}, {}, [], {}, text.startswith("# @package _global_\n"))
    for keys, value, mark in _keys(yaml.compose(text, Loader=LOADER)):
        comments.lines[keys] = (mark.line, mark.column)
        if above := _above(lines, mark.line, mark.column):
            comments.above[keys] = above
        if behind := BEHIND.search(lines[mark.line]):
            comments.behind[keys] = behind[1]
        if keys[-1] == "kind":
            comments.kinds[keys[:-1]] = str(value.value)
        if len(keys) == 1:
            comments.names.append(keys[0])
    return comments


def phrase(file: Path) -> str:
    """Return the first line of the first comment of a file; "" if it has none."""
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.lstrip("# ")
        if not line.startswith("#"):
            break
        if words and not NO_WORDS.match(words):
            return words.rstrip(".")
    return ""


def _above(lines: Sequence[str], number: int, column: int) -> str:
    """Return the comment right above a key on one line; "" if that is the file's first comment."""
    first = number
    while first > 0 and lines[first - 1].startswith(" " * column + "#"):  # ends at the first line
        first -= 1
    return "" if first == 0 else " ".join(text.strip(" #") for text in lines[first:number])


def _keys(root: yaml.Node | None) -> Iterator[tuple[Keys, yaml.Node, yaml.Mark]]:
    """Yield each key of a document, after those that lead to it, with its value and position.

    They come in the order of the document, so an anchor comes before its aliases.
    """
    stack: list[tuple[Keys, Any]] = [((), root)]
    seen: set[int] = set()
    while stack:  # each node is taken off once
        keys, node = stack.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        below: list[tuple[Keys, Any]] = []
        if isinstance(node, yaml.SequenceNode):
            below = [(keys, item) for item in node.value]
        elif isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                if key.tag != MERGE and isinstance(key, yaml.ScalarNode):
                    name = (*keys, str(key.value))
                    yield name, value, key.start_mark
                    below.append((name, value))
        stack += reversed(below)


SWITCHES = frozenset(
    "by_part check_channels distributed estimate_mass figures fit_intercept log_ratios mass_known "
    "once open_browser open_to_network pdf progress refine short_waves standardised tls "
    "xlsx".split()
)
"""Keys that are either on or off, in whichever group they are."""
WORDS = {"yes": True, "on": True, "true": True, "no": False, "off": False, "false": False}
"""Values of a switch written as text; Hydra's command line knows true and false only."""


def read_values(config: DictConfig) -> None:
    """Make each switch of a configuration a boolean; check that each number is finite.

    TypeError or ValueError for any other value of a switch, and for a number that is NaN, infinite
    or beyond `LARGEST` of ``suspnet.ground.settings``.
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
    is_on = WORDS.get(value.lower()) if isinstance(value, str) else None
    if is_on is None:
        raise ValueError(f"`{name}` must be one of {', '.join(WORDS)}; got {value!r}")
    return is_on
