"""Columns of data files of all formats, read block by block; ``FORMATS`` lists the formats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from suspnet.ground.findings import Finding, of
from suspnet.ground.storage import open_plain
from suspnet.recordings.array_files import open_hdf5, open_mat
from suspnet.recordings.columns import BLOCK, Block, OpenFile, Reader, check_samples, choose
from suspnet.recordings.csv_files import open_csv, open_parquet
from suspnet.recordings.errors import TripError, opening
from suspnet.recordings.logger_files import open_tdms, open_uff, open_wav
from suspnet.recordings.manifest_keys import CsvDialect
from suspnet.recordings.mdf_files import open_mdf
from suspnet.recordings.reader_process import in_own_process


@contextmanager
def open_file(path: Path, csv: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a data file: its columns with the units, rates and times that it states.

    The suffix, one of ``READERS``, determines the format; `csv` gives parts of a CSV dialect.
    Opening and reading raise TripError if the file is missing, empty, damaged or of another format,
    or the package that reads it is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        kind, known = (
            "files-of-known-type" if suffix in UNREAD else "files-of-type",
            sorted(READERS),
        )
        given = {"format": UNREAD.get(suffix), "suffix": repr(suffix), "suffixes": known}
        raise TripError(Finding(kind, path=path, **given))
    if csv is not None and READERS[suffix] is not open_csv:
        raise TripError(of(path, Finding("csv-for-files", suffixes=list(CSV_SUFFIXES))))
    with opening(path):
        try:
            with open_plain(path) as stream:
                is_empty = not stream.read(1)
        except FileNotFoundError as error:
            raise TripError(of(path, Finding("there-no-such"))) from error
    if is_empty:
        raise TripError(Finding("empty", path=path))
    with ExitStack() as stack:
        with _named(path):
            file = stack.enter_context(READERS[suffix](path, csv))
        yield file


def open_columns(
    path: Path, columns: Sequence[str | None], csv: CsvDialect | None = None
) -> Iterator[Block]:
    """Yield columns of a file as arrays (n_samples,), in blocks of at most ``BLOCK`` samples.

    TDMS channels are named "group/channel", columns of a matrix "name[0]", fields of a struct
    "struct.field"; None is the only column not named. Arrays are float64, NaN where missing, or
    datetime64[ns] for time stamps. Nothing is ever unpickled. All formats except UFF, WAV of 24
    bits and MAT before version 7.3 are read piece by piece, so a file may be larger than memory.
    The first block raises TripError if the file cannot be read, or a column is missing, ambiguous
    or not numeric.
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
        raise TripError(Finding("empty-columns-hold", path=path))


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
        raise TripError(
            Finding("damaged-cut-off", path=path, suffix=suffix, reason=reason)
        ) from error


@dataclass(frozen=True)
class Format:
    """One format of data files.

    To add a format, write a function that opens its files and add one line to ``FORMATS``.

    Parameters
    ----------
    suffixes : tuple of str
        Suffixes of its files.
    open : callable
        Returns an `OpenFile`: the columns as the file describes them, and `read`.
    library : str, optional
        A package that `open` imports.
    in_own_process : bool
        Run `open` in a confined process, for formats that declare sizes or may crash a library.
    states : mapping of str to str
        What its files state about their data, and what is done with it, for the documentation.
    """

    suffixes: tuple[str, ...]
    open: Reader
    library: str | None = None
    in_own_process: bool = True
    states: Mapping[str, str] = field(default_factory=dict)


CSV_SUFFIXES = (".csv", ".txt", ".tsv", ".asc")
FORMATS = (
    Format(
        (".parquet",),
        open_parquet,
        "pandas",  # Arrow imports it for its first array
        states={
            "metadata `unit` and `rate_hz` of a column": "used",
            "nulls": "missing samples",
            "time stamps, with a zone or without": "times, in UTC or in the logger's zone",
        },
    ),
    # not confined: text declares no sizes, and no damaged file has crashed the reader
    Format(
        CSV_SUFFIXES,
        open_csv,
        in_own_process=False,
        states={
            "a line of units, or brackets behind a name": "used",
            "empty cells, `NaN`, `NA`, `null`, `-`": "missing samples",
            "words and infinity in place of numbers": "missing samples, counted in `read_as`",
            "names, units, descriptions and tags over several lines": "used",
            "footers, cut lines, zero bytes": "left out, counted in `read_as`",
            "time stamps, with an offset or without": "times, in UTC or in the logger's zone",
            "times of day alone, counters that start again": "times, continued over their end",
            "a start in the lines above the table": "date",
        },
    ),
    Format(
        (".mat",),
        open_mat,
        "h5py",
        states={
            "`rate_hz` or `fs`, `unit`, `start`: next to the data": "used",
            "structs, cells, old objects": "columns of their numbers, by their path",
            "Simulink's structure with time": "columns named by labels, with its times",
            "timeseries, tables, other objects": "refused by name; arrays next to them are read",
            "logical, complex, sparse arrays, more than two dimensions": "refused by name",
        },
    ),
    Format(
        (".h5", ".hdf5"),
        open_hdf5,
        "h5py",
        states={
            "`rate_hz` or `fs`, `unit`, `start`: attributes, or next to the data": "used",
            "`scale_factor`, `add_offset`, `_Unsigned`": "applied",
            "`gain`, `scale`, `offset`, `sensitivity`, `calibration`": "named in `read_as`",
            "`_FillValue`, `missing_value`, a chosen fill value but 0": "missing samples",
            "`valid_min`, `valid_max`, `valid_range`": "samples beyond them are missing",
            "`seconds since 2015-08-03` as unit, dimension scales": "times, with their origin",
            "tables (compounds), cells of MATLAB 7.3": "columns of their numbers",
            "foreign types (times, 24 bits), null spaces, other files": "refused by name",
        },
    ),
    Format(
        (".tdms",),
        open_tdms,
        "nptdms",
        states={
            "`wf_increment`, `unit_string`, scales": "used; refused if they change later",
            "`wf_start_time`, `wf_start_offset`": "start of the channel, in UTC; 1904 is none",
            "a later start of a segment": "a gap, from 1 ms on",
            "segments that overlap": "refused with both times",
            "a last segment that is incomplete": "refused",
        },
    ),
    Format(
        (".mf4", ".mdf"),
        open_mdf,
        "asammdf",
        states={
            "invalidation bits": "missing samples, at their times",
            "conversions": "applied if arithmetic, else refused by name",
            "unit of the channel, or else of its conversion": "used",
            "master of a group: times": "used; in seconds without a unit",
            "master of a group: angles, distances": "refused by name",
            "master of a group: numbers of samples": "`rate_hz` is asked for",
            "start, in UTC or in local time": "start, in UTC or in the logger's zone",
            "number of records": "refused if fewer are found",
        },
    ),
    Format(
        (".uff", ".unv"),
        open_uff,
        "pyuff",
        states={
            "number of points": "refused if fewer are found; what follows is padding",
            "increment, minimum and unit of the abscissa": "rate, or times; refused if of no time",
            "unit of the ordinate, or else data set 164": "used",
            "ID line 3": "date",
        },
    ),
    Format(
        (".wav",),
        open_wav,
        states={
            "rate": "used; a manifest may differ by 0.5 Hz, as it is a whole number",
            "integers": "fractions of full scale, for which `range` is needed",
            "size of the data": "refused if less is found",
            "chunk `bext`": "date",
        },
    ),
)
READERS: dict[str, Reader] = {
    suffix: in_own_process(one.open, one.library) if one.in_own_process else one.open
    for one in FORMATS
    for suffix in one.suffixes
}
"""Readers by suffix."""
UNREAD: Mapping[str, str] = {
    ".lvm": "LabVIEW text",
    **dict.fromkeys((".raw", ".dat"), "imc FAMOS"),
    ".ide": "enDAQ",
    **dict.fromkeys((".d7d", ".dxd"), "Dewesoft"),
    ".bin": "binary numbers",
    **dict.fromkeys((".xls", ".xlsx"), "spreadsheet"),
    **dict.fromkeys((".npy", ".npz"), "NumPy"),
    **dict.fromkeys((".zip", ".gz"), "packed files"),
}
"""Formats of recordings that are not read, by suffix."""
