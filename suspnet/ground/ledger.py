"""Ledger of the files that suspnet wrote: only these are replaced, removed or opened for writing.

A folder of results contains ``written.jsonl``. Before a file is written below that folder, its name
relative to the folder and the SHA-256 of its content are appended. A file is ours only if it is a
regular file whose hash the ledger lists for its name. A forged ledger therefore exposes no file
whose content its author does not know, and names that lead elsewhere (absolute ones, ``..``, links)
match no file of the folder.

Logs and TensorBoard events grow, and Hydra writes its own files; these have no hash. They may
exist, but are never opened again.

SQLite writes to any file it opens: a change of the journal mode, a merged write-ahead log, files
next to it. A database is therefore recognised by its header before it is opened.
"""

import errno
import hashlib
import json
import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path

try:
    import fcntl
except ImportError:  # not a POSIX system
    HAS_LOCKS = False
else:
    HAS_LOCKS = True
LEDGER = "written.jsonl"
"""Name of the ledger in a folder of results."""
HEADER = b'"Files that suspnet wrote below this folder: SHA-256, name, end of a temporary name."\n'
"""First line of a ledger; a file of that name without it is not a ledger."""
MOST_NAME_BYTES = 255
"""Longest name of a file that file systems allow, [bytes]."""
MAX_BYTES = 2**28
"""Largest part of a ledger that is read, [bytes]: a million files need half of it."""
UNTOUCHED_FILES = ("*.log", "events.out.tfevents.*")
HYDRA = ".hydra"
"""Folder of a run with the configuration as Hydra has composed it."""
UNTOUCHED_FOLDERS = (HYDRA, ".submitit")
"""Files and folders of a run that have no hash."""
MULTIRUN = "multirun.yaml"
"""File that Hydra rewrites non-atomically: it may be empty after a kill."""
NO_LINKS = getattr(os, "O_NOFOLLOW", 0)
Listed = dict[str, set[str]]
"""Hashes by name; the set of a temporary name is empty."""


def begin(folder: Path) -> bool:
    """Create a folder for results, or continue in one that has only results.

    Returns whether there are results already. FileExistsError names a file that is not ours.
    """
    folder.mkdir(parents=True, exist_ok=True)
    root = _root(folder)
    listed = {} if root is None else _read(root)
    goes_on = False
    for path in _files(folder):
        if path == folder / LEDGER and (root == _absolute(folder) or not path.lstat().st_size):
            continue  # an empty ledger: the program was killed before it wrote the first line
        goes_on = True
        if root is None or not (_is_untouched(path, root, listed) or _is_ours(path, root, listed)):
            words = "suspnet did not write it here, or it was changed since: give a new folder"
            raise FileExistsError(errno.EEXIST, words, str(path))
    if root is None:
        handle = os.open(folder / LEDGER, os.O_CREAT | os.O_APPEND | os.O_WRONLY | NO_LINKS, 0o666)
        with os.fdopen(handle, "wb") as stream:
            stream.write(HEADER)
            stream.flush()
            os.fsync(stream.fileno())
    return goes_on


def note(path: Path, content: bytes, token: str, force: bool = False) -> None:
    """Enter a file into the ledger of its folder or one above, if any, before it is written.

    `token` is the end of its temporary name. FileExistsError is raised if the file
    exists and is not ours, unless `force` replaces it.
    """
    root = _root(path.parent)
    if root is None:
        return
    if not force and os.path.lexists(path) and not _is_ours(path, root, _read(root)):
        words = "suspnet did not write it here, or it was changed since: it is left unchanged"
        raise FileExistsError(errno.EEXIST, words, str(path))
    entry = [hashlib.sha256(content).hexdigest(), _name(path, root), token]
    handle = os.open(root / LEDGER, os.O_APPEND | os.O_WRONLY | NO_LINKS)
    with os.fdopen(handle, "wb") as stream:
        if HAS_LOCKS:  # on network file systems concurrent appends may overwrite each other
            lock(stream.fileno())
        # a new line first: the last one may have been cut off by a kill
        stream.write(b"\n" + json.dumps(entry).encode())
        stream.flush()
        os.fsync(stream.fileno())


def temporary_name(name: str, token: str) -> str:
    """Return the hidden name of a file that is not complete, ``.NAME.TOKEN``."""
    return f".{shortened(name, MOST_NAME_BYTES - len(token) - 2)}.{token}"


def shortened(name: str, most_bytes: int) -> str:
    """Return a name, or its start if it is longer than `most_bytes` in a file system.

    >>> shortened("Züge", 2), shortened("Züge", 5)
    ('Z', 'Züge')
    """
    encoded = os.fsencode(name)
    return name if len(encoded) <= most_bytes else encoded[:most_bytes].decode(errors="ignore")


def remove(path: Path) -> None:
    """Remove a file if it is ours; leave it otherwise."""
    root = _root(path.parent)
    if root is not None and os.path.lexists(path) and _is_ours(path, root, _read(root)):
        path.unlink()


def discard(folder: Path) -> None:
    """Remove the ledger of a finished folder."""
    if _root(folder) == _absolute(folder):
        (folder / LEDGER).unlink()


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


def _root(folder: Path) -> Path | None:
    """Return this folder or the nearest one above that has a writable ledger."""
    start = _absolute(folder)
    for parent in (start, *start.parents):
        file = parent / LEDGER
        with suppress(OSError):
            if stat.S_ISREG(file.lstat().st_mode) and os.access(file, os.W_OK):
                with file.open("rb") as stream:
                    if stream.read(len(HEADER)) == HEADER:
                        return parent
    return None


def _read(root: Path) -> Listed:
    """Return the hashes that a ledger lists; truncated or malformed lines are skipped."""
    listed: Listed = {}
    with (root / LEDGER).open("rb") as stream:
        lines = stream.read(MAX_BYTES).splitlines()
    for line in lines[1:]:
        try:
            sha256, name, token = json.loads(line)
            where, _, last = name.rpartition("/")
            temporary = f"{where}{'/' * bool(where)}{temporary_name(last, token)}"
        except (ValueError, TypeError, AttributeError, RecursionError):
            continue
        listed.setdefault(name, set()).add(str(sha256))
        listed.setdefault(temporary, set())
    return listed


def _files(folder: Path) -> Iterator[Path]:
    """Yield all files and links in a folder and below it, and folders with the name of a log."""

    def refuse(error: OSError) -> None:
        raise error

    for where, folders, names in os.walk(folder, onerror=refuse):
        odd = [
            name
            for name in folders
            if os.path.islink(os.path.join(where, name)) or _is_of_log(name)
        ]
        for name in sorted([*names, *odd]):
            yield Path(where, name)


def _is_untouched(path: Path, root: Path, listed: Listed) -> bool:
    """Return whether a regular file may exist without a hash."""
    name = _name(path, root)
    return stat.S_ISREG(path.lstat().st_mode) and (
        _is_of_log(path.name)
        or any(part in UNTOUCHED_FOLDERS for part in Path(name).parts[:-1])
        or listed.get(name) == set()
    )


def _is_of_log(name: str) -> bool:
    return any(fnmatch(name, pattern) for pattern in UNTOUCHED_FILES)


def _is_ours(path: Path, root: Path, listed: Listed) -> bool:
    """Return whether the ledger lists the hash of a regular file."""
    hashes = listed.get(_name(path, root))
    state = path.lstat()
    if not hashes or not stat.S_ISREG(state.st_mode):
        return False
    if state.st_size == 0 and path.name == MULTIRUN:
        return True
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest() in hashes


def _name(path: Path, root: Path) -> str:
    return _absolute(path).relative_to(root).as_posix()


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


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
