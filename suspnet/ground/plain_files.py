"""Plain files that are opened and read in bounded time and memory, whatever their name leads to."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

MOST_TEXT_BYTES = 2**24
"""Largest size of a file of text: manifests and descriptions of models have kilobytes, and 16 MiB
are parsed in seconds and half a gigabyte."""
MOST_BYTES = 2**34
"""Largest size of a file of arrays that is read whole."""
MOST_EXTENTS = 4096
"""Largest number of stretches of data between the holes of a sparse file that are counted."""
FREE_BYTES, DENSITY = 2**28, 100
"""A file that is read whole may hold 256 MB, and beyond that 100 bytes for each that is stored."""

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (lambda _: True, "a device"),
)


class NotPlainError(ValueError):
    """A path leads to something other than a plain file, or to one that is too large."""


def open_plain(path: Path) -> BinaryIO:
    """Return a plain file, or one that a link leads to, open for reading; it never waits.

    Raises
    ------
    NotPlainError
        If it is a folder, a named pipe, a socket or a device.
    OSError
        If it cannot be opened, FileNotFoundError among them.
    """
    _check(path, os.stat(path).st_mode)  # opening some devices already does something
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

    Raises
    ------
    NotPlainError
        If it is no plain file, holds more than `most_bytes`, or hardly stores any of what it holds.
    OSError
        If it cannot be read, FileNotFoundError among them.
    """
    with open_plain(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > FREE_BYTES:
            most_bytes = min(most_bytes, FREE_BYTES + DENSITY * stored_bytes(stream))
        if size > most_bytes:
            raise NotPlainError(
                f"{path} is of {size} bytes; at most {most_bytes} are read of such a file"
            )
        return stream.read(size)


def stored_bytes(stream: BinaryIO) -> int:
    """Return how many bytes of a file are stored; holes of a sparse file are not."""
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
    except OSError:  # there are no more data
        pass
    finally:
        os.lseek(handle, before, os.SEEK_SET)
    return stored


def _check(path: Path, mode: int) -> None:
    """Raise NotPlainError if a file is not a plain one."""
    if not stat.S_ISREG(mode):
        kind = next(name for is_kind, name in _KINDS if is_kind(mode))
        raise NotPlainError(f"{path} is {kind}, not a plain file")
