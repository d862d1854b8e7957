"""Manifests that are to be checked, and the columns that they name."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from suspnet.recordings.formats import open_columns
from suspnet.recordings.manifest import TripError
from suspnet.recordings.manifest_files import find_manifests, named_sources

Opened = dict[tuple[Path, str | None, str | None], tuple[str, ...]]
"""Why columns of a file cannot be opened, by file, times and column; empty if they can."""


def find_trips(paths: Iterable[Path]) -> tuple[list[Path], list[str]]:
    """Return the manifests that files and folders stand for, and what is wrong with the others.

    A folder stands for its ``*.yaml`` files, or if it has none for those of its subfolders.
    """
    found: list[Path] = []
    problems = []
    for path in paths:
        try:
            found += _manifests(path)
        except OSError as error:
            words = f"{error.filename}: {error.strerror}" if error.filename else str(error)
            problems.append(words)
    return list(dict.fromkeys(found)), problems


def _manifests(path: Path) -> list[Path]:
    """Return the manifests that one file or folder stands for; OSError if there are none."""
    if not path.is_dir():
        if not os.path.lexists(path):
            raise FileNotFoundError(f"there is no file or folder {path}")
        if path.suffix not in (".yaml", ".yml"):
            raise OSError(f"{path} is no manifest (*.yaml); to write one: suspnet-init {path}")
        return [path]
    if not any(path.glob("*.yaml")):
        parts = sorted(part for part in path.iterdir() if part.is_dir() and part.name[0] != ".")
        inside = [one for part in parts for one in sorted(part.glob("*.yaml")) if one.is_file()]
        if inside:
            return inside
        others = sorted(one.name for one in path.glob("*.yml"))
        if others:
            raise OSError(f"{path} holds no *.yaml file; rename {', '.join(others[:5])}")
    return find_manifests(path)


def check_columns(path: Path, content: Any, opened: Opened) -> None:
    """Raise TripError if a column that a manifest names cannot be opened, whatever else is wrong.

    Only the first block is read. A file that is missing is for others to tell.
    """
    told: dict[str, None] = {}
    for source in named_sources(content).values():
        file, time, column = path.parent / source["file"], source.get("time"), source.get("column")
        named = all(one is None or isinstance(one, str) for one in (time, column))
        if not named or source.get("csv") is not None or not os.path.isfile(file):
            continue  # told by others; how a CSV file is written is known when all is parsed
        key = (file, time, column)
        if key not in opened:
            opened[key] = _opening(file, [column] if time is None else [time, column])
        told |= dict.fromkeys(opened[key])
    if told:
        raise TripError(*told)


def _opening(file: Path, columns: Sequence[str | None]) -> tuple[str, ...]:
    """Return why some columns of a file cannot be opened; empty if they can."""
    try:
        for _ in open_columns(file, columns):
            return ()
    except TripError as error:
        return error.problems
    return ()
