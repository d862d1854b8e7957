"""Folders of simulated trips, one per simulation, which can continue after an interruption."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from suspnet.ground import own_files
from suspnet.ground.storage import locked, read_json, write_json
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest_files import read_manifest

log = logging.getLogger(__name__)
UNFINISHED = "unfinished.json"
"""Name of the file that marks a folder of simulated trips as incomplete."""
TRUTH = "truth.json"
"""Name of the file with the true numbers of a simulation, which is written last."""


class FolderTakenError(ValueError):
    """A folder holds the trips of another simulation."""


@contextmanager
def own_folder(folder: Path) -> Iterator[None]:
    """Keep other simulations from a folder; FolderTakenError if one is writing to it."""
    existed = folder.is_dir()
    with locked(folder, wait=False) as is_ours:
        if not is_ours:
            raise FolderTakenError(
                f"another simulation is writing to {folder}; give another folder"
            )
        try:
            yield
        finally:
            if not existed and not any(folder.iterdir()):
                folder.rmdir()


@contextmanager
def unfinished(
    folder: Path, made_from: str, n_all: int, n_missing: int, noun: str = "trips"
) -> Iterator[None]:
    """Mark a folder as that of an unfinished simulation, until the context ends without an error.

    `made_from` is a hash of everything that its trips depend on; `n_all` and `n_missing` count its
    trips or suspensions (`noun`), and those not written yet. Raises FolderTakenError if the folder
    holds trips of another simulation, FileExistsError if it holds a file that no simulation wrote.
    """
    mark = folder / UNFINISHED
    if not mark.exists():
        if _holds_trips(folder):
            raise FolderTakenError(f"{folder} already holds trips; give another folder")
        own_files.begin(folder)
        write_json(mark, {f"n_{noun}": n_all, "made_from": made_from})
    elif read_json(mark).get("made_from") != made_from:
        raise FolderTakenError(
            f"{folder} already holds trips; give another folder, or the settings of that "
            "unfinished simulation to continue it"
        )
    elif own_files.begin(folder) and n_missing < n_all:
        log.info("%d of %d %s are written, continuing", n_all - n_missing, n_all, noun)
    try:
        yield
    # without a single trip nothing of this attempt remains
    except BaseException:
        if not _holds_trips(folder):
            mark.unlink(missing_ok=True)
            if [path.name for path in folder.iterdir()] == [own_files.MARKER]:
                own_files.discard(folder)
        raise
    mark.unlink(missing_ok=True)
    own_files.discard(folder)


def _holds_trips(folder: Path) -> bool:
    return any(any(folder.glob(pattern)) for pattern in ("*.yaml", "*/*.yaml"))


def is_finished(folder: Path) -> bool:
    """Return whether a folder holds all trips of a suspension's simulation."""
    return (folder / TRUTH).is_file() and not (folder / UNFINISHED).exists()


def is_whole(manifest: Path) -> bool:
    """Return whether a trip is complete: its manifest, which is written last, and its files."""
    try:
        read_manifest(manifest)
    except TripError:
        return False
    return True
