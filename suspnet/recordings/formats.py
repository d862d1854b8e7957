"""Columns of data files of every format, a block at a time: one line of ``FORMATS`` each."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet
from scipy.io.matlab import MatReadError

from suspnet.ground.storage import NotPlainError, open_plain
from suspnet.recordings.array_files import open_hdf5, open_mat
from suspnet.recordings.columns import (
    BLOCK,
    Block,
    OpenFile,
    Reader,
    check_samples,
    choose,
)
from suspnet.recordings.csv_files import open_csv, open_parquet
from suspnet.recordings.logger_files import open_tdms, open_uff, open_wav
from suspnet.recordings.manifest import CsvDialect
from suspnet.recordings.manifest_keys import TripError
from suspnet.recordings.mdf_files import open_mdf
from suspnet.recordings.reader_process import in_own_process


@contextmanager
def open_file(path: Path, csv: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a data file: its columns with unit, rate and times as far as it says them.

    Parameters
    ----------
    path : Path
        The suffix, one of ``READERS``, says what the file is.
    csv : CsvDialect, optional
        How it is written, as far as that is not to be found out.

    Raises
    ------
    TripError
        If the file is missing, empty, damaged or of another format, or the package that reads it
        is not installed; also where it is read.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise TripError(f"{path}: files of type {suffix!r} cannot be read; give {sorted(READERS)}")
    if csv is not None and READERS[suffix] is not open_csv:
        raise TripError(f"{path}: `csv` is for files of type {list(CSV_SUFFIXES)}")
    try:
        with open_plain(path) as stream:
            if not stream.read(1):
                raise TripError(f"{path} is empty")
    except FileNotFoundError as error:
        raise TripError(f"{path}: there is no such file") from error
    except OSError as error:
        raise TripError(f"{path}: cannot be read ({error.strerror})") from error
    except NotPlainError as error:
        raise TripError(str(error)) from error
    with ExitStack() as stack:
        with _named(path):
            file = stack.enter_context(READERS[suffix](path, csv))
        yield file


def open_columns(
    path: Path, columns: Sequence[str | None], csv: CsvDialect | None = None
) -> Iterator[Block]:
    """Yield some columns of a file, in blocks of at most ``BLOCK`` samples.

    Nothing is ever unpickled. Missing values become NaN. All formats but UFF, WAV of 24 bits, and
    MAT before version 7.3 are read piece by piece, so the file may be larger than memory.

    Parameters
    ----------
    path : Path
    columns : sequence of str or None
        Names of the columns; TDMS channels are named "group/channel", columns of a matrix
        "name[0]", fields of a struct "struct.field". None is the only column that is not named.
    csv : CsvDialect, optional

    Yields
    ------
    tuple of arrays of shape (n_samples,)
        One for each of `columns`: float64, or datetime64[ns] of time stamps.

    Raises
    ------
    TripError
        If the file is missing, empty, damaged or of another format, or if a column is missing, is
        not numeric or is not the only one. Nothing is raised before the first block is asked for.
    """
    with open_file(path, csv) as file:
        yield from read_columns(path, file, columns)


def read_columns(path: Path, file: OpenFile, columns: Sequence[str | None]) -> Iterator[Block]:
    """Yield some columns of a file that is open; see `open_columns`."""
    n_samples = 0
    with _named(path):
        names = choose(path, file, columns)
        for block in file.read(names):
            for start in range(0, len(block[0]), BLOCK):
                yield tuple(column[start : start + BLOCK] for column in block)
            n_samples += len(block[0])
            check_samples(path, n_samples)
    if n_samples == 0:
        raise TripError(f"{path} is empty: its columns hold no samples")


@contextmanager
def _named(path: Path) -> Iterator[None]:
    try:
        yield
    except TripError:
        raise
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200]
        suffix = path.suffix.lower()
        raise TripError(f"{path} is damaged, cut off or not a {suffix} file ({reason})") from error


@dataclass(frozen=True)
class Format:
    """One format of data files.

    Another format is a function that opens a file, in a module of its own or of its kind, and one
    line of ``FORMATS``.

    Parameters
    ----------
    suffixes : tuple of str
        By which a file is known to have it.
    open : callable
        Gives an `OpenFile`: its columns with all that the file says of them, and `read`, which
        yields blocks of some of them.
    library : str, optional
        A package that `open` imports.
    in_own_process : bool
        Whether it runs in a confined process: whatever declares sizes or may crash its library.
    """

    suffixes: tuple[str, ...]
    open: Reader
    library: str | None = None
    in_own_process: bool = True

    @property
    def reader(self) -> Reader:
        """What opens a file, in the process that it belongs to."""
        return in_own_process(self.open, self.library) if self.in_own_process else self.open


CSV_SUFFIXES = (".csv", ".txt", ".tsv", ".asc")

FORMATS = (
    Format((".parquet",), open_parquet, "pandas"),  # Arrow imports it for its first array
    # its text declares nothing, and no damaged file has crashed its reader
    Format(CSV_SUFFIXES, open_csv, in_own_process=False),
    Format((".mat",), open_mat, "h5py"),
    Format((".h5", ".hdf5"), open_hdf5, "h5py"),
    Format((".tdms",), open_tdms, "nptdms"),
    Format((".mf4", ".mdf"), open_mdf, "asammdf"),
    Format((".uff", ".unv"), open_uff, "pyuff"),
    Format((".wav",), open_wav),
)
READERS: dict[str, Reader] = {suffix: one.reader for one in FORMATS for suffix in one.suffixes}
"""What opens a file of each suffix."""

_DAMAGE = (
    pa.ArrowException,
    MatReadError,
    struct.error,
    zlib.error,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    RuntimeError,
    OverflowError,
    MemoryError,
    UnboundLocalError,
)
"""Errors that the readers of the formats raise on damaged files."""
