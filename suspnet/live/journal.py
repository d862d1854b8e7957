"""What a monitor must not lose: each suspension's last saved state, and its frames since then.

All of it is one SQLite file, whose transactions are whole or not there, also after a power cut.
A state takes the place of the frames that it was made from, so that the file stays bounded and a
start is quick. Frames come back in the order in which they were taken.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

FORMAT = "suspnet-journal-1"

PAGE_BYTES = 32768
"""Size of a page of a new file: a frame of 20 kB is then in one page, and not in a chain of six,
which halves the processor time."""

READ_AT_ONCE = 256
"""Number of frames that are read back at once."""


class JournalError(ValueError):
    """The journal cannot be used: another file, or another monitor has it open."""


class Journal:
    """States and frames of the suspensions of one process; a context manager.

    Parameters
    ----------
    path : Path
        Made anew where there is nothing yet.

    Attributes
    ----------
    n_bytes : Counter
        Size of the frames of each suspension since its state.

    Raises
    ------
    JournalError
        If it is another file, or is open in another process.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.n_bytes: Counter[str] = Counter()
        self._frames: list[tuple[str, bytes]] = []
        self._states: dict[str, bytes] = {}
        if not path.absolute().parent.is_dir():
            raise JournalError(f"{path}: there is no folder {path.absolute().parent}")
        self._connection = sqlite3.connect(path, timeout=1.0, isolation_level=None)
        try:
            self._prepare()
        except sqlite3.Error as error:
            self._connection.close()
            words = "another monitor has it open" if "locked" in str(error) else str(error)
            raise JournalError(f"{path}: the journal cannot be used ({words})") from None
        except JournalError:
            self._connection.close()
            raise

    def _prepare(self) -> None:
        """Lock the file for this process, and make the tables where there are none."""
        run = self._connection.execute
        run(f"PRAGMA page_size = {PAGE_BYTES}")
        run("PRAGMA locking_mode = EXCLUSIVE")
        run("PRAGMA journal_mode = WAL")
        run("PRAGMA synchronous = FULL")
        run("BEGIN EXCLUSIVE")
        tables = {name for (name,) in run("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables:
            run("CREATE TABLE format (name TEXT)")
            run("INSERT INTO format VALUES (?)", (FORMAT,))
            run("CREATE TABLE states (suspension TEXT PRIMARY KEY, state BLOB NOT NULL)")
            run(
                "CREATE TABLE frames "
                "(id INTEGER PRIMARY KEY, suspension TEXT NOT NULL, frame BLOB NOT NULL)"
            )
            run("CREATE INDEX of_suspension ON frames (suspension, id)")
        elif "format" not in tables or run("SELECT name FROM format").fetchone() != (FORMAT,):
            raise JournalError(
                f"{self.path}: this is no journal of a monitor, or of another version"
            )
        run("COMMIT")
        sizes = run("SELECT suspension, SUM(LENGTH(frame)) FROM frames GROUP BY suspension")
        self.n_bytes.update(dict(sizes))

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file; what was not committed is gone."""
        self._connection.close()

    def state(self, suspension: str) -> bytes | None:
        """Return the last saved state of a suspension."""
        query = "SELECT state FROM states WHERE suspension = ?"
        row = self._connection.execute(query, (suspension,)).fetchone()
        return None if row is None else row[0]

    def frames(self, suspension: str) -> Iterator[bytes]:
        """Yield the frames since that state, in the order in which they were added."""
        query = "SELECT frame FROM frames WHERE suspension = ? ORDER BY id"
        rows = self._connection.execute(query, (suspension,))
        while several := rows.fetchmany(READ_AT_ONCE):  # ends with the rows
            yield from (frame for (frame,) in several)

    def suspensions(self) -> list[str]:
        """Return the names of those that have a state or frames, sorted."""
        query = "SELECT suspension FROM states UNION SELECT suspension FROM frames ORDER BY 1"
        return [name for (name,) in self._connection.execute(query)]

    def add(self, suspension: str, frame: bytes) -> None:
        """Keep a frame with the next commit."""
        self._frames.append((suspension, frame))
        self.n_bytes[suspension] += len(frame)

    def save(self, suspension: str, state: bytes) -> None:
        """Keep a state with the next commit, in place of all frames of the suspension so far."""
        self._states[suspension] = state
        self._frames = [one for one in self._frames if one[0] != suspension]
        del self.n_bytes[suspension]

    def commit(self) -> None:
        """Write all that was added and saved, to the disk; all of it or nothing.

        Raises
        ------
        JournalError
            If it cannot be written, as on a full disk; all of it is kept for the next commit.
        """
        if not self._frames and not self._states:
            return
        run = self._connection.execute
        try:
            run("BEGIN")
            for name, state in self._states.items():
                run("DELETE FROM frames WHERE suspension = ?", (name,))
                run("INSERT OR REPLACE INTO states VALUES (?, ?)", (name, state))
            self._connection.executemany(
                "INSERT INTO frames (suspension, frame) VALUES (?, ?)", self._frames
            )
            run("COMMIT")
        except sqlite3.Error as error:
            if self._connection.in_transaction:
                run("ROLLBACK")
            raise JournalError(f"{self.path}: the journal cannot be written ({error})") from None
        self._frames, self._states = [], {}
