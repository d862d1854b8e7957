"""Backup and restore of a store that is a file, while programs use it."""

import errno
import os
import secrets
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

from suspnet.ground.findings import at
from suspnet.ground.ledger import check_own
from suspnet.trains.history.database import APPLICATION_ID, MARKER, WAIT_S, HistoryError
from suspnet.trains.history.store import History

COMPANIONS = ("-journal", "-wal", "-shm")
"""Ends of the names of files that SQLite applies to a database of the same name."""


def back_up(place: str, copy: Path, *, replace: bool = False) -> int:
    """Copy a store into a file that appears when it is whole and checked; return its size, [bytes].

    Programs may write to the store meanwhile: the copy is one state of it. HistoryError is raised
    if the store is a server, damaged or missing, or if `copy` exists and `replace` is false, it is
    not a store, it is the store itself, or a program has it open.
    """
    _check_file(place)
    with History(place, must_exist=True) as store:
        store.check()
    if os.path.lexists(copy) and not replace:
        raise HistoryError(f"{copy}: there is such a file; give another name, or --replace")
    if copy.exists() and copy.samefile(place):
        raise HistoryError(f"{copy} is the store itself; give another name for the backup")
    used = "a program writes to this backup, or was killed while it did; give another name"
    _check_absent(copy, COMPANIONS, used)
    return _copied(Path(place), copy, replace=replace)


def restore(copy: Path, place: str) -> int:
    """Copy a backup to a place where no store is; return its size, [bytes].

    HistoryError is raised if there is a file at the place or a journal of an earlier one, which
    SQLite would apply to the restored store, or if the backup is damaged or not a store.
    """
    _check_file(place)
    remedy = "nothing is replaced: move this file away first, and end the programs that use it"
    _check_absent(Path(place), ("", *COMPANIONS), remedy)
    if not copy.is_file():
        raise HistoryError(f"{copy}: there is no such backup")
    return _copied(copy, Path(place))


def _check_file(place: str) -> None:
    if "://" in place:
        raise HistoryError(
            "a server's store is backed up by PostgreSQL's own programs: pg_dump --format=custom "
            "and pg_restore"
        )


def _check_absent(path: Path, ends: Sequence[str], words: str) -> None:
    for file in (path.with_name(path.name + end) for end in ends):
        if os.path.lexists(file):
            raise HistoryError(f"{file}: {words}")


def _copied(source: Path, target: Path, *, replace: bool = False) -> int:
    """Copy a database by SQLite's backup, check the copy, and give it its name.

    Who may read the source may read the copy.
    """
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    address = f"{source.absolute().as_uri()}?mode=ro"
    try:
        for path in (source, target):
            check_own(path, APPLICATION_ID, MARKER, "store of suspnet")
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        with (
            closing(sqlite3.connect(address, uri=True, timeout=WAIT_S)) as old,
            closing(sqlite3.connect(temporary)) as new,
        ):
            old.backup(new, pages=-1)  # in one step: writers wait, so that it never starts again
            if (answer := new.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
                raise HistoryError(at(source, "store-damaged", found=answer))
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
            size = os.fstat(stream.fileno()).st_size
        with suppress(OSError):  # some file systems have no permissions
            shutil.copymode(source, temporary)
        if not replace and os.path.lexists(target):  # a program has made it meanwhile
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target))
        os.replace(temporary, target)
    except (sqlite3.Error, OSError) as error:
        raise HistoryError(f"{source} cannot be copied to {target} ({error})") from None
    except ValueError as error:  # not a store of ours
        raise HistoryError(str(error)) from None
    finally:
        temporary.unlink(missing_ok=True)
    return size
