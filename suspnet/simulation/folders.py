"""Folders of simulated trips: one simulation each, which goes on after an interruption."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import Any

from suspnet._version import __version__
from suspnet.recordings.manifest import TripError
from suspnet.recordings.manifest_files import UNFINISHED, read_manifest
from suspnet.simulation.fleet import Fleet
from suspnet.simulation.scenarios import Scenario
from suspnet.storage import content_hash, locked, read_json, write_json

log = logging.getLogger(__name__)


class FolderTakenError(ValueError):
    """A folder holds the trips of another simulation."""


def described(fleet: Fleet, scenario: Scenario, generator: Any, seed: int, scatter: float) -> str:
    """Return a hash of all that the trips of a simulation depend on."""
    parts = [asdict(fleet), asdict(scenario), type(generator).__name__, asdict(generator)]
    return content_hash(json.loads(json.dumps([*parts, seed, scatter, __version__], default=str)))


@contextmanager
def own_folder(folder: Path) -> Iterator[Path]:
    """Yield a folder into which no other simulation is writing: this one, or one beside it."""
    for number in count(1):  # ends: there are fewer simulations than numbers
        tried = folder if number == 1 else folder.with_name(f"{folder.name}_{number}")
        existed = tried.is_dir()
        with locked(tried, wait=False) as is_ours:
            if not is_ours:
                log.warning("another simulation is writing to %s", tried)
                continue
            try:
                yield tried
            finally:
                if not existed and not any(tried.iterdir()):
                    tried.rmdir()
            return


@contextmanager
def unfinished(folder: Path, made_from: str, n_trips: int, n_missing: int) -> Iterator[None]:
    """Mark a folder as that of an unfinished simulation, until it is left without an error."""
    mark = folder / UNFINISHED
    if not mark.exists():
        if any(folder.glob("*.yaml")):
            raise FolderTakenError(f"{folder} already holds trips; give another folder")
        write_json(mark, {"n_trips": n_trips, "made_from": made_from})
    elif read_json(mark).get("made_from") != made_from:
        raise FolderTakenError(
            f"{folder} already holds trips; give another folder, or the settings of that "
            "unfinished simulation to go on with it"
        )
    elif n_missing < n_trips:
        log.info("%d of %d trips are there, going on", n_trips - n_missing, n_trips)
    try:
        yield
    except BaseException:
        if not any(folder.glob("*.yaml")):
            mark.unlink(missing_ok=True)
        raise
    mark.unlink()


def is_whole(manifest: Path) -> bool:
    """Return whether a trip is written: its manifest, which is written last, and its files."""
    try:
        read_manifest(manifest)
    except TripError:
        return False
    return True
