"""A folder into which loggers drop files of frames; results as lines of JSON on standard output."""

from __future__ import annotations

import logging
import os
import time
from collections import Counter, deque
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import pyarrow as pa

from suspnet.checks import check_choice, check_flag, check_number
from suspnet.live.framing import Splitter
from suspnet.live.source import Kind, print_result

log = logging.getLogger(__name__)
TAKEN, REFUSED = "taken", "refused"
"""Names of the subfolders for files that were read."""

PIECE_BYTES, BATCH_BYTES = 2**18, 2**23
"""Numbers of bytes that are read at once, and given at once."""

HEAD_BYTES = 2**12
"""Number of bytes at the begin of a file in which its first frame says its time."""

UNFINISHED = (".part", ".tmp")
"""Ends of the names of files that are still being written."""


@dataclass(frozen=True)
class _File:
    """A file as it was when it was opened; `n_given` frames were given with its last one."""

    path: Path
    identity: tuple[int, int, int]
    is_whole: bool
    n_given: int


class DropFolder:
    """Source of the frames in files, of one or more frames each.

    A file is written under a name that begins with "." or ends with ".part" or ".tmp", and then
    renamed; names are not used again. Files are read in the order of the times of their first
    frames, in pieces. Once all of its frames are confirmed, a file moves to ``taken/`` or is
    deleted. One that holds anything but frames moves to ``refused/``; its frames were given.

    Memory is bounded by one batch of frames, 8 MiB, one frame, and the names of the files.

    Parameters
    ----------
    folder : str or Path
    then : {"move", "delete"}
        What happens to a file that was read and is kept by the monitor.
    poll_s : float, [s]
        Time between two looks into the folder.
    once : bool
        End when all files were read.

    Raises
    ------
    TypeError, ValueError
        If a setting is out of range.
    """

    def __init__(
        self,
        folder: str | Path,
        then: Literal["move", "delete"] = "move",
        poll_s: float = 0.5,
        once: bool = False,
    ) -> None:
        check_choice("then", then, ("move", "delete"))
        check_number("poll_s", poll_s, low=0.01, high=60)
        check_flag("once", once)
        self.folder, self.then, self.poll_s, self.once = Path(folder), then, poll_s, once
        self._counts: Counter[str] = Counter()
        self._waiting: deque[Path] = deque()
        self._known: set[str] = set()
        self._read: deque[_File] = deque()
        self._n_given = self._n_kept = 0
        self._next_look_s = 0.0
        self._reading: Generator[list[bytes], None, None] | None = None

    @property
    def counts(self) -> Counter[str]:
        """As `Splitter.counts`, and files that were "vanished", "unreadable" or "replaced"."""
        return Counter(self._counts)

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Make the subfolders; all suspensions are this process's. See `Source`."""
        if not self.folder.is_dir():
            raise FileNotFoundError(2, "there is no such folder", str(self.folder))
        for name in (TAKEN, REFUSED):
            (self.folder / name).mkdir(exist_ok=True)
        return suspensions

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return the next frames of the files; None after the last one if `once`. See `Source`."""
        deadline = time.monotonic() + timeout_s
        frames: list[bytes] = []
        n_bytes = 0
        while n_bytes < BATCH_BYTES:  # ends: each round reads a piece, or waits until the deadline
            if self._reading is None and not self._waiting:
                if frames:
                    break
                if self.once or time.monotonic() >= self._next_look_s:
                    self._look()
                    self._next_look_s = time.monotonic() + self.poll_s
            if self._reading is None and not self._waiting:
                now_s = time.monotonic()
                if self.once or now_s >= deadline:
                    return None if self.once else []
                time.sleep(max(0.0, min(self._next_look_s, deadline) - now_s))
                continue
            if self._reading is None:
                self._reading = self._frames(self._waiting.popleft())
            piece = next(self._reading, None)
            if piece is None:
                self._reading = None
            else:
                frames += piece
                self._n_given += len(piece)
                n_bytes += sum(map(len, piece))
            if time.monotonic() > deadline:
                break
        return frames

    def confirm(self, n_frames: int | None = None) -> None:
        """Move or delete the files all of whose frames are kept. See `Source`."""
        self._n_kept = self._n_given if n_frames is None else self._n_kept + n_frames
        while self._read and self._read[0].n_given <= self._n_kept:  # ends: with the files
            file = self._read.popleft()
            try:
                self._put_away(file)
            except OSError as error:
                self._give_up(file.path, error)
            else:
                self._known.discard(file.path.name)

    def publish(self, kind: Kind, suspension: str, payload: bytes) -> None:
        """Write a line of JSON to standard output."""
        print_result(kind, suspension, payload)

    def close(self) -> None:
        """Close the file that is being read."""
        if self._reading is not None:
            self._reading.close()
            self._reading = None

    def _look(self) -> None:
        """Find files that are new, in the order of the times of their first frames."""
        try:
            with os.scandir(self.folder) as entries:
                names = {one.name for one in entries if one.is_file()}
        except OSError as error:
            self._give_up(self.folder, error)
            return
        self._known &= names | {file.path.name for file in self._read}
        new = [
            name
            for name in names - self._known
            if not name.startswith(".") and not name.endswith(UNFINISHED)
        ]
        self._known.update(new)
        self._waiting.extend(sorted((self.folder / name for name in new), key=_first_time))

    def _frames(self, path: Path) -> Generator[list[bytes], None, None]:
        """Yield the frames of a file, piece by piece."""
        splitter = Splitter()
        try:
            with path.open("rb") as file:
                identity = _identity(file)
                data = file.read(PIECE_BYTES)
                if not data:
                    splitter.counts["truncated"] += 1
                while following := file.read(PIECE_BYTES):
                    yield splitter.push(data)
                    data = following
        except OSError as error:
            self._give_up(path, error)
            self._counts += splitter.counts
            return
        last = splitter.push(data) + splitter.finish()
        self._counts += splitter.counts
        # from here on all of its frames are given
        n_given = self._n_given + len(last)
        self._read.append(_File(path, identity, not splitter.counts, n_given))
        yield last

    def _put_away(self, file: _File) -> None:
        """Move or delete a file, unless another one has its name by now."""
        with file.path.open("rb") as now:
            if _identity(now) != file.identity:
                self._counts["replaced"] += 1
                return
        if file.is_whole and self.then == "delete":
            file.path.unlink()
            return
        folder = self.folder / (TAKEN if file.is_whole else REFUSED)
        target, number = folder / file.path.name, 1
        while target.exists():  # ends: there are fewer files than numbers
            number += 1
            target = folder / f"{file.path.stem}_{number}{file.path.suffix}"
        file.path.rename(target)

    def _give_up(self, path: Path, error: OSError) -> None:
        """Count a file that cannot be read or moved; it is not tried again while it is there."""
        reason = "vanished" if isinstance(error, FileNotFoundError) else "unreadable"
        if reason == "unreadable" and not self._counts[reason]:
            log.warning("%s: %s; further ones are only counted", path, error.strerror)
        self._counts[reason] += 1


def _identity(file: BinaryIO) -> tuple[int, int, int]:
    """Return what tells a file from another one of the same name."""
    found = os.fstat(file.fileno())
    return found.st_ino, found.st_mtime_ns, found.st_size


def _first_time(path: Path) -> tuple[int, str]:
    """Return the time of a file's first frame, [ns], and its name; 0 where there is no frame."""
    try:
        with path.open("rb") as file:
            schema = pa.ipc.read_schema(pa.BufferReader(file.read(HEAD_BYTES)))
        return int((schema.metadata or {}).get(b"time_ns", b"0")), path.name
    except (pa.ArrowException, OSError, ValueError):
        return 0, path.name
