"""Content of a data file: columns, with unit, rate and clock if it states them, and blocks."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.findings import Finding
from suspnet.ground.storage import open_plain, stored_bytes
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest_sources import ACCELERATION_UNITS, SPEED_UNITS, UNITS

MOST_DRIFT = 2e-4
"""Largest relative error of a logger's rate: 200 ppm, several times that of quartz. Times may drift
by this much from the stated rate without a gap."""
BLOCK = 2**18  # largest number of samples of a column in one block
LISTED = 20  # largest number of columns that an error message lists
Block = tuple[NDArray[Any], ...]
"""One array (n_samples,) for each column: float64, or datetime64[ns] for time stamps."""
Take = Callable[[slice], Any]
MOST_BLOCK_BYTES = 8 * 8 * BLOCK
"""Largest size of a block that a reader process sends: eight columns [bytes]."""


@dataclass(frozen=True)
class Column:
    """One column of a file, as the file describes it; None where it states nothing.

    `unit` is as written in the file, `time` the name of the column with the times of this one.
    `start_ns` is the time of the first sample or, with `time`, the origin of its times, since 1970
    in UTC, or in the logger's unknown time zone if `is_local`. `is_time`: it holds time stamps
    rather than numbers; `is_zoned`: they are in UTC rather than an unknown zone. `date` is the
    start of the recording as written in a header, too coarse to align clocks. `unread` is why it
    holds neither numbers nor times that can be read; empty if it does. `is_fraction`: its values
    are fractions of the sensor's range. `is_whole_rate`: the format stores no other rates.
    """

    name: str
    unit: str | None = None
    rate_hz: float | None = None
    time: str | None = None
    start_ns: int | None = None
    is_time: bool = False
    is_zoned: bool = False
    date: str | None = None
    unread: str = ""
    is_local: bool = False
    is_fraction: bool = False
    is_whole_rate: bool = False


@dataclass(frozen=True)
class OpenFile:
    """A file that is open for reading.

    `read` yields blocks of the named columns. `words` states how the file is read if this was
    detected. `notes` are lines in which the logger describes the recording. `remarks` grow while
    blocks are read: what was left out.
    """

    columns: tuple[Column, ...]
    read: Callable[[Sequence[str]], Iterator[Block]]
    words: str = ""
    notes: tuple[str, ...] = ()
    remarks: list[str] = field(default_factory=list)

    def column(self, name: str) -> Column:
        """Return a column by its name."""
        return next(column for column in self.columns if column.name == name)


Reader = Callable[[Path], AbstractContextManager[OpenFile]]
"""Function that opens a file of one format."""


def choose(path: Path, file: OpenFile, columns: Sequence[str | None]) -> list[str]:
    """Return the name of each column, with None replaced by the only column not named.

    Raises TripError if a column is missing or its name not unique, or if None is ambiguous.
    """
    present = Counter(column.name for column in file.columns)
    named = [name for name in columns if name is not None]
    for name in named:
        if name not in present:
            listed = listing([c.name for c in file.columns if not c.unread])
            raise TripError(Finding("no-column", path=path, name=repr(name), names=listed))
        if reason := file.column(name).unread:
            raise TripError(Finding("column-unread", path=path, name=repr(name), unread=reason))
    # the column of times of another one is never the only one left
    times = {column.time for column in file.columns} | set(named)
    others = [c.name for c in file.columns if not (c.is_time or c.unread or c.name in times)]
    if len(named) < len(columns) and len(others) != 1:
        raise TripError.at(path, "say-which-column", names=listing(others))
    names = [others[0] if name is None else name for name in columns]
    for name in names:
        if (n := present[name]) > 1:
            raise TripError(Finding("columns-of-same-name", path=path, count=n, name=repr(name)))
    return names


def listing(names: Sequence[str]) -> str:
    """Return at most ``LISTED`` names as text for a message."""
    n_more = len(names) - LISTED
    if n_more > 0:
        return Finding("names-and-more", names=list(names[:LISTED]), n=n_more)
    return str(list(names))


def slices(
    path: Path, names: Sequence[str], takes: Mapping[str, tuple[int, Take]]
) -> Iterator[Block]:
    """Yield blocks of arrays, of which `takes` gives the lengths and how to take rows of them.

    TripError is raised if the lengths differ or are too large.
    """
    lengths = [takes[name][0] for name in names]
    check_samples(path, max(lengths, default=0))
    if len(set(lengths)) > 1:
        raise TripError.at(path, "different-lengths", names=list(names), lengths=lengths)
    n = lengths[0]
    for start in range(0, n, BLOCK):
        rows = slice(start, min(start + BLOCK, n))
        block = tuple(as_block(takes[name][1](rows)) for name in names)
        ends = [start + len(values) for values in block]
        if set(ends) != {rows.stop}:
            values = {"n_samples": n, "names": list(names), "held": ends}
            raise TripError(Finding("fewer-than-declared", path=path, **values))
        yield block


def as_block(values: Any) -> NDArray[Any]:
    """Return values as float64, or time stamps as datetime64[ns]."""
    array = np.asarray(values)
    return array.astype("datetime64[ns]" if array.dtype.kind == "M" else np.float64, copy=False)


def is_vector(shape: Sequence[int]) -> bool:
    """Return whether an array has at most one dimension that is longer than 1."""
    return len(shape) > 0 and int(np.prod(shape, dtype=np.int64)) == max(shape)


MOST_SAMPLES = 48 * 3600 * 10_000  # largest number of samples of a channel: two days at 10 kHz
FREE_SAMPLES = 2**26
"""Number of samples that a file of any size may declare, as a channel of zeros compresses to a few
bytes: 3.7 hours at 5 kHz, 18 hours at 1 kHz."""
SAMPLES_PER_BYTE = 8
"""Number of further samples per stored byte. Compressed noise takes a byte or more per sample, so
seven eighths of a long recording may be zeros that take no space."""
FREE_MEMORY, MEMORY_PER_BYTE = 5 * 2**28, 16
"""Memory that the reader of a file may use: 1.25 GiB, plus 16 bytes per stored byte.

Columns of MAT and UFF files are read whole: two copies of 8 bytes per sample of 1 or 2 bytes."""
FREE_S, SECONDS_PER_BYTE, MOST_S = 20.0, 1e-6, 300.0
"""Time [s] that a reader may take for one step: 20 s, plus 1 s per megabyte, at most 300 s."""


def check_samples(path: Path, n_samples: int) -> None:
    """Raise TripError if a file declares more samples than a recording of its size can have."""
    if n_samples <= FREE_SAMPLES:
        return
    with open_plain(path) as stream:
        most = min(MOST_SAMPLES, FREE_SAMPLES + SAMPLES_PER_BYTE * stored_bytes(stream))
    if n_samples > most:
        raise TripError(Finding("too-many-samples", path=path, n_samples=n_samples, most=most))


def memory_bytes(stored: int) -> int:
    """Return how much memory the reader of a file with `stored` bytes may use."""
    return FREE_MEMORY + MEMORY_PER_BYTE * stored


def step_s(stored: int) -> float:
    """Return how long one step of the reader of a file with `stored` bytes may take, [s]."""
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
        60.0: ("minutes",),
        3600.0: ("hours",),
        86400.0: ("days",),
    },
}
_SIZES = {
    kind: {spelling: size for size, names in sizes.items() for spelling in names}
    for kind, sizes in _SPELLINGS.items()
}


def size_of(kind: str, text: str | None) -> float | None:
    """Return the SI size of a unit as files write it; None if it is empty or unknown.

    `kind` is "acceleration", "speed" or "time".
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
    """Return the SI size of a column's unit, as stated in the manifest or written in its file.

    Raises TripError if they contradict each other, or neither gives a known unit.
    """
    size, sizes = size_of(kind, written), UNITS[kind]
    if stated is None:
        if size is None:
            problem = "unit-unknown" if written else "unit-not-said"
            raise TripError.at(where, problem, written=repr(written), known=list(sizes))
        return size
    if size is not None and abs(size / sizes[stated] - 1) > 1e-9:
        raise TripError.at(where, "unit-differs", stated=repr(stated), written=repr(written))
    return sizes[stated]
