"""Journal of a monitor: each suspension's last saved state, and its frames since then.

The journal is one SQLite file with atomic transactions, also after a power cut. A state replaces
the frames that it was made from, so the file stays bounded and a restart is quick. The frames of a
suspension have consecutive numbers, in the order in which they were taken, and are neighbours in
the file: deleting them frees whole pages.

A state is JSON-able values with arrays among them, stored as one safetensors file.
"""

import json
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.own_files import ACTING, check_own
from suspnet.ground.storage import DamagedFileError, dump_arrays, load_arrays

FORMAT, STATE_FORMAT = "suspnet-journal-2", "suspnet-stream-1"
APPLICATION_ID = 0x7375736A  # SQLite application id, by which a journal is recognised
RANGE = 2**40  # frame numbers of a suspension: enough for 8,000 years at four frames a second
PAGE_BYTES = 2**14  # a frame of 1 s takes one or two pages


class JournalError(ValueError):
    """The journal cannot be used: it is another file, or another monitor has it open."""


class Journal(AbstractContextManager["Journal"]):
    """States and frames of the suspensions of one process; a context manager.

    What is added and saved is on the disk after the next `write`. `n_bytes` is the size of the
    frames of each suspension since its state. JournalError is raised if `path` is another file or
    is open in another process; a missing file is created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.n_bytes: Counter[str] = Counter()
        self._numbers: dict[str, int] = {}
        self._last: dict[str, int] = {}
        # what is not written yet; a state takes the place of all earlier frames of its suspension
        self._new: list[tuple[int, str]] = []
        self._states: dict[str, bytes] = {}
        self._frames: dict[str, list[tuple[int, bytes]]] = {}
        if not path.absolute().parent.is_dir():
            raise JournalError(f"{path}: there is no folder {path.absolute().parent}")
        try:
            check_own(path, APPLICATION_ID, "journal of a monitor")
        except ValueError as error:
            raise JournalError(str(error)) from None
        self._connection = sqlite3.connect(path, timeout=1.0, isolation_level=None)
        try:
            self._prepare()
        except (sqlite3.Error, JournalError) as error:
            self._connection.close()
            if isinstance(error, JournalError):
                raise
            reason = "another monitor has it open" if "locked" in str(error) else str(error)
            raise JournalError(f"{path}: the journal cannot be used ({reason})") from None

    def _prepare(self) -> None:
        """Lock the file for this process, and create the tables if there are none."""
        run = self._connection.execute
        run(f"PRAGMA page_size = {PAGE_BYTES}")
        # some systems' SQLite overwrites deleted pages with zeros
        run("PRAGMA secure_delete = OFF")
        run("PRAGMA locking_mode = EXCLUSIVE")
        run("PRAGMA synchronous = FULL")
        run("BEGIN EXCLUSIVE")
        tables = {name for (name,) in run("SELECT name FROM sqlite_master")}
        if not tables:
            run(f"PRAGMA application_id = {APPLICATION_ID}")
            run("CREATE TABLE format (name TEXT)")
            run("INSERT INTO format VALUES (?)", (FORMAT,))
            columns = "number INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL, state BLOB"
            run(f"CREATE TABLE suspensions ({columns})")
            run("CREATE TABLE frames (id INTEGER PRIMARY KEY, frame BLOB NOT NULL)")
        elif run(ACTING).fetchone() is not None:
            raise JournalError(f"{self.path}: it holds a view or trigger: this is no journal")
        elif "format" not in tables or run("SELECT name FROM format").fetchone() != (FORMAT,):
            raise JournalError(
                f"{self.path}: this is no journal of a monitor, or one of another version"
            )
        run("COMMIT")
        run("PRAGMA journal_mode = WAL")  # only after the file is known to be a journal
        for number, name in run("SELECT number, name FROM suspensions").fetchall():
            query = "SELECT MAX(id), SUM(LENGTH(frame)) FROM frames WHERE id BETWEEN ? AND ?"
            last, size = run(query, _ids(number)).fetchone()
            self._numbers[name], self._last[name] = number, last or number * RANGE
            self.n_bytes[name] = size or 0

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; what is not written is lost."""
        self._connection.close()

    def state(self, suspension: str) -> bytes | None:
        """Return the last saved state of a suspension."""
        query = "SELECT state FROM suspensions WHERE name = ?"
        row = self._connection.execute(query, (suspension,)).fetchone()
        return None if row is None else row[0]

    def frames(self, suspension: str) -> Iterator[bytes]:
        """Yield the frames since the last saved state, in the order in which they were added."""
        query = "SELECT frame FROM frames WHERE id BETWEEN ? AND ? ORDER BY id"
        rows = self._connection.execute(query, _ids(self._numbers.get(suspension, 0)))
        return (frame for (frame,) in rows)

    def suspensions(self) -> list[str]:
        """Return the sorted names of the suspensions with a state or frames."""
        names = self._connection.execute("SELECT name FROM suspensions ORDER BY 1")
        return [name for (name,) in names]

    def add(self, suspension: str, frame: bytes) -> None:
        """Add a frame."""
        self._number(suspension)
        self._last[suspension] += 1
        self._frames.setdefault(suspension, []).append((self._last[suspension], frame))
        self.n_bytes[suspension] += len(frame)

    def save(self, suspension: str, state: bytes) -> None:
        """Save a state, which replaces all earlier frames of the suspension."""
        self._number(suspension)
        self._states[suspension] = state
        self._frames.pop(suspension, None)
        del self.n_bytes[suspension]

    def _number(self, suspension: str) -> None:
        if suspension not in self._numbers:
            number = len(self._numbers) + 1
            self._numbers[suspension], self._last[suspension] = number, number * RANGE
            self._new.append((number, suspension))

    def write(self) -> None:
        """Write what was added and saved to the disk, in one transaction.

        A JournalError, as on a full disk, leaves the file unchanged: it can be tried again.
        """
        if not self._states and not self._frames:
            return
        run, many = self._connection.execute, self._connection.executemany
        try:
            run("BEGIN")
            many("INSERT INTO suspensions (number, name) VALUES (?, ?)", self._new)
            for name, state in self._states.items():
                number = self._numbers[name]
                run("DELETE FROM frames WHERE id BETWEEN ? AND ?", _ids(number))
                run("UPDATE suspensions SET state = ? WHERE number = ?", (state, number))
            for rows in self._frames.values():
                many("INSERT INTO frames VALUES (?, ?)", rows)
            run("COMMIT")
        except sqlite3.Error as error:
            if self._connection.in_transaction:
                run("ROLLBACK")
            raise JournalError(f"{self.path}: the journal cannot be written ({error})") from None
        self._new, self._states, self._frames = [], {}, {}


def _ids(number: int) -> tuple[int, int]:
    """Return the first and the last frame number of a suspension."""
    return number * RANGE, (number + 1) * RANGE - 1


class StateError(ValueError):
    """A saved state is damaged, or of another stream."""


def dump_state(identity: Any, state: dict[str, Any]) -> bytes:
    """Return a state as bytes, for a stream of the same JSON-able `identity`.

    `state` holds numbers, text, lists of these, arrays, and dicts of all with text keys.
    """
    arrays: dict[str, NDArray[Any]] = {}
    plain = _without_arrays(state, arrays, "")
    described = json.dumps({"format": STATE_FORMAT, "identity": identity, "state": plain})
    arrays["json"] = np.frombuffer(described.encode(), dtype=np.uint8)
    return dump_arrays(arrays)


def load_state(content: bytes, identity: Any) -> dict[str, Any]:
    """Return the state that `dump_state` wrote; StateError if damaged or of another identity."""
    try:
        arrays = load_arrays(content, "the state")
        described = json.loads(arrays["json"].tobytes())
        stored_identity = described["format"], described["identity"]
        state: dict[str, Any] = _with_arrays(described["state"], arrays)
    except (DamagedFileError, KeyError, TypeError, ValueError) as error:
        raise StateError(f"this is no state of a stream: {error}") from None
    if stored_identity != (STATE_FORMAT, json.loads(json.dumps(identity))):
        raise StateError("this is the state of another stream: other sensors, settings or times")
    return state


def _without_arrays(value: Any, arrays: dict[str, NDArray[Any]], name: str) -> Any:
    """Return JSON-able values with each array moved to `arrays` and replaced by its name there."""
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {"array": name}
    if isinstance(value, dict):
        return {key: _without_arrays(item, arrays, f"{name}/{key}") for key, item in value.items()}
    return value


def _with_arrays(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, dict):
        if set(value) == {"array"}:
            return arrays[value["array"]]
        return {key: _with_arrays(item, arrays) for key, item in value.items()}
    return value
