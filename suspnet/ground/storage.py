"""Files that are written atomically, and read in bounded time and memory even if malicious."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from suspnet.ground.findings import Finding
from suspnet.ground.own_files import HAS_LOCKS, MOST_NAME_BYTES, lock, shortened

if TYPE_CHECKING:
    import pyarrow as pa

UNPRINTABLE = re.compile(
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u061c\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069\\ud800-\\udfff]"
)
"""Control characters, marks of writing direction and surrogates: see ``printable``."""


class DamagedFileError(ValueError):
    """A file is truncated, altered or of another format."""


class NotPlainError(DamagedFileError):
    """A path is not a plain file, or the file is too large."""


def write_atomically(path: Path, content: bytes | str) -> Path:
    """Write a file that gets its name only when it is complete and on the disk.

    A hidden file in the same folder is written and renamed, which replaces a link, not the file
    that it leads to. A failed write leaves no file behind.
    """
    data = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(4)
    start = shortened(path.name, MOST_NAME_BYTES - len(token) - 2)
    temporary = path.with_name(f".{start}.{token}")
    try:
        with temporary.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return path


def new_folder(wanted: Path) -> Path:
    """Create a new folder and return it: `wanted`, or `wanted`_2, _3, ... if that exists."""
    wanted.parent.mkdir(parents=True, exist_ok=True)
    number, folder = 1, wanted
    while True:  # ends: there are fewer folders than numbers
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1
            folder = wanted.with_name(f"{wanted.name}_{number}")


@contextmanager
def locked(folder: Path, wait: bool = True) -> Iterator[bool]:
    """Lock a folder against other threads and processes that lock it too.

    Yields False if another one holds the lock and `wait` is false, else True, also on file systems
    without locks.
    """
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY) if HAS_LOCKS else None
    try:
        yield handle is None or lock(handle, wait)
    finally:
        if handle is not None:
            os.close(handle)


def write_json(path: Path, content: Any) -> Path:
    """Write `content` as indented JSON, atomically; NaN becomes null."""
    return write_atomically(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def json_bytes(content: Any) -> bytes:
    """Return `content` as JSON on one line; NaN becomes null."""
    return json.dumps(_finite(content), allow_nan=False).encode()


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; DamagedFileError if it is too large or no JSON."""
    content = read_plain(path)
    try:
        return json.loads(content.decode())
    except RecursionError as error:
        raise DamagedFileError(f"{path} is not a suspnet file: it is nested too deeply") from error
    except ValueError as error:
        raise DamagedFileError(f"{path} is damaged or not JSON ({error})") from error


def dump_arrays(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays in the safetensors format."""
    return save({name: np.array(array, order="C") for name, array in arrays.items()})


def read_arrays(path: Path, sha256: str | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays of a safetensors file, whose hash must be `sha256` if that is given.

    DamagedFileError is raised if it is not a plain file, truncated, altered or of another format.
    """
    return load_arrays(read_plain(path, MOST_BYTES), str(path), sha256)


def load_arrays(content: bytes, name: str, sha256: str | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays of `content` in the safetensors format; errors name it `name`.

    DamagedFileError is raised if it is truncated, of another format or has another hash than
    `sha256`.
    """
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise DamagedFileError(
            f"{name} is damaged: its {len(content)} bytes do not match the hash stored with it"
        )
    try:
        return load(content)
    except (SafetensorError, ValueError, KeyError, OverflowError) as error:
        raise DamagedFileError(f"{name} is damaged or not a safetensors file ({error})") from error


def content_hash(description: Any) -> str:
    """Return the SHA-256 of a JSON-able description, which names files made from it."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def distinct(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return file names that differ in more than case, also from those taken: a, a_2, a_3."""
    seen, unique = set(taken), []
    last: dict[str, int] = {}
    for base in names:
        name, number = base, last.get(base, 1)
        while name.lower() in seen:  # ends: there are fewer names than numbers
            number += 1
            name = f"{base}_{number}"
        last[base] = number
        seen.add(name.lower())
        unique.append(name)
    return unique


def why(error: OSError) -> str:
    """Return the file and the reason of an error, without its number."""
    return f"{error.filename}: {error.strerror}" if error.filename else str(error)


def printable(text: str) -> str:
    """Return text that is safe in files and terminals.

    Control characters other than newlines and tabs, marks of writing direction, and bytes that are
    not UTF-8 are escaped.
    """
    return UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


def one_line(text: str) -> str:
    """Return text as ``printable`` does, with newlines escaped too."""
    return printable(text).replace("\n", "\\n")


def _finite(content: Any) -> Any:
    """Return JSON-able values with null for NaN and infinity."""
    if isinstance(content, Mapping):
        return {str(key): _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    value = content.item() if isinstance(content, np.generic) else content
    return None if isinstance(value, float) and not np.isfinite(value) else value


MOST_TEXT_BYTES = 2**24
"""Largest size of a text file, [bytes]. Manifests and model descriptions have kilobytes; parsing
16 MiB takes seconds and half a gigabyte."""
MOST_BYTES = 2**34  # largest size of a file of arrays that is read at once, [bytes]
MOST_EXTENTS = 4096  # largest number of data extents of a sparse file that are counted
FREE_BYTES, DENSITY = 2**28, 100
"""A file read at once may have 256 MiB, and beyond that 100 bytes for each stored byte."""
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (lambda _: True, "a device"),
)


def open_plain(path: Path) -> BinaryIO:
    """Open a plain file, or one that a link leads to, for reading, without ever blocking.

    NotPlainError is raised for a folder, a named pipe, a socket or a device.
    """
    _check(path, os.stat(path).st_mode)  # merely opening some devices has side effects
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
    handle = os.open(path, flags | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0))
    try:
        _check(path, os.fstat(handle).st_mode)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_plain(path: Path, most_bytes: int = MOST_TEXT_BYTES) -> bytes:
    """Return the content of a plain file.

    NotPlainError is raised if it is not a plain file, larger than `most_bytes`, or sparse and large
    (``DENSITY``).
    """
    with open_plain(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > FREE_BYTES:
            most_bytes = min(most_bytes, FREE_BYTES + DENSITY * stored_bytes(stream))
        if size > most_bytes:
            raise NotPlainError(
                Finding("file-too-large", path=path, size=size, most_bytes=most_bytes)
            )
        return stream.read(size)


def stored_bytes(stream: BinaryIO) -> int:
    """Return the number of stored bytes of a file, without the holes of a sparse file."""
    handle = stream.fileno()
    size = os.fstat(handle).st_size
    if not hasattr(os, "SEEK_HOLE"):
        return size
    place, stored, before = 0, 0, os.lseek(handle, 0, os.SEEK_CUR)
    try:
        for _ in range(MOST_EXTENTS):
            start = os.lseek(handle, place, os.SEEK_DATA)
            place = os.lseek(handle, start, os.SEEK_HOLE)
            stored += place - start
        stored += size - place
    except OSError:  # no more data
        pass
    finally:
        os.lseek(handle, before, os.SEEK_SET)
    return stored


def _check(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = next(name for is_kind, name in _KINDS if is_kind(mode))
        raise NotPlainError(Finding("not-plain", path=path, kind=kind))


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table to `path` with the suffixes .parquet and .csv."""
    import pyarrow.csv as pacsv  # takes a quarter of a second
    import pyarrow.parquet as pq

    for suffix, write in ((".parquet", pq.write_table), (".csv", pacsv.write_csv)):
        stream = io.BytesIO()
        write(table, stream)
        write_atomically(path.with_name(path.name + suffix), stream.getvalue())
