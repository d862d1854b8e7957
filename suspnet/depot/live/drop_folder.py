"""A folder into which loggers drop files of frames."""

import logging
import os
import re
import stat
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, BinaryIO, Literal, NamedTuple

import pyarrow as pa

from suspnet.ground.own_files import free_name
from suspnet.ground.settings import Setting, check_settings, setting
from suspnet.ground.storage import DamagedFileError, open_plain
from suspnet.trains.recordings.frames import MOST_BYTES, FrameError, decode

log = logging.getLogger(__name__)
TAKEN = "taken"  # subfolder for files that were read
MAX_FILE_BYTES = 2**26  # of a file, which is read at once
MAX_LOST = 2 * MOST_BYTES  # a file is abandoned after this many bytes in a row without a frame
MAX_REPORTED = 100  # files that the log names as left in place
HEAD_BYTES = 2**12  # bytes at the start of a file that hold the time of its first frame
UNFINISHED = (".part", ".tmp")  # suffixes of files that are still being written
END = b"\xff\xff\xff\xff" + bytes(4)
BEGIN = re.compile(
    rb"\xff\xff\xff\xff(?!\x00\x00)[" + re.escape(bytes(range(0, 256, 8))) + rb"].\x00\x00",
    re.DOTALL,
)
"""Start of a message of Arrow's IPC format: a mark, and a length of less than 64 KiB, a multiple of
8. A frame is a schema, one record batch and ``END``."""


class _File(NamedTuple):
    """A file as it was when it was read; `n_returned` frames were returned up to its last one."""

    path: Path
    identity: tuple[int, int, int]
    n_returned: int


@dataclass(eq=False)
class DropFolder:
    """Source of the frames in files, of one or more frames each.

    A file is written under a name that starts with "." or ends with ".part" or ".tmp", and then
    renamed; no name is used twice. Files are read in the order of the times of their first frames.
    Once all frames of a file are confirmed, it moves to ``taken/`` or is deleted, if it holds only
    valid frames of the suspensions monitored here. All other files stay in place and are reported
    once: links, FIFOs, files above 64 MiB and files that do not start with a frame are not read;
    files that hold anything else or are cut off are read, and their frames returned.

    Memory is bounded by one file and the names of the others. `counts` has the files "left" in
    place and the times that the folder was "unreachable".
    """

    folder: Annotated[
        Path, Setting("Folder into which files are renamed once they are whole", rule="path")
    ]
    then: Literal["move", "delete"] = setting(
        "move", "Whether a file that was read is moved to taken/ or deleted"
    )
    poll_s: float = setting(0.5, "Time between two scans of the folder", "s", low=0.01, high=60)
    once: bool = setting(False, "Whether to end when all files were read")

    def __post_init__(self) -> None:
        check_settings(self)
        self.folder = Path(self.folder)
        self.counts: Counter[str] = Counter()
        self._suspensions: frozenset[str] = frozenset()
        self._waiting: deque[Path] = deque()
        self._seen: set[str] = set()  # names of files that are not new
        self._read: deque[_File] = deque()
        self._n_returned = self._n_confirmed = 0
        self._next_look_s = 0.0

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Check the folder; all suspensions belong to this process. See `FrameSource`."""
        if not self.folder.is_dir():
            raise FileNotFoundError(2, "there is no such folder", str(self.folder))
        self._check_taken()
        self._suspensions = frozenset(suspensions)
        return suspensions

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return the frames of the next file; None after the last one if `once`.

        See `FrameSource`.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:  # ends: with a file that has frames, or at the deadline
            now_s = time.monotonic()
            if not self._waiting and (self.once or now_s >= self._next_look_s):
                self._look()
                self._next_look_s = now_s + self.poll_s
            if self._waiting:
                if frames := self._frames(self._waiting.popleft()):
                    return frames
            elif self.once:
                return None
            else:
                time.sleep(max(0.0, min(self._next_look_s, deadline_s) - now_s))
            if time.monotonic() >= deadline_s:
                return []

    def confirm(self, n_frames: int | None = None) -> None:
        """Move or delete the files whose frames are all confirmed. See `FrameSource`."""
        self._n_confirmed = self._n_returned if n_frames is None else self._n_confirmed + n_frames
        while self._read and self._read[0].n_returned <= self._n_confirmed:  # ends: with the files
            file = self._read.popleft()
            try:
                self._put_away(file)
            except OSError as error:
                self._leave(file.path, str(error.strerror))
            else:
                self._seen.discard(file.path.name)

    def close(self) -> None:
        """Do nothing: no file is open."""

    def _look(self) -> None:
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
            if not self.counts["unreachable"]:
                log.warning("%r: %s; it is tried again", str(self.folder), error.strerror)
            self.counts["unreachable"] += 1
            return
        self._seen &= is_file.keys() | {file.path.name for file in self._read}
        new = is_file.keys() - self._seen
        self._seen.update(new)
        for name in sorted(new):
            if not is_file[name]:
                self._leave(self.folder / name, "it is not a regular file")
        plain = (self.folder / name for name in new if is_file[name])
        self._waiting.extend(sorted(plain, key=_first_time))

    def _frames(self, path: Path) -> list[bytes]:
        """Return the frames of a file, which is noted to be put away, or reported."""
        try:
            with _opened(path) as file:
                status = os.fstat(file.fileno())
                if status.st_size > MAX_FILE_BYTES:
                    self._leave(path, f"it has more than {MAX_FILE_BYTES >> 20} MiB")
                    return []
                data = file.read(status.st_size)
        except (DamagedFileError, OSError) as error:
            self._leave(path, str(getattr(error, "strerror", None) or error))
            return []
        if not BEGIN.match(data):
            self._leave(path, "it does not start with a frame")
            return []
        frames, problem = split(data)
        if problem := problem or self._problem(frames):
            self._leave(path, problem)
        self._n_returned += len(frames)
        if not problem:
            self._read.append(_File(path, _identity(status), self._n_returned))
        return frames

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
        """Move or delete a file, unless another file has its name by now: that is read anew."""
        if _identity(os.lstat(file.path)) != file.identity:
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
        self.counts["left"] += 1
        if self.counts["left"] <= MAX_REPORTED:
            log.warning("%r stays in place: %s", str(path), reason)


def split(data: bytes) -> tuple[list[bytes], str]:
    """Return the encoded frames in a file's content, and why it holds anything else.

    After other bytes the frames go on where the next one starts, even inside a frame that never
    ended. The content of frames is not checked: `decode` does that.

    >>> import numpy as np
    >>> from suspnet.trains.recordings.frames import Frame, encode
    >>> frame = encode(Frame("car 2", "body", 7, 0, 100.0, "g", np.zeros(100)))
    >>> frames, problem = split(frame[:50] + frame)
    >>> frames == [frame], problem
    (True, 'it is damaged at byte 0')
    """
    frames: list[bytes] = []
    problem, at, last = "", 0, 0
    while at < len(data) and at - last <= MAX_LOST:  # ends: each round advances by a byte or more
        if end := _end(data, at):
            frames.append(data[at:end])
            at = last = end
            continue
        problem = problem or f"it is damaged at byte {at}"
        begin = BEGIN.search(data, at + 1)
        at = len(data) if begin is None else begin.start()
    return frames, problem


def _end(data: bytes, start: int) -> int:
    """Return the end of the frame at `start`; 0 if there is none."""
    reader = pa.BufferReader(memoryview(data)[start : start + MOST_BYTES])
    try:
        for kind in ("schema", "record batch"):
            if not BEGIN.match(data, start + reader.tell()):
                return 0
            if pa.ipc.read_message(reader).type != kind:
                return 0
    except (pa.ArrowException, OSError, EOFError):  # damaged, or longer than what follows
        return 0
    end = start + int(reader.tell()) + len(END)
    is_whole = data[end - len(END) : end] == END and end - start <= MOST_BYTES
    return end if is_whole else 0


def _opened(path: Path) -> BinaryIO:
    """Open a regular file that no link leads to."""
    file = open_plain(path)
    if _identity(os.lstat(path)) != _identity(os.fstat(file.fileno())):
        file.close()
        raise OSError(22, "it is a link, or was replaced", str(path))
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
