"""Recognise an SQLite file as one of this program without any change to it.

SQLite writes to whatever it opens: a change of the journal mode, a merged write-ahead log, files
beside it. A file is therefore recognised before it is opened for work.
"""

from __future__ import annotations

import sqlite3
import stat
from contextlib import closing
from pathlib import Path

MAGIC = b"SQLite format 3\0"
HEADER_BYTES = 100
APPLICATION_ID = slice(68, 72)
USER_VERSION = slice(60, 64)
"""Places of two numbers in the header, which their owner chooses; 0 by default."""

ACTING = "SELECT name FROM sqlite_master WHERE IFNULL(rootpage, 0) = 0"
"""Query of what runs when tables are read or written: views, triggers and virtual tables. Files of
this program have none; in one of somebody else's they need never come to an end."""


def check_own(path: Path, application_id: int, marker: str, name: str) -> None:
    """Raise an error if a file is somebody else's; a missing and an empty one can be used.

    Parameters
    ----------
    path : Path
    application_id : int
        Number in the header of this program's files.
    marker : str
        Query that returns a row of this program's files that have no number yet.
    name : str
        What the file should be, such as "store of suspnet".

    Raises
    ------
    ValueError
        If it is not a file, cannot be read, or is not one of this program.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            kind = "folder" if path.is_dir() else "device or pipe"
            raise ValueError(f"{path}: this is a {kind}, not a file; name another file")
        with path.open("rb") as file:
            header = file.read(HEADER_BYTES)
    except FileNotFoundError:
        if path.is_symlink():
            raise ValueError(f"{path}: this link leads to no file; name another file") from None
        return
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    if not header or int.from_bytes(header[APPLICATION_ID]) == application_id:
        return
    why = "is not an SQLite database, or its head is damaged"
    if header.startswith(MAGIC) and len(header) == HEADER_BYTES:
        why = _why_foreign(path, header, marker)
    if why:
        raise ValueError(
            f"{path}: this file {why}: it is no {name}, and stays as it is; name another file"
        )


def _why_foreign(path: Path, header: bytes, marker: str) -> str:
    """Return why a database without our number is not ours; empty if it is ours."""
    if any(header[APPLICATION_ID]):
        return "is a database of another application"
    # immutable: no lock is taken, no log is merged, no file appears beside it
    address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(address, uri=True)) as connection:
            if connection.execute("SELECT 1 FROM sqlite_master").fetchone() is not None:
                if connection.execute(ACTING).fetchone() is not None:
                    return "is a database of another application"
                has_row = connection.execute(marker).fetchone() is not None
                return "" if has_row else "is a database of another application"
    except sqlite3.OperationalError:
        return "is a database of another application"
    except sqlite3.DatabaseError as error:
        return f"cannot be read ({error})"
    log = path.with_name(f"{path.name}-wal")
    has_log = log.is_file() and log.stat().st_size > 0
    is_used = has_log or any(header[USER_VERSION])
    return "is a database of another application" if is_used else ""
