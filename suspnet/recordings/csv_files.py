"""Columns of Parquet files and of CSV files of any dialect, read block by block with Arrow."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet

from suspnet.ground.types import FloatArray
from suspnet.recordings.columns import Block, Column, OpenFile, as_block, check_samples
from suspnet.recordings.csv_dialect import MISSING, Found, find_dialect
from suspnet.recordings.dates import iso_from_german
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest_keys import CsvDialect

BLOCK_BYTES = 2**19
"""Number of bytes that are parsed at once; Arrow reads 32 of these blocks ahead."""
LONGEST_LINE = 2**20
"""Largest number of bytes of a line whose delimiter is blanks; Arrow limits other lines."""
PARQUET_ROWS, PARQUET_BUFFER_BYTES = 2**17, 2**20
"""Number of rows in a batch, and bytes in the read buffer, of a Parquet file."""
LEAST_GERMAN = len("03.08.2015 08:00:05")
"""Least length of a German time stamp with two digits for each day, month, hour, ..."""


@contextmanager
def open_parquet(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a Parquet file; the metadata `unit` and `rate_hz` of its columns are used."""
    # Reading ahead, the default, is no faster here and uses memory for a whole column.
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
    """Return an Arrow column as float64, or time stamps as datetime64[ns]."""
    if pa.types.is_timestamp(column.type):
        return as_block(column.cast(pa.timestamp("ns")).to_numpy(zero_copy_only=False))
    return to_float(column)


@contextmanager
def open_csv(path: Path, given: CsvDialect | None) -> Iterator[OpenFile]:
    """Open a CSV file; the parts of its dialect that are not given are detected."""
    found = find_dialect(path, given)
    columns = tuple(
        Column(name, unit or None, is_time=bool(stamp), is_zoned=stamp == "utc", date=found.date)
        for name, unit, stamp in zip(found.names, found.units, found.stamps, strict=True)
    )

    def read(names: Sequence[str]) -> Iterator[Block]:
        return _blocks(path, found, names)

    yield OpenFile(columns, read, f"{path.name}: {found}", notes=found.above)


def _blocks(path: Path, found: Found, names: Sequence[str]) -> Iterator[Block]:
    stamps = dict(zip(found.names, found.stamps, strict=True))
    types = {name: pa.string() if stamps[name] else pa.float64() for name in names}
    convert = pa.csv.ConvertOptions(
        include_columns=list(types),
        column_types=types,
        decimal_point=found.decimal,
        null_values=sorted(MISSING),
        strings_can_be_null=True,
    )
    # Messages contain row numbers only without threads.
    read = pa.csv.ReadOptions(
        use_threads=False,
        block_size=BLOCK_BYTES,
        skip_rows=found.first_line - 1,
        column_names=list(found.names),
    )
    delimiter = {" ": "\t", "": "\x1f"}.get(found.delimiter, found.delimiter)
    parse = pa.csv.ParseOptions(delimiter=delimiter)
    # Arrow reads UTF-8 with one-character delimiters: other files are converted on the fly.
    with pa.OSFile(str(path)) as stream:
        source: Any = stream
        if found.encoding.replace("-", "").lower() not in ("utf8", "ascii"):
            source = pa.transcoding_input_stream(source, found.encoding, "utf8")
        if found.delimiter == " ":
            source = pa.PythonFile(_Collapsed(source), mode="r")
        try:
            with pa.csv.open_csv(source, read, parse, convert) as reader:
                for batch in reader:
                    yield tuple(
                        _stamps(batch.column(name), stamps[name])
                        if stamps[name]
                        else to_float(batch.column(name))
                        for name in names
                    )
        except pa.ArrowInvalid as error:
            if "Failed to parse string" in str(error):
                raise TripError(f"{path}: a time stamp is not like the first ({error})") from error
            if "conversion error" not in str(error):
                raise
            raise TripError(
                f"{path}: text in a column of numbers, one of {list(names)} ({error}); the decimal "
                f"sign is taken to be {found.decimal!r}"
            ) from error


def to_float(column: Any) -> FloatArray:
    """Return an Arrow column as float64, NaN where a value is missing."""
    return as_block(column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False))


def _stamps(column: Any, kind: str) -> Any:
    """Return text time stamps as datetime64[ns], in UTC if they have a zone."""
    if isinstance(column.type, pa.TimestampType):
        return as_block(column.to_numpy(zero_copy_only=False))
    plain = pa.compute.replace_substring(pa.compute.utf8_trim_whitespace(column), ",", ".")
    plain = _iso(plain)
    zone = "UTC" if kind == "utc" else None
    return as_block(plain.cast(pa.timestamp("ns", zone)).to_numpy(zero_copy_only=False))


def _iso(stamps: Any) -> Any:
    """Return text time stamps as ISO 8601 if they are German, else as they are.

    Stamps like 03.08.2015 08:00:05 of one length are reordered byte by byte, which takes a tenth of
    the time of regular expressions.
    """
    n, width = len(stamps), pa.compute.max(pa.compute.binary_length(stamps)).as_py() or 0
    if stamps.type == pa.utf8() and not stamps.null_count and width >= LEAST_GERMAN:
        _, offsets, letters = stamps.buffers()
        ends = np.frombuffer(offsets, np.int32)[stamps.offset : stamps.offset + n + 1]
        if (np.diff(ends) == width).all():
            rows = np.frombuffer(letters, np.uint8)[ends[0] : ends[-1]].reshape(n, width)
            if (rows < 128).all() and (rows[:, [2, 5, 13]] == tuple(b"..:")).all():
                iso = rows[:, [6, 7, 8, 9, 2, 3, 4, 5, 0, 1, *range(10, width)]]
                iso[:, [4, 7]] = ord("-")
                buffers = [None, pa.py_buffer(ends - ends[0]), pa.py_buffer(iso.tobytes())]
                return pa.Array.from_buffers(pa.utf8(), n, buffers)
    return iso_from_german(stamps, pa.compute.replace_substring_regex)


@dataclass
class _Collapsed(io.RawIOBase):
    """A stream in which a tab replaces each run of blanks; none is left at the ends of lines."""

    source: Any
    _rest: bytes = b""
    _done: bytes = field(default=b"")
    _ended: bool = False

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        while not self._done and not self._ended:  # ends: each round reads a block
            if len(self._rest) > LONGEST_LINE:
                raise ValueError(f"a line of more than {LONGEST_LINE} bytes")
            block = self.source.read(BLOCK_BYTES)
            self._ended = not block
            whole, line_end, rest = (self._rest + block).rpartition(b"\n")
            if self._ended:
                whole, line_end, rest = self._rest, b"", b""
            self._rest = rest
            text = re.sub(rb"[ \t]+", b"\t", whole + line_end)
            self._done = re.sub(rb"(?m)^\t|\t(?=\r?$)", b"", text)
        size = len(self._done) if size < 0 else size
        part, self._done = self._done[:size], self._done[size:]
        return part
