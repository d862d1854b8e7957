"""Columns of data files of every format, a block at a time: one entry of ``READERS`` each."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet
from scipy.io.matlab import MatReadError

from suspnet.ground.storage import NotPlainError, open_plain
from suspnet.recordings.array_files import open_hdf5, open_mat
from suspnet.recordings.bounds import check_samples
from suspnet.recordings.columns import BLOCK, Block, Column, OpenFile, as_block, choose
from suspnet.recordings.csv_files import open_csv, to_float
from suspnet.recordings.logger_files import open_tdms, open_uff, open_wav
from suspnet.recordings.manifest import CsvDialect, TripError
from suspnet.recordings.mdf_files import open_mdf
from suspnet.recordings.reader_process import Reader, apart

PARQUET_ROWS, PARQUET_BUFFER_BYTES = 2**17, 2**20


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
def open_parquet(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a Parquet file; the metadata `unit` and `rate_hz` of a column say what they are."""
    # Reading ahead, the default, is no faster here and takes as much memory as the whole column.
    with pa.parquet.ParquetFile(path, pre_buffer=False, buffer_size=PARQUET_BUFFER_BYTES) as file:
        fields = {field.name: field for field in file.schema_arrow}

        def read(names: Sequence[str]) -> Iterator[Block]:
            for name in names:
                kind = fields[name].type
                if not (
                    pa.types.is_integer(kind)
                    or pa.types.is_floating(kind)
                    or pa.types.is_timestamp(kind)
                ):
                    raise TripError(f"{path}: column {name!r} holds {kind}, not numbers")
            check_samples(path, file.metadata.num_rows)
            for batch in file.iter_batches(PARQUET_ROWS, columns=list(names), use_threads=False):
                yield tuple(_from_arrow(batch.column(name)) for name in names)

        yield OpenFile(tuple(map(_parquet_column, file.schema_arrow)), read)


def _parquet_column(field: Any) -> Column:
    """Return what the schema of a Parquet file says of a column."""
    said = field.metadata or {}
    is_time = pa.types.is_timestamp(field.type)
    unit, rate = (said.get(key, b"").decode("utf-8", "replace") for key in (b"unit", b"rate_hz"))
    try:
        rate_hz = float(rate) if rate else None
    except ValueError:
        rate_hz = None
    is_zoned = is_time and field.type.tz is not None
    return Column(field.name, unit or None, rate_hz, is_time=is_time, is_zoned=is_zoned)


def _from_arrow(column: Any) -> Any:
    """Return an Arrow column as float64, or as datetime64[ns] of time stamps."""
    if pa.types.is_timestamp(column.type):
        return as_block(column.cast(pa.timestamp("ns")).to_numpy(zero_copy_only=False))
    return to_float(column)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Turn what a reader raises on a damaged file into a TripError that names the file."""
    try:
        yield
    except TripError:
        raise
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200]
        suffix = path.suffix.lower()
        raise TripError(f"{path} is damaged, cut off or not a {suffix} file ({reason})") from error


CSV_SUFFIXES = (".csv", ".txt", ".tsv", ".asc")

READERS: dict[str, Reader] = {
    ".parquet": apart(open_parquet, "pandas"),  # Arrow imports it, if there, for its first array
    **dict.fromkeys(CSV_SUFFIXES, open_csv),
    ".mat": apart(open_mat, "h5py"),
    ".h5": apart(open_hdf5, "h5py"),
    ".hdf5": apart(open_hdf5, "h5py"),
    ".tdms": apart(open_tdms, "nptdms"),
    ".mf4": apart(open_mdf, "asammdf"),
    ".mdf": apart(open_mdf, "asammdf"),
    ".uff": apart(open_uff, "pyuff"),
    ".unv": apart(open_uff, "pyuff"),
    ".wav": apart(open_wav),
}
"""Reader of each suffix; another format is one more entry.

That of CSV is in this process: its text declares nothing, and no damaged file has crashed it."""

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
