"""A folder into which loggers drop files of frames; results as lines of JSON on standard output."""

from __future__ import annotations

import logging
import os
import stat
import time
from collections import Counter, deque
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, ClassVar, Literal

import pyarrow as pa

from suspnet.depot.live.source import CONTINUATION, ResultKind, Splitter, print_result
from suspnet.ground.ledger import free_name
from suspnet.ground.settings import Setting, check_values
from suspnet.trains.recordings.frames import MOST_BYTES, FrameError, decode

log = logging.getLogger(__name__)
TAKEN = "taken"  # subfolder for files that were read
MAX_LOST = 4 * MOST_BYTES  # a file is abandoned after this many bytes in a row without a frame
MAX_REPORTED = 100  # files that the log names as left in place
PIECE_BYTES, BATCH_BYTES = 2**18, 2**23  # read at once, and returned by one `receive`
HEAD_BYTES = 2**12  # bytes at the start of a file that hold the time of its first frame
UNFINISHED = (".part", ".tmp")  # suffixes of files that are still being written


@dataclass(frozen=True)
class _File:
    """A file as it was when it was opened; `n_returned` frames were returned up to its last one."""

    path: Path
    identity: tuple[int, int, int]
    n_returned: int


class DropFolder:
    """Source of the frames in files, of one or more frames each.

    A file is written under a name that starts with "." or ends with ".part" or ".tmp", and then
    renamed; no name is used twice. Files are read in pieces, in the order of the times of their
    first frames. Once all frames of a file are confirmed, it moves to ``taken/`` or is deleted, if
    it holds only valid frames of the suspensions monitored here. All other files stay in place and
    are reported once: links, FIFOs and files that do not start with a frame are not read; files
    that hold anything else or are cut off are read, and their frames returned.

    Memory is bounded by one batch of frames, 8 MiB, one frame, and the names of the files.
    """

    settings: ClassVar[Mapping[str, Setting]] = {
        "folder": Setting("Folder into which files are renamed once they are whole", rule="path"),
        "then": Setting("Whether a file that was read is moved to taken/ or deleted"),
        "poll_s": Setting("Time between two scans of the folder", "s", low=0.01, high=60),
        "once": Setting("Whether to end when all files were read"),
    }

    def __init__(
        self,
        folder: str | Path,
        then: Literal["move", "delete"] = "move",
        poll_s: float = 0.5,
        once: bool = False,
    ) -> None:
        check_values(DropFolder, then=then, poll_s=poll_s, once=once)
        self.folder, self.then, self.poll_s, self.once = Path(folder), then, poll_s, once
        self._counts: Counter[str] = Counter()
        self._suspensions: frozenset[str] = frozenset()
        self._waiting: deque[Path] = deque()
        self._seen: set[str] = set()  # names of files that are not new
        self._read: deque[_File] = deque()
        self._n_returned = self._n_confirmed = 0
        self._next_look_s = 0.0
        self._reading: Generator[list[bytes], None, None] | None = None

    @property
    def counts(self) -> Counter[str]:
        """`Splitter.counts`, and files "left", "vanished", "unreadable" or "replaced"."""
        return Counter(self._counts)

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Check the folder; all suspensions belong to this process. See `FrameSource`."""
        if not self.folder.is_dir():
            raise FileNotFoundError(2, "there is no such folder", str(self.folder))
        self._check_taken()
        self._suspensions = frozenset(suspensions)
        return suspensions

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return the next frames of the files; None after the last one if `once`.

        See `FrameSource`.
        """
        deadline = time.monotonic() + timeout_s
        frames: list[bytes] = []
        n_bytes = 0
        while n_bytes < BATCH_BYTES:  # ends: each round reads a piece, or waits until the deadline
            if self._reading is None and not self._waiting:
                if frames:  # better a small batch now than a wait for new files
                    break
                now_s = time.monotonic()
                if self.once or now_s >= self._next_look_s:
                    self.look()
                    self._next_look_s = now_s + self.poll_s
                if not self._waiting:
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
                self._n_returned += len(piece)
                n_bytes += sum(map(len, piece))
            if time.monotonic() > deadline:
                break
        return frames

    def confirm(self, n_frames: int | None = None) -> None:
        """Move or delete the files whose frames are all confirmed. See `FrameSource`."""
        self._n_confirmed = self._n_returned if n_frames is None else self._n_confirmed + n_frames
        while self._read and self._read[0].n_returned <= self._n_confirmed:  # ends: with the files
            file = self._read.popleft()
            try:
                self._put_away(file)
            except OSError as error:
                self._give_up(file.path, error)
            else:
                self._seen.discard(file.path.name)

    def publish(self, kind: ResultKind, suspension: str, message: bytes) -> None:
        """Write a line of JSON to standard output."""
        print_result(kind, suspension, message)

    def close(self) -> None:
        """Close the file that is being read."""
        if self._reading is not None:
            self._reading.close()
            self._reading = None

    def look(self) -> None:
        """Queue the new files of the folder by the time of their first frames."""
        try:
            with os.scandir(self.folder) as entries:
                is_file = {
                    entry.name: entry.is_file(follow_symlinks=False)
                    for entry in entries
                    if not entry.is_dir(follow_symlinks=False)
                    and not entry.name.startswith(".")
                    and not entry.name.endswith(UNFINISHED)
                }
        except OSError as error:
            self._give_up(self.folder, error)
            return
        self._seen &= is_file.keys() | {file.path.name for file in self._read}
        new = is_file.keys() - self._seen
        self._seen.update(new)
        for name in sorted(new):
            if not is_file[name]:
                self._leave(self.folder / name, "it is not a regular file")
        plain = (self.folder / name for name in new if is_file[name])
        self._waiting.extend(sorted(plain, key=_first_time))

    def _frames(self, path: Path) -> Generator[list[bytes], None, None]:
        splitter, problem, last = Splitter(), "", list[bytes]()
        try:
            with _opened(path) as file:
                identity = _identity(os.fstat(file.fileno()))
                data = file.read(PIECE_BYTES)
                if not data.startswith(CONTINUATION):  # the rest of the file is not read
                    data, problem = b"", "it does not start with a frame"
                n_lost = 0
                while data and n_lost <= MAX_LOST:
                    frames = splitter.push(data)
                    problem = problem or self._problem(frames)
                    n_lost = 0 if frames else n_lost + len(data)
                    # of a growing file only the initial size is read
                    data = file.read(PIECE_BYTES) if file.tell() < identity[2] else b""
                    if data:
                        yield frames
                    else:
                        last = frames
        except OSError as error:
            self._give_up(path, error)
            self._counts += splitter.counts
            return
        last += splitter.finish()
        problem = problem or self._problem(last)
        self._counts += splitter.counts
        if problem or splitter.counts:
            self._leave(path, problem or f"it holds not only frames ({', '.join(splitter.counts)})")
        else:
            # all frames of the file are returned once `last` is
            self._read.append(_File(path, identity, self._n_returned + len(last)))
        yield last

    def _problem(self, frames: list[bytes]) -> str:
        """Return why some encoded frame is not of a monitored suspension; empty if all are."""
        for data in frames:
            try:
                frame = decode(data)
            except FrameError as error:
                return f"it holds a frame that is not valid ({error.reason})"
            if frame.suspension not in self._suspensions:
                return f"it holds a frame of {frame.suspension!r}, which is not monitored here"
        return ""

    def _put_away(self, file: _File) -> None:
        """Move or delete a file, unless another file has its name by now."""
        now = os.lstat(file.path)
        if not stat.S_ISREG(now.st_mode) or _identity(now) != file.identity:
            self._counts["replaced"] += 1
            return
        if self.then == "delete":
            file.path.unlink()
            return
        self._check_taken()
        (self.folder / TAKEN).mkdir(exist_ok=True)
        file.path.rename(free_name(self.folder / TAKEN / file.path.name))

    def _check_taken(self) -> None:
        """Raise OSError if files would be moved through a link."""
        taken = self.folder / TAKEN
        is_used = self.then == "move" and os.path.lexists(taken)
        if is_used and not stat.S_ISDIR(os.lstat(taken).st_mode):
            raise NotADirectoryError(20, "must be a folder, not a link to one", str(taken))

    def _leave(self, path: Path, reason: str) -> None:
        """Count and report a file that stays in place."""
        self._counts["left"] += 1
        if self._counts["left"] <= MAX_REPORTED:
            log.warning("%r stays in place: %s", str(path), reason)

    def _give_up(self, path: Path, error: OSError) -> None:
        """Count a file that cannot be read or moved; it is not tried again while it exists."""
        reason = "vanished" if isinstance(error, FileNotFoundError) else "unreadable"
        if reason == "unreadable" and not self._counts[reason]:
            log.warning("%r: %s; further ones are only counted", str(path), error.strerror)
        self._counts[reason] += 1


def _opened(path: Path) -> BinaryIO:
    """Open a regular file, following no link and not waiting for the writer of a FIFO."""
    # Windows has neither of these flags
    flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    file = os.fdopen(os.open(path, os.O_RDONLY | flags), "rb")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(22, "not a regular file", str(path))
    return file


def _identity(status: os.stat_result) -> tuple[int, int, int]:
    """Return what distinguishes a file from another one of the same name."""
    return status.st_ino, status.st_mtime_ns, status.st_size


def _first_time(path: Path) -> tuple[int, str]:
    """Return the time of a file's first frame [ns], 0 if there is none, and its name."""
    try:
        with _opened(path) as file:
            schema = pa.ipc.read_schema(pa.BufferReader(file.read(HEAD_BYTES)))
        return int((schema.metadata or {}).get(b"time_ns", b"0")), path.name
    except (pa.ArrowException, OSError, ValueError):
        return 0, path.name
