"""Columns of data files of all formats, read block by block; ``FORMATS`` lists the formats."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from suspnet.ground.findings import Finding
from suspnet.ground.storage import open_plain
from suspnet.trains.recordings.columns import BLOCK, Block, OpenFile, Reader, check_samples, choose
from suspnet.trains.recordings.csv_files import open_csv, open_parquet
from suspnet.trains.recordings.errors import TripError, opening
from suspnet.trains.recordings.hdf5_files import open_hdf5, open_mat
from suspnet.trains.recordings.logger_files import open_mdf, open_tdms
from suspnet.trains.recordings.manifest_sources import CsvDialect
from suspnet.trains.recordings.reader_process import in_own_process
from suspnet.trains.recordings.record_files import open_uff, open_wav


@contextmanager
def open_file(path: Path, csv: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a data file: its columns with the units, rates and times that it states.

    The suffix, one of ``READERS``, determines the format; `csv` states how a CSV file is written.
    Opening and reading raise TripError if the file is missing, empty, damaged or of another format,
    or the package that reads it is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        values = {"suffix": repr(suffix), "suffixes": sorted(READERS)}
        raise TripError(Finding("files-of-type", path=path, **values))
    reader = READERS[suffix]
    if csv is not None:
        if suffix not in CSV_SUFFIXES:
            raise TripError.at(path, "csv-for-files", suffixes=list(CSV_SUFFIXES))
        reader = partial(open_csv, stated=csv)
    with opening(path):
        try:
            with open_plain(path) as stream:
                is_empty = not stream.read(1)
        except FileNotFoundError as error:
            raise TripError.at(path, "no-such-file") from error
    if is_empty:
        raise TripError(Finding("empty", path=path))
    with ExitStack() as stack:
        with _named(path):
            file = stack.enter_context(reader(path))
        yield file


def open_columns(
    path: Path, columns: Sequence[str | None], csv: CsvDialect | None = None
) -> Iterator[Block]:
    """Yield columns of a file as arrays (n_samples,), in blocks of at most ``BLOCK`` samples.

    TDMS channels are named "group/channel", columns of a matrix "name[0]", fields of a struct
    "struct.field"; None is the only column not named. Arrays are float64, NaN where missing, or
    datetime64[ns] for time stamps. Nothing is ever unpickled. The first block raises TripError if
    the file cannot be read, or a column is missing, ambiguous or not numeric.
    """
    with open_file(path, csv) as file:
        yield from read_columns(path, file, columns)


def read_columns(path: Path, file: OpenFile, columns: Sequence[str | None]) -> Iterator[Block]:
    """Yield columns of an open file in blocks of at most ``BLOCK`` samples; None: the only one."""
    n_samples = 0
    with _named(path):
        names = choose(path, file, columns)
        for block in file.read(names):
            for start in range(0, len(block[0]), BLOCK):
                yield tuple(column[start : start + BLOCK] for column in block)
            n_samples += len(block[0])
            check_samples(path, n_samples)
    if n_samples == 0:
        raise TripError(Finding("empty-columns", path=path))


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Turn the errors of readers on damaged files into TripError with the name of the file.

    Libraries raise errors of any class on damaged files.
    """
    try:
        yield
    except TripError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        suffix = path.suffix.lower()
        raise TripError(Finding("file-damaged", path=path, suffix=suffix, reason=reason)) from error


CSV_SUFFIXES = (".csv", ".txt", ".tsv", ".asc")
FORMATS: dict[tuple[str, ...], tuple[Reader, str | None]] = {
    (".parquet",): (open_parquet, "pandas"),  # Arrow imports it for its first array
    (".mat",): (open_mat, "h5py"),
    (".h5", ".hdf5"): (open_hdf5, "h5py"),
    (".tdms",): (open_tdms, "nptdms"),
    (".mf4", ".mdf"): (open_mdf, "asammdf"),
    (".uff", ".unv"): (open_uff, "pyuff"),
    (".wav",): (open_wav, None),
}
"""Readers of binary files and the packages that they import, by suffixes: they run in confined
processes, as binary files declare sizes and may crash a library."""
READERS: dict[str, Reader] = dict.fromkeys(CSV_SUFFIXES, open_csv) | {
    suffix: in_own_process(*reader) for suffixes, reader in FORMATS.items() for suffix in suffixes
}
"""Readers by suffix."""
