"""What a data file holds: its columns with unit, rate and clock where it says them, and blocks."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.storage import open_plain, stored_bytes
from suspnet.recordings.manifest import ACCELERATION_UNITS, SPEED_UNITS, TIME_UNITS, CsvDialect
from suspnet.recordings.manifest_keys import TripError

BLOCK = 2**18
"""Largest number of samples of a column in one block."""

LISTED = 20
"""Largest number of columns that an error message lists."""

Block = tuple[NDArray[Any], ...]
"""One array (n_samples,) for each column: float64, or datetime64[ns] of time stamps."""

Take = Callable[[slice], Any]

SHARED_BYTES = 8 * 8 * BLOCK
"""Size of the memory that a reading process shares with the one that asks: eight columns."""


@dataclass(frozen=True)
class Column:
    """One column of a file, and what the file says of it; None where it says nothing.

    Attributes
    ----------
    name : str
    unit : str or None
        As written in the file.
    rate_hz : float or None, [Hz]
    time : str or None
        The column that holds the times of this one.
    start_ns : int or None, [ns]
        Since 1970 in UTC: when the first sample was taken or, with `time`, what its times are
        counted from.
    is_time : bool
        Holds time stamps rather than numbers.
    is_zoned : bool
        Its time stamps are in UTC; otherwise in an unknown zone.
    is_part : bool
        One column of a matrix; it is read by its name only.
    is_whole_rate : bool
        The format keeps the rate as a whole number.
    date : str or None
        When the recording began, by a header that is too coarse to align clocks by; as written.
    full_scale : float or None
        Of integers that stand for a fraction of the range: the largest value.
    """

    name: str
    unit: str | None = None
    rate_hz: float | None = None
    time: str | None = None
    start_ns: int | None = None
    is_time: bool = False
    is_zoned: bool = False
    is_part: bool = False
    is_whole_rate: bool = False
    full_scale: float | None = None
    date: str | None = None


@dataclass(frozen=True)
class OpenFile:
    """A file that is open for reading.

    Attributes
    ----------
    columns : tuple of Column
        In the order of the file.
    read : callable
        Takes names of columns and yields their blocks.
    words : str
        How it is read, where that had to be found out; otherwise empty.
    hint : str
        Added to the message where a column is missing.
    """

    columns: tuple[Column, ...]
    read: Callable[[Sequence[str]], Iterator[Block]]
    words: str = ""
    hint: str = ""

    def column(self, name: str) -> Column:
        """Return what the file says of one of its columns."""
        return next(column for column in self.columns if column.name == name)


Reader = Callable[[Path, CsvDialect | None], AbstractContextManager[OpenFile]]
"""Opens a file of one format."""


def choose(path: Path, file: OpenFile, columns: Sequence[str | None]) -> list[str]:
    """Return the name of each column, None replaced by the only one that is not named.

    Raises
    ------
    TripError
        If a column is missing, named like another, or None and not the only one.
    """
    present = [column.name for column in file.columns]
    listed = [column.name for column in file.columns if not column.is_part]
    named = [name for name in columns if name is not None]
    for name in named:
        if name not in present:
            raise TripError(
                f"{path} has no column {name!r} of numbers; it has {listing(listed)}{file.hint}"
            )
    times = {column.time for column in file.columns} | set(named)
    others = [c.name for c in file.columns if not (c.is_part or c.is_time or c.name in times)]
    if len(named) < len(columns) and len(others) != 1:
        raise TripError(f"{path}: say which `column` to read; there are {listing(others)}")
    names = [others[0] if name is None else name for name in columns]
    for name in names:
        if present.count(name) > 1:
            raise TripError(f"{path} has {present.count(name)} columns {name!r}; rename them")
    return names


def listing(names: Sequence[str]) -> str:
    """Return names for a message, at most ``LISTED`` of them."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return f"{list(names[:LISTED])}{more}"


def slices(
    path: Path, names: Sequence[str], lengths: Sequence[int], takes: Sequence[Take]
) -> Iterator[Block]:
    """Yield blocks of arrays; raise TripError if their lengths differ, or are beyond bounds."""
    check_samples(path, max(lengths, default=0))
    if len(set(lengths)) > 1:
        raise TripError(f"{path}: columns {list(names)} have different lengths {list(lengths)}")
    for start in range(0, lengths[0], BLOCK):
        part = slice(start, min(start + BLOCK, lengths[0]))
        yield tuple(as_block(take(part)) for take in takes)


def as_block(values: Any) -> NDArray[Any]:
    """Return values as float64, or as datetime64[ns] where they are time stamps."""
    array = np.asarray(values)
    return array.astype("datetime64[ns]" if array.dtype.kind == "M" else np.float64, copy=False)


def is_vector(shape: Sequence[int]) -> bool:
    """Return whether an array has one dimension besides those of length 1."""
    return len(shape) > 0 and int(np.prod(shape, dtype=np.int64)) == max(shape)


def needed(path: Path, module: str, extra: str, what: str) -> Any:
    """Return the module that reads a format; TripError says how to install it if it is absent."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise TripError(
            f'{path}: {what} needs {module}; run: pip install "suspnet[{extra}]"'
        ) from error


MOST_SAMPLES = 48 * 3600 * 10_000
"""Largest number of samples of a channel: two days at 10 kHz."""
FREE_SAMPLES = 2**26
"""Number of samples that any file may declare, as a channel of nothing but zeros may be packed into
a few bytes: 3.7 hours at 5 kHz, 18 hours at 1 kHz."""
SAMPLES_PER_BYTE = 8
"""Number of samples beyond those for each byte that is stored. Packed noise takes a byte or more
for each sample, so that seven eighths of a long recording may be zeros that take no space."""

FREE_MEMORY, MEMORY_PER_BYTE = 5 * 2**28, 16
"""Memory that the reader of a file may take: 1.25 GiB, and 16 bytes for each that is stored.

Columns of MAT and UFF files are read whole: 8 bytes for each sample, twice, of 2 bytes or less."""
FREE_S, SECONDS_PER_BYTE, MOST_S = 20.0, 1e-6, 300.0
"""Time [s] that a reader may take for one step: 20 s, and 1 s for each megabyte, at most 300 s."""
MOST_CHUNK_BYTES = 2**28
"""Largest size of what must be unpacked at once to read one sample of an HDF5 file."""


def most_samples(path: Path) -> int:
    """Return the largest number of samples that a channel of a file may have."""
    with open_plain(path) as stream:
        return min(MOST_SAMPLES, FREE_SAMPLES + SAMPLES_PER_BYTE * stored_bytes(stream))


def check_samples(path: Path, n_samples: int) -> None:
    """Raise TripError if a file declares more samples than a recording of its size has."""
    if n_samples > FREE_SAMPLES and n_samples > (most := most_samples(path)):
        raise TripError(
            f"{path} declares {n_samples} samples in one column; at most {most} are read of a file "
            "that stores so little. Export the recording again, in parts if it is that long"
        )


def memory_bytes(stored: int) -> int:
    """Return how much memory the reader of a file may take, by the bytes that are stored."""
    return FREE_MEMORY + MEMORY_PER_BYTE * stored


def step_s(stored: int) -> float:
    """Return how long a step of the reader of a file may take [s], by the bytes that are stored."""
    return min(MOST_S, FREE_S + round(SECONDS_PER_BYTE * stored))


GRAVITY = ACCELERATION_UNITS["g"]

_SPELLINGS = {
    "acceleration": {
        1.0: ("m/s2", "m/s^2", "m/s**2", "m/s/s", "ms-2", "ms^-2", "m*s^-2", "m*s-2", "m.s-2"),
        1e-3: ("mm/s2", "mm/s^2"),
        1e-2: ("cm/s2", "cm/s^2", "gal"),
        GRAVITY: ("g", "gn", "g0", "g_n"),
        GRAVITY / 1e3: ("mg",),
    },
    "speed": {
        1.0: ("m/s", "ms-1", "m*s^-1", "mps"),
        SPEED_UNITS["km/h"]: ("km/h", "kmh", "kph", "kmph", "kmh-1", "km*h^-1"),
        0.44704: ("mph", "mi/h"),
        1852 / 3600: ("kn", "kt", "knots", "knot"),
    },
    "time": {
        1.0: ("s", "sec", "second", "seconds"),
        1e-3: ("ms", "msec", "milliseconds"),
        1e-6: ("us", "usec", "microseconds"),
        1e-9: ("ns", "nsec", "nanoseconds"),
    },
}
_SIZES = {
    kind: {spelling: size for size, names in sizes.items() for spelling in names}
    for kind, sizes in _SPELLINGS.items()
}
_STATED: Mapping[str, Mapping[str, float]] = {
    "acceleration": ACCELERATION_UNITS,
    "speed": SPEED_UNITS,
    "time": TIME_UNITS,
}


def size_of(kind: str, text: str | None) -> float | None:
    """Return the size of a unit of a file in SI; None if it is empty or not known.

    Parameters
    ----------
    kind : {"acceleration", "speed", "time"}
    text : str or None
    """
    plain = re.sub(r"[\s\[\]()]", "", text or "").replace("²", "2").replace("·", "*")
    plain = plain.replace("µ", "u").replace("μ", "u").replace("⁻", "-").replace("¹", "1")
    sizes = _SIZES[kind]
    return sizes.get(plain, sizes.get(plain.lower()))


def is_unit(text: str) -> bool:
    """Return whether a text is a known unit of acceleration, speed or time."""
    return any(size_of(kind, text) is not None for kind in _SIZES)


def unit_in_name(name: str) -> str:
    """Return the unit in the brackets at the end of a column's name; empty if there is none."""
    match = re.search(r"[\[(]([^\[\]()]+)[\])]\s*$", name)
    return match.group(1).strip() if match and is_unit(match.group(1)) else ""


def agreed_size(where: str, kind: str, stated: str | None, written: str | None) -> float:
    """Return the size in SI of the unit of a column, by the manifest or by its file.

    Raises
    ------
    TripError
        If they contradict each other, or neither says a unit that is known.
    """
    found = size_of(kind, written)
    known = _STATED[kind]
    if stated is None:
        if found is None:
            says = f"says {written!r}, which is not known" if written else "does not say it"
            raise TripError(f"{where}: `unit` is missing, and the file {says}; give {list(known)}")
        return found
    if found is not None and abs(found / known[stated] - 1) > 1e-9:
        raise TripError(
            f"{where}: `unit` says {stated!r}, its file says {written!r}; correct one, or leave "
            "`unit` out to take the file's"
        )
    return known[stated]
