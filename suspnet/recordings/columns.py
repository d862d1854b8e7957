"""What a data file holds: its columns with unit, rate and clock where it says them, and blocks."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.recordings.bounds import check_samples
from suspnet.recordings.checked_mapping import TripError

BLOCK = 2**18
"""Largest number of samples of a column in one block."""

LISTED = 20
"""Largest number of columns that an error message lists."""

Block = tuple[NDArray[Any], ...]
"""One array (n_samples,) for each column: float64, or datetime64[ns] of time stamps."""

Take = Callable[[slice], Any]


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
