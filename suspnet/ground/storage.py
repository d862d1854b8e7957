"""Files written atomically, and arrays checked before they are used."""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from suspnet.ground import ledger
from suspnet.ground.ledger import HAS_LOCKS, lock
from suspnet.ground.plain_files import MOST_BYTES, MOST_TEXT_BYTES, NotPlainError, read_plain

DESCRIPTORS = "/proc/self/fd"
"""Where Linux shows a process the files that it has open."""


UNPRINTABLE = re.compile(
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u061c\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069\\ud800-\\udfff]"
)


class DamagedFileError(ValueError):
    """A file is truncated, altered or of another format."""


def write_atomically(path: Path, content: bytes | str, force: bool = False) -> Path:
    """Write a file that has no name in its folder before it is whole and on the disk.

    Where the file system has no files without a name, a hidden one in the same folder is written
    and renamed. In a folder of results it is entered in the ledger first.

    Parameters
    ----------
    path : Path
    content : bytes or str
    force : bool
        Whether it replaces a file of a folder of results that this package did not write.

    Raises
    ------
    FileExistsError
        If the folder is one of results and holds such a file that this package did not write.
    OSError
        If the folder cannot be written; nothing is left behind.
    """
    data = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(4)
    temporary = path.parent / f".{path.name}.{token}"
    ledger.note(path, data, token, force)
    try:
        handle, is_named = _opened(temporary)
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
            if not is_named:
                _name(stream.fileno(), temporary)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return path


def _opened(temporary: Path) -> tuple[int, bool]:
    """Return a new file's descriptor, and whether it is named `temporary` or has no name."""
    if hasattr(os, "O_TMPFILE") and os.path.isdir(DESCRIPTORS):
        try:
            return os.open(temporary.parent, os.O_TMPFILE | os.O_WRONLY, 0o666), False
        except OSError:  # the file system has no such files, or cannot be written at all
            pass
    return os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666), True


def _name(handle: int, path: Path) -> None:
    """Give a file that has no name one."""
    folder = os.open(path.parent, os.O_RDONLY)
    try:  # with a folder's descriptor Python follows the link of /proc
        os.link(f"{DESCRIPTORS}/{handle}", path.name, dst_dir_fd=folder, follow_symlinks=True)
    finally:
        os.close(folder)


def new_folder(wanted: Path) -> Path:
    """Make a folder that nobody else has, and return it: `wanted`, or `wanted`_2, _3, ...

    Raises
    ------
    OSError
        If it cannot be made.
    """
    wanted.parent.mkdir(parents=True, exist_ok=True)
    for number in count(1):  # ends: there are fewer folders than numbers
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}_{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise AssertionError("unreachable")


@contextmanager
def locked(folder: Path, wait: bool = True) -> Iterator[bool]:
    """Keep other threads and processes that lock a folder too out of it.

    Yields
    ------
    bool
        False if someone else has it and `wait` is false. True where the file system has no locks.
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
    """Return what a JSON file holds.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    DamagedFileError
        If it is no plain file, too large or not valid JSON.
    """
    try:
        return json.loads(_read(path, MOST_TEXT_BYTES).decode())
    except DamagedFileError:
        raise
    except RecursionError as error:
        raise DamagedFileError(f"{path} is not ours: it is nested too deeply") from error
    except ValueError as error:
        raise DamagedFileError(f"{path} is damaged or not JSON ({error})") from error


def _read(path: Path, most_bytes: int) -> bytes:
    """Return the content of a plain file; DamagedFileError if it is none or too large."""
    try:
        return read_plain(path, most_bytes)
    except NotPlainError as error:
        raise DamagedFileError(str(error)) from error


def dump_arrays(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays in the safetensors format."""
    return save({name: np.array(array, order="C") for name, array in arrays.items()})


def read_arrays(path: Path, sha256: str | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays of a safetensors file.

    Parameters
    ----------
    path : Path
    sha256 : str, optional
        The hash the file must have.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    DamagedFileError
        If the file is no plain file, truncated, altered or of another format.
    """
    return load_arrays(read_array_file(path), str(path), sha256)


def read_array_file(path: Path) -> bytes:
    """Return the bytes of a safetensors file; raises as `read_arrays`, but arrays are unchecked."""
    return _read(path, MOST_BYTES)


def load_arrays(content: bytes, name: str, sha256: str | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays of bytes in the safetensors format.

    Parameters
    ----------
    content : bytes
    name : str
        What the error's message begins with.
    sha256 : str, optional
        The hash the bytes must have.

    Raises
    ------
    DamagedFileError
        If they are truncated, altered or of another format.
    """
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise DamagedFileError(
            f"{name} is damaged: its {len(content)} bytes do not match the hash kept with it"
        )
    try:
        return load(content)
    except (SafetensorError, ValueError, KeyError, OverflowError) as error:
        raise DamagedFileError(f"{name} is damaged or not a safetensors file ({error})") from error


def content_hash(description: Any) -> str:
    """Return the SHA-256 of a JSON-able description, for naming what was made from it."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def printable(text: str) -> str:
    """Return text that every file can hold and that moves nothing on a terminal.

    Control characters but ends of lines and tabs, marks that turn the direction of writing, and
    bytes of a name that are not UTF-8 stand as escapes.
    """
    return UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def _finite(content: Any) -> Any:
    """Return JSON-able values with null for NaN and infinity."""
    if isinstance(content, Mapping):
        return {str(key): _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, np.generic):
        content = content.item()
    if isinstance(content, float) and not np.isfinite(content):
        return None
    return content
