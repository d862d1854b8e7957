"""What is suspnet's own: folders of results, by a marker, and databases, by their header.

A folder of results holds the file ``MARKER``. Programs write results into a folder only if it was
empty or has the marker, and then replace and remove files of their names below it. Links in it are
refused, as they lead elsewhere.

SQLite writes to any file it opens: a change of the journal mode, a merged write-ahead log, files
next to it. A database is therefore recognised by its header before it is opened.
"""

import errno
import os
import stat
from contextlib import suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # not a POSIX system
    HAS_LOCKS = False
else:
    HAS_LOCKS = True
MARKER = "suspnet_results.txt"  # name of the file that marks a folder of results
MARK = b"Results of suspnet, whose programs replace and remove files below this folder.\n"
"""Content of that file; one of that name without it marks nothing."""
MOST_NAME_BYTES = 255  # longest name of a file that file systems allow, [bytes]


def begin(folder: Path) -> bool:
    """Create a folder for results, or continue in one; return whether there are results already.

    FileExistsError names a file of a folder that is not marked, or a link in one that is.
    """
    folder.mkdir(parents=True, exist_ok=True)
    is_ours = _is_marked(folder)
    found = [path for path in sorted(folder.rglob("*")) if path.is_symlink() or not path.is_dir()]
    for path in found:
        if not is_ours or path.is_symlink():
            words = "a link" if is_ours else "suspnet did not write it here"
            raise FileExistsError(errno.EEXIST, f"{words}: give a new folder", str(path))
    if not is_ours:
        with (folder / MARKER).open("xb") as stream:
            stream.write(MARK)
    return any(path != folder / MARKER for path in found)


def discard(folder: Path) -> None:
    """Remove the marker of a finished folder, which belongs to the user from now on."""
    (folder / MARKER).unlink(missing_ok=True)


def _is_marked(folder: Path) -> bool:
    """Return whether a folder, or one above it, is marked."""
    start = Path(os.path.abspath(folder))
    for marker in (parent / MARKER for parent in (start, *start.parents)):
        with suppress(OSError):
            if stat.S_ISREG(marker.lstat().st_mode) and marker.read_bytes() == MARK:
                return True
    return False


def shortened(name: str, most_bytes: int) -> str:
    """Return a name, or its start if it is longer than `most_bytes` in a file system.

    >>> shortened("Züge", 2), shortened("Züge", 5)
    ('Z', 'Züge')
    """
    encoded = os.fsencode(name)
    return name if len(encoded) <= most_bytes else encoded[:most_bytes].decode(errors="ignore")


def free_name(path: Path) -> Path:
    """Return `path`, or `path` with _2, _3, ... before its suffix if there is such a file."""
    number, free = 1, path
    while os.path.lexists(free):  # ends: there are fewer files than numbers
        number += 1
        free = path.with_stem(f"{path.stem}_{number}")
    return free


def lock(handle: int, wait: bool = True) -> bool:
    """Lock an open file or folder until it is closed; return False if it is locked already.

    Returns True on file systems without locks.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:  # the file system has no locks
        pass
    return True


MAGIC = b"SQLite format 3\0"
HEADER_BYTES = 100
APPLICATION_ID = slice(68, 72)
"""Position in the header of a number that the application chooses; 0 by default."""
ACTING = "SELECT name FROM sqlite_master WHERE IFNULL(rootpage, 0) = 0"
"""Query for views, triggers and virtual tables, which run code when tables are read or written. Our
databases have none; in a foreign file they may never end."""


def check_own(path: Path, application_id: int, name: str) -> None:
    """Raise ValueError unless a file is missing, empty or an SQLite database of this program.

    `application_id` is the number in the header of its files. Errors call the file `name`, such as
    "store of suspnet".
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
    why = "is not an SQLite database, or its header is damaged"
    if header.startswith(MAGIC) and len(header) == HEADER_BYTES:
        why = "is a database of another application"
    raise ValueError(
        f"{path}: this file {why}: it is not a {name} and is left unchanged; name another file"
    )
