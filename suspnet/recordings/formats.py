"""Columns of numbers from Parquet, CSV, MAT, HDF5 and TDMS files, a block at a time."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from scipy.io import loadmat, whosmat
from scipy.io.matlab import MatReadError

from suspnet.recordings.manifest import TripError
from suspnet.types import FloatArray

try:
    import h5py
except ImportError:
    h5py = None
try:
    import nptdms
except ImportError:
    nptdms = None

BLOCK = 2**20
"""Largest number of samples of a column in one block."""

CSV_BLOCK_BYTES = 2**22
PARQUET_ROWS, PARQUET_BUFFER_BYTES = 2**18, 2**20
LISTED = 20
"""Largest number of columns that an error message lists."""

Block = tuple[FloatArray, ...]
Take = Callable[[slice], Any]


def open_columns(path: Path, columns: Sequence[str | None]) -> Iterator[Block]:
    """Yield some columns of a file, in blocks of at most ``BLOCK`` samples.

    Nothing is ever unpickled. Missing values become NaN. All formats but MAT before version 7.3
    are read piece by piece, so the file may be larger than memory.

    Parameters
    ----------
    path : Path
        The suffix, one of ``READERS``, says what the file is.
    columns : sequence of str or None
        Names of the columns; TDMS channels are named "group/channel". None is the only column that
        is not named.

    Yields
    ------
    tuple of float64 arrays of shape (n_samples,)
        One array for each of `columns`.

    Raises
    ------
    TripError
        If the file is missing, empty, damaged or of another format, or if a column is missing, is
        not numeric or is not the only one. Nothing is raised before the first block is asked for.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise TripError(f"{path}: files of type {suffix!r} cannot be read; give {sorted(READERS)}")
    if not path.is_file():
        raise TripError(f"{path}: there is no such file")
    if path.stat().st_size == 0:
        raise TripError(f"{path} is empty")
    n_samples = 0
    try:
        for block in READERS[suffix](path, columns):
            for start in range(0, len(block[0]), BLOCK):
                yield tuple(column[start : start + BLOCK] for column in block)
            n_samples += len(block[0])
    except TripError:
        raise
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200]
        raise TripError(f"{path} is damaged, cut off or not a {suffix} file ({reason})") from error
    if n_samples == 0:
        raise TripError(f"{path} is empty: its columns hold no samples")


def _read_parquet(path: Path, columns: Sequence[str | None]) -> Iterator[Block]:
    """Yield columns of a Parquet file."""
    # Reading ahead, the default, is no faster here and takes as much memory as the whole column.
    with pa.parquet.ParquetFile(path, pre_buffer=False, buffer_size=PARQUET_BUFFER_BYTES) as file:
        names = _choose(path, columns, file.schema_arrow.names)
        for name in names:
            kind = file.schema_arrow.field(name).type
            if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
                raise TripError(f"{path}: column {name!r} holds {kind}, not numbers")
        for batch in file.iter_batches(PARQUET_ROWS, columns=names, use_threads=False):
            yield tuple(_to_numpy(batch.column(name)) for name in names)


def _read_csv(path: Path, columns: Sequence[str | None]) -> Iterator[Block]:
    """Yield columns of a CSV file with a header line."""
    with pa.csv.open_csv(path) as reader:
        names = _choose(path, columns, reader.schema.names)
    convert = pa.csv.ConvertOptions(
        include_columns=names, column_types={name: pa.float64() for name in names}
    )
    # Only without threads do messages count rows.
    read = pa.csv.ReadOptions(use_threads=False, block_size=CSV_BLOCK_BYTES)
    try:
        with pa.csv.open_csv(path, read_options=read, convert_options=convert) as reader:
            for batch in reader:
                yield tuple(_to_numpy(batch.column(name)) for name in names)
    except pa.ArrowInvalid as error:
        if "conversion error" not in str(error):
            raise
        raise TripError(f"{path}: text in a column of numbers, one of {names} ({error})") from error


def _read_mat(path: Path, columns: Sequence[str | None]) -> Iterator[Block]:
    """Yield variables of a MAT file."""
    try:
        variables = whosmat(path)
    except NotImplementedError:  # version 7.3 is HDF5
        yield from _read_hdf5(path, columns)
        return
    numeric = (
        "single",
        "double",
        *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)),
    )
    vectors = [name for name, shape, kind in variables if kind in numeric and _is_vector(shape)]
    names = _choose(path, columns, vectors)
    content = loadmat(path, variable_names=names)
    arrays = [content[name].ravel() for name in names]
    for name, array in zip(names, arrays, strict=True):
        if array.dtype.kind not in "iuf":
            raise TripError(f"{path}: column {name!r} holds {array.dtype}, not real numbers")
    takes: list[Take] = [array.__getitem__ for array in arrays]
    yield from _slices(path, names, [len(array) for array in arrays], takes)


def _read_hdf5(path: Path, columns: Sequence[str | None]) -> Iterator[Block]:
    """Yield vectors of an HDF5 file."""
    if h5py is None:
        raise TripError(f'{path}: an HDF5 file needs h5py; run: pip install "suspnet[hdf5]"')
    with h5py.File(path, "r") as file:
        vectors: dict[str, Any] = {}

        def collect(name: str, item: Any) -> None:
            is_numeric = isinstance(item, h5py.Dataset) and item.dtype.kind in "iuf"
            if is_numeric and _is_vector(item.shape):
                vectors[name] = item

        file.visititems(collect)
        names = _choose(path, columns, list(vectors))
        takes = [_take_hdf5(vectors[name]) for name in names]
        yield from _slices(path, names, [vectors[name].size for name in names], takes)


def _take_hdf5(dataset: Any) -> Take:
    """Return a function that reads a slice of a vector, MATLAB's (1, n) and (n, 1) included."""
    axis = int(np.argmax(dataset.shape))
    before, after = (0,) * axis, (0,) * (len(dataset.shape) - axis - 1)
    return lambda part: dataset[(*before, part, *after)]


def _read_tdms(path: Path, columns: Sequence[str | None]) -> Iterator[Block]:
    """Yield channels of a TDMS file."""
    if nptdms is None:
        raise TripError(f'{path}: a TDMS file needs npTDMS; run: pip install "suspnet[tdms]"')
    # Opened here because npTDMS does not close what it fails to read.
    with path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            raise TripError(f"{path} is cut off: its last segment is incomplete")
        channels = {
            f"{group.name}/{channel.name}": channel
            for group in file.groups()
            for channel in group.channels()
        }
        names = _choose(path, columns, list(channels))
        for name in names:
            kind = np.dtype(channels[name].dtype)
            if kind.kind not in "iuf":
                raise TripError(f"{path}: column {name!r} holds {kind}, not numbers")
        takes: list[Take] = [channels[name].__getitem__ for name in names]
        yield from _slices(path, names, [len(channels[name]) for name in names], takes)


READERS: dict[str, Callable[[Path, Sequence[str | None]], Iterator[Block]]] = {
    ".parquet": _read_parquet,
    ".csv": _read_csv,
    ".mat": _read_mat,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
    ".tdms": _read_tdms,
}
"""Reader of each suffix; another format is one more entry."""

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
)
"""Errors that the readers of the formats raise on damaged files."""


def _choose(path: Path, columns: Sequence[str | None], present: Sequence[str]) -> list[str]:
    """Return the name of each column, None replaced by the only one that is not named."""
    named = [name for name in columns if name is not None]
    for name in named:
        if name not in present:
            raise TripError(f"{path} has no column {name!r} of numbers; it has {_listing(present)}")
    others = [name for name in present if name not in named]
    if len(named) < len(columns) and len(others) != 1:
        raise TripError(f"{path}: say which `column` to read; there are {_listing(others)}")
    names = [others[0] if name is None else name for name in columns]
    for name in names:
        if present.count(name) > 1:
            raise TripError(f"{path} has {present.count(name)} columns {name!r}; rename them")
    return names


def _listing(names: Sequence[str]) -> str:
    """Return names for a message, at most ``LISTED`` of them."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return f"{list(names[:LISTED])}{more}"


def _to_numpy(column: Any) -> FloatArray:
    """Return an Arrow column as float64, NaN where a value is missing."""
    values = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return np.asarray(values, dtype=np.float64)


def _is_vector(shape: Sequence[int]) -> bool:
    """Return whether an array has one dimension besides those of length 1."""
    return len(shape) > 0 and int(np.prod(shape, dtype=np.int64)) == max(shape)


def _slices(
    path: Path, names: Sequence[str], lengths: Sequence[int], takes: Sequence[Take]
) -> Iterator[Block]:
    """Yield blocks of vectors; raise TripError if their lengths differ."""
    if len(set(lengths)) > 1:
        raise TripError(f"{path}: columns {list(names)} have different lengths {list(lengths)}")
    for start in range(0, lengths[0], BLOCK):
        part = slice(start, min(start + BLOCK, lengths[0]))
        yield tuple(np.asarray(take(part), dtype=np.float64) for take in takes)
