"""Columns of Parquet files and of CSV files of any dialect, read block by block with Arrow."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from suspnet.ground.findings import Finding, of, together
from suspnet.trains.recordings.columns import Block, Column, OpenFile, as_block, check_samples
from suspnet.trains.recordings.csv_dialect import (
    COMMENT,
    GROUPED,
    MISSING,
    NUMBER,
    SIGNS,
    TIME_NAME,
    Dialect,
    Kind,
    find_dialect,
    is_of_kind,
    split,
    unread,
)
from suspnet.trains.recordings.dates import read_date
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest_keys import CsvDialect
from suspnet.trains.recordings.stamps import NO_DATE, Notation, notation_of, read_stamps

BLOCK_BYTES = 2**19
"""Number of bytes that are parsed at once."""
LONGEST_LINE = 2**20
"""Largest number of bytes of a line."""
PARQUET_ROWS, PARQUET_BUFFER_BYTES = 2**17, 2**20
"""Number of rows in a batch, and bytes in the read buffer, of a Parquet file."""
READ_TYPES = (pa.types.is_integer, pa.types.is_floating, pa.types.is_timestamp)
"""Types of Parquet columns that are read."""
MENDED_BYTES = 2**12
"""Size of a piece that Arrow refuses above which it is halved."""
FOOTER_LINES, MOST_LEFT_OUT = 20, 0.1
"""Largest number of lines of a footer, and largest share of lines that may be no rows besides."""
SHOWN = 40
"""Number of characters of a line or a word that are shown."""


@contextmanager
def open_parquet(path: Path) -> Iterator[OpenFile]:
    """Open a Parquet file; the metadata `unit` and `rate_hz` of its columns are used."""
    # Reading ahead, the default, is no faster here and uses memory for a whole column.
    with pa.parquet.ParquetFile(path, pre_buffer=False, buffer_size=PARQUET_BUFFER_BYTES) as file:
        fields = {field.name: field for field in file.schema_arrow}

        def read(names: Sequence[str]) -> Iterator[Block]:
            for name in names:
                kind = fields[name].type
                if not any(is_it(kind) for is_it in READ_TYPES):
                    raise TripError.at(path, "csv-column-not-numbers", name=repr(name), value=kind)
            check_samples(path, file.metadata.num_rows)
            for batch in file.iter_batches(PARQUET_ROWS, columns=list(names), use_threads=False):
                yield tuple(_from_arrow(batch.column(name)) for name in names)

        yield OpenFile(tuple(map(_parquet_column, file.schema_arrow)), read)


def _parquet_column(field: Any) -> Column:
    metadata = field.metadata or {}
    is_time = pa.types.is_timestamp(field.type)
    unit = metadata.get(b"unit", b"").decode("utf-8", "replace")
    rate_hz: float | None = None
    with suppress(ValueError):
        rate_hz = float(metadata.get(b"rate_hz", b""))
    is_zoned = is_time and field.type.tz is not None
    return Column(field.name, unit or None, rate_hz, is_time=is_time, is_zoned=is_zoned)


def _from_arrow(column: Any) -> NDArray[Any]:
    """Return a column as float64, NaN where missing, or time stamps as datetime64[ns]."""
    is_time = pa.types.is_timestamp(column.type)
    numbers = column.cast(pa.timestamp("ns")) if is_time else column.cast(pa.float64(), safe=False)
    return as_block(numbers.to_numpy(zero_copy_only=False))


@contextmanager
def open_csv(path: Path, stated: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a CSV file; whatever of its dialect is not given is detected."""
    dialect = find_dialect(path, stated)
    columns = tuple(
        Column(
            name,
            unit or None,
            is_time=isinstance(kind, Notation),
            is_zoned=isinstance(kind, Notation) and kind.is_zoned,
            date=dialect.date,
            unread=unread(kind),
        )
        for name, unit, kind in zip(dialect.names, dialect.units, dialect.kinds, strict=True)
    )
    remarks: list[str] = []

    def read(names: Sequence[str]) -> Iterator[Block]:
        return _Rows(path, dialect, names).blocks(remarks)

    words = together((of(path.name, str(dialect)), *dialect.unclear))
    yield OpenFile(columns, read, words, notes=dialect.above, remarks=remarks)


@dataclass
class _Remark:
    """What was left out of a file: how often, and the first of it."""

    n: int = 0
    first: str = ""

    def add(self, line_number: int, text: str) -> None:
        self.n += 1
        if not self.first:
            shown = re.sub(r"\s*;\s*", ";", text.strip()[:SHOWN])  # "; " separates remarks
            self.first = Finding("first-in-line", line_number=line_number, shown=repr(shown))


@dataclass
class _Line:
    """A line that may be of a footer: the cells that are read, and the words among them.

    One that is no row may be a damaged row, which is a missing sample, or the names of a table.
    """

    number: int
    text: str
    cells: list[str]
    words: list[str]
    is_row: bool = True
    is_damaged: bool = False
    is_other_table: bool = False


class _Rows:
    """Reads some columns of a CSV file, in pieces of whole lines.

    Arrow parses each piece. A piece that it refuses is read line by line: a word in place of a
    number is a missing value, and a damaged row is one of missing values, so that samples without
    times stay in place. Lines that are no rows, and both of these at the end, are left out.
    """

    def __init__(self, path: Path, dialect: Dialect, names: Sequence[str]) -> None:
        self.path, self.dialect, self.names = path, dialect, tuple(names)
        self._places = [dialect.names.index(name) for name in names]
        self._kinds = [dialect.kinds[place] for place in self._places]
        date = read_date(dialect.date or "")
        self._day = NO_DATE if date is None else np.datetime64(date.date(), "D")
        self._n_lines = self._n_rows = self._n_zeros = 0
        self._pending: list[_Line] = []
        self._lines, self._damaged, self._words = _Remark(), _Remark(), _Remark()
        types = [pa.string() if kind else pa.float64() for kind in self._kinds]
        self._convert = pa.csv.ConvertOptions(
            include_columns=list(names),
            column_types=dict(zip(names, types, strict=True)),
            decimal_point=dialect.decimal,
            null_values=sorted(MISSING),
            strings_can_be_null=True,
        )
        delimiter = {" ": "\t", "": "\x1f"}.get(dialect.delimiter, dialect.delimiter)
        self._parse = pa.csv.ParseOptions(delimiter=delimiter)

    def blocks(self, remarks: list[str]) -> Iterator[Block]:
        """Yield blocks of the columns; afterwards add to `remarks` what was left out."""
        # Arrow reads UTF-8 with one-character delimiters: other files are converted on the fly.
        with pa.OSFile(str(self.path)) as stream:
            source: Any = stream
            if self.dialect.encoding.replace("-", "").lower() not in ("utf8", "ascii"):
                source = pa.transcoding_input_stream(source, self.dialect.encoding, "utf8")
            for piece in self._pieces(source):
                block = self._read(piece)
                self._n_rows += len(block[0])
                self._check()
                if len(block[0]):
                    yield block
        for line in self._pending:
            self._lines.add(line.number, line.text)
        self._check()
        remarks += self._remarks()

    def _pieces(self, source: Any) -> Iterator[bytes]:
        """Yield pieces of whole lines, without zero bytes."""
        rest = b""
        while block := source.read(BLOCK_BYTES):
            if b"\0" in block:
                self._n_zeros += block.count(0)
                block = block.replace(b"\0", b"")
            text = rest + block
            end = text.rfind(b"\n") + 1 or text.rfind(b"\r", 0, max(len(text) - 1, 0)) + 1
            if not end and len(text) > LONGEST_LINE:
                raise ValueError(Finding("line-too-long", longest_line=LONGEST_LINE))
            rest = text[end:]
            if end:
                yield text[:end]
        if rest:
            yield rest

    def _read(self, piece: bytes) -> Block:
        """Return the columns of a piece; one that Arrow refuses is halved until it is short."""
        block: Block = ()
        for sign in ("", *SIGNS):  # signs are replaced only where needed
            if not block and sign.encode() in piece:
                piece = piece.replace(sign.encode(), SIGNS[sign].encode()) if sign else piece
                with suppress(pa.ArrowInvalid, ValueError):
                    block = self._parsed(piece)
        half = piece.find(b"\n", len(piece) // 2) + 1
        if not block and len(piece) > MENDED_BYTES and 0 < half < len(piece):
            parts = self._read(piece[:half]), self._read(piece[half:])
            return tuple(np.concatenate(pair) for pair in zip(*parts, strict=True))
        block = block or self._mended(piece.decode("utf-8", "replace"))
        letters = np.frombuffer(piece, np.uint8)  # counted faster than bytes
        self._n_lines += int(np.count_nonzero(letters == ord("\n" if b"\n" in piece else "\r")))
        return block

    def _parsed(self, piece: bytes) -> Block:
        """Return the columns of a piece without damage; ArrowInvalid or ValueError otherwise."""
        if (
            self.dialect.delimiter == " "
        ):  # a tab replaces blanks; none is left at the ends of lines
            piece = re.sub(rb"(?m)^\t|\t(?=\r?$)", b"", re.sub(rb"[ \t]+", b"\t", piece))
        options = pa.csv.ReadOptions(
            use_threads=False,
            block_size=len(piece) + 1,
            skip_rows=max(self.dialect.first_line - 1 - self._n_lines, 0),
            column_names=list(self.dialect.names),
        )
        read = pa.csv.read_csv(pa.BufferReader(piece), options, self._parse, self._convert)
        columns = [
            self._stamps(column.combine_chunks(), kind)
            if isinstance(kind, Notation)
            else _from_arrow(column)
            for column, kind in zip(read.columns, self._kinds, strict=True)
        ]
        if self._pending and len(columns[0]):
            before = self._columns(self._taken())
            columns = [np.concatenate(pair) for pair in zip(before, columns, strict=True)]
        return tuple(columns)

    def _stamps(self, column: Any, notation: Notation) -> Any:
        """Return text time stamps as datetime64[ns], in UTC if they have a zone."""
        texts = column.drop_null() if column.null_count else column
        try:
            stamps = read_stamps(*_letters(texts), notation, self._day)
        except ValueError:
            texts = pa.compute.utf8_trim_whitespace(texts)
            stamps = read_stamps(*_letters(texts), notation, self._day)
        times = np.full(len(column), np.datetime64("NaT", "ns"))
        times[column.is_valid().to_numpy(zero_copy_only=False)] = stamps.view("datetime64[ns]")
        return times

    def _mended(self, text: str) -> Block:
        """Return the columns of a piece with damage, read line by line."""
        rows: list[list[str]] = []
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        for number, line in enumerate(lines, self._n_lines + 1):
            if number < self.dialect.first_line or not line.strip():
                continue
            judged = self._judged(number, line)
            self._pending.append(judged)
            if (judged.is_row and not judged.words) or len(self._pending) > FOOTER_LINES:
                rows += self._taken()
        return self._columns(rows)

    def _judged(self, number: int, text: str) -> _Line:
        """Return the cells of a line that are read; "" for words, and all "" if it is no row."""
        cells = split(text, self.dialect.delimiter)
        cells = ["" if cell in MISSING else cell for cell in cells]
        kinds, decimal, words = self.dialect.kinds, self.dialect.decimal, []
        is_row = len(cells) == len(kinds)
        if is_row:
            # a row may have words in place of some numbers, but needs its time and a number
            pairs = enumerate(zip(cells, kinds, strict=True))
            wrong = {i for i, (cell, kind) in pairs if cell and not is_of_kind(cell, kind, decimal)}
            read = {i for i, kind in enumerate(kinds) if cells[i] and not isinstance(kind, str)}
            is_row = bool(read - wrong)
            for i in wrong & set(self._places):
                self._refuse_other_dialect(number, cells[i], kinds[i])
                is_row &= kinds[i] is None  # without its time a row is none
                words.append(cells[i])
                cells[i] = ""
        if is_row:
            return _Line(number, text, [cells[i] for i in self._places], words)
        # anything else is a damaged row, the names of a table, or a line of a footer
        own = split(COMMENT.sub("", text), self.dialect.delimiter)
        is_like_row = len(own) == len(kinds) or any(map(NUMBER[decimal].fullmatch, own))
        is_header = is_like_row and self._is_header(own)
        is_damaged = is_like_row and not is_header and not COMMENT.match(text)
        is_other = is_header and tuple(own) != self.dialect.names and len({"", *own}) > len(own)
        cells = [""] * len(self._places)
        return _Line(number, text, cells, [], False, is_damaged, is_other)

    def _is_header(self, cells: Sequence[str]) -> bool:
        """Return whether cells are names: those of the columns, or others with one of these."""
        first = re.split(r"[\W_]", cells[0])[0]
        shared = set(cells) & set(self.dialect.names) or TIME_NAME.fullmatch(first)
        is_text = not any(cell[:1].isdigit() for cell in cells)
        return tuple(cells) == self.dialect.names or (is_text and bool(shared))

    def _refuse_other_dialect(self, number: int, cell: str, kind: Kind) -> None:
        """Raise TripError if a cell is a number or a time that is written in another way."""
        if isinstance(kind, Notation):
            other = notation_of(cell)
            if other is not None and not other.is_like(kind):
                raise TripError.at(self.path, "time-stamp-differs", number=number, cell=repr(cell))
            return
        is_grouped = GROUPED.fullmatch(cell) is not None
        if is_grouped or any(pattern.fullmatch(cell) for pattern in NUMBER.values()):
            problem = "number-grouped" if is_grouped else "text-in-numbers"
            where = {"names": list(self.names), "number": number, "cell": repr(cell)}
            raise TripError.at(self.path, problem, **where, decimal=repr(self.dialect.decimal))

    def _taken(self) -> list[list[str]]:
        """Return the cells of the rows among the pending lines, whose words are missing values."""
        for line in self._pending:
            if line.is_other_table:
                text = repr(line.text.strip()[:SHOWN])
                raise TripError.at(self.path, "several-tables", number=line.number, strip=text)
            for word in line.words:
                self._words.add(line.number, word)
            if not line.is_row:
                remark = self._damaged if line.is_damaged else self._lines
                remark.add(line.number, line.text)
        taken, self._pending = self._pending, []
        return [line.cells for line in taken if line.is_row or line.is_damaged]

    def _columns(self, rows: Sequence[Sequence[str]]) -> Block:
        """Return rows of cells that fit as columns."""
        columns = list(zip(*rows, strict=True)) or [()] * len(self._places)
        return tuple(
            self._stamps(pa.array([cell or None for cell in cells], pa.string()), kind)
            if isinstance(kind, Notation)
            else np.array([float(cell.replace(",", ".") or "nan") for cell in cells])
            for cells, kind in zip(columns, self._kinds, strict=True)
        )

    def _check(self) -> None:
        """Raise TripError if too many lines are no rows."""
        n, first = self._lines.n + self._damaged.n, self._lines.first or self._damaged.first
        if n > MOST_LEFT_OUT * self._n_rows + FOOTER_LINES:
            raise TripError.at(self.path, "too-many-odd-lines", n=n, first=first)

    def _remarks(self) -> Iterator[str]:
        name = self.path.name
        remarks = {"lines-left-out": self._lines, "damaged-rows": self._damaged}
        for kind, remark in (remarks | {"words-for-numbers": self._words}).items():
            if remark.n:
                yield Finding(kind, name=name, n=remark.n, first=remark.first)
        if self._n_zeros:
            yield Finding("zero-bytes", name=name, n=self._n_zeros)


def _letters(texts: Any) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Return the bytes of an Arrow array of texts, and where each text starts and ends."""
    _, offsets, letters = texts.buffers()
    ends = np.frombuffer(offsets, np.int32)[texts.offset : texts.offset + len(texts) + 1]
    return np.frombuffer(letters or b"", np.uint8), ends
