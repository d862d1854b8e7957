"""Columns of Parquet files and of CSV files of any dialect, read block by block with Arrow."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

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
    unread,
)
from suspnet.trains.recordings.dates import NO_DATE, Notation, notation_of, read_date, read_stamps
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest_sources import CsvDialect

BLOCK_BYTES = 2**19  # number of bytes that are parsed at once
LONGEST_LINE = 2**20  # largest number of bytes of a line
PARQUET_ROWS, PARQUET_BUFFER_BYTES = 2**17, 2**20
"""Number of rows in a batch, and bytes in the read buffer, of a Parquet file."""
READ_TYPES = (pa.types.is_integer, pa.types.is_floating, pa.types.is_timestamp)
"""Types of Parquet columns that are read."""
MENDED_BYTES = 2**12  # size of a piece that Arrow refuses above which it is halved
FOOTER_LINES, MOST_LEFT_OUT = 20, 0.1
"""Largest number of lines of a footer, and largest share of lines that may be no rows besides."""
SHOWN = 40  # number of characters of a line or a word that are shown


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
                    raise TripError.at(path, "column-not-numbers", name=repr(name), value=kind)
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


class _Line(NamedTuple):
    """A line that Arrow refuses, or a row among such lines, with the cells that are read.

    `kind` is "" for a row, else that of the remark on it, or of the error if rows follow.
    """

    kind: str
    number: int
    text: str
    cells: list[str]


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
        self._pending: list[_Line] = []  # lines that may be of a footer
        self._odd: dict[str, list[Any]] = {}  # number of lines of a kind, and the first of them
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
            self._note("lines-left-out", line)
        self._check()
        for kind, (n, first) in self._odd.items():
            remarks.append(Finding(kind, name=self.path.name, n=n, first=first))
        if self._n_zeros:
            remarks.append(Finding("zero-bytes", name=self.path.name, n=self._n_zeros))

    def _pieces(self, source: Any) -> Iterator[bytes]:
        rest = b""
        while block := source.read(BLOCK_BYTES):
            self._n_zeros += block.count(0)
            text = rest + block.replace(b"\0", b"")
            end = text.rfind(b"\n") + 1 or text.rfind(b"\r", 0, max(len(text) - 1, 0)) + 1
            if not end and len(text) > LONGEST_LINE:
                raise ValueError(Finding("line-too-long", longest_line=LONGEST_LINE))
            rest = text[end:]
            if end:
                yield text[:end]
        if rest:
            yield rest

    def _read(self, piece: bytes) -> Block:
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
        if self.dialect.delimiter == " ":  # a tab replaces blanks; none is left at ends of lines
            piece = re.sub(rb"(?m)^\t|\t(?=\r?$)", b"", re.sub(rb"[ \t]+", b"\t", piece))
        options = pa.csv.ReadOptions(
            use_threads=False,
            block_size=len(piece) + 1,
            skip_rows=max(self.dialect.first_line - 1 - self._n_lines, 0),
            column_names=list(self.dialect.names),
        )
        table = pa.csv.read_csv(pa.BufferReader(piece), options, self._parse, self._convert)
        columns = [
            self._stamps(column.combine_chunks(), kind)
            if isinstance(kind, Notation)
            else _from_arrow(column)
            for column, kind in zip(table.columns, self._kinds, strict=True)
        ]
        if self._pending and len(columns[0]):
            before = self._columns(self._taken())
            columns = [np.concatenate(pair) for pair in zip(before, columns, strict=True)]
        return tuple(columns)

    def _stamps(self, column: Any, notation: Notation, is_strict: bool = True) -> Any:
        """Return text time stamps as datetime64[ns], in UTC if they have a zone.

        Invalid ones are missing unless `is_strict`, where they raise ValueError.
        """
        stamps, is_valid = read_stamps(column.fill_null(""), notation, self._day)
        is_present = column.is_valid().to_numpy(zero_copy_only=False)
        if is_strict and not is_valid[is_present].all():
            raise ValueError("no time stamp")
        return np.where(is_valid, stamps.view("datetime64[ns]"), np.datetime64("NaT"))

    def _mended(self, text: str) -> Block:
        rows: list[list[str]] = []
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        for number, line in enumerate(lines, self._n_lines + 1):
            if number < self.dialect.first_line or not line.strip():
                continue
            self._pending.append(self._judged(number, line))
            if not self._pending[-1].kind or len(self._pending) > FOOTER_LINES:
                rows += self._taken()
        return self._columns(rows)

    def _judged(self, number: int, text: str) -> _Line:
        """Return what a line is, with the cells that are read; "" for words and missing values."""
        dialect, kinds = self.dialect, self.dialect.kinds
        cells = ["" if cell in MISSING else cell for cell in dialect.split(text)]
        if len(cells) == len(kinds):
            filled = [i for i in dialect.value_places if cells[i]]
            wrong = {i for i in filled if not dialect.is_value(cells[i], i)}
            for i in wrong & set(self._places):
                self._refuse_other_dialect(number, cells[i], kinds[i])
            # a row may have words in place of some numbers, but needs its time and a number
            is_timed = all(kinds[i] is None for i in wrong & set(self._places))
            if is_timed and wrong != set(filled):
                own = ["" if i in wrong else cells[i] for i in self._places]
                kind = "words-for-numbers" if wrong & set(self._places) else ""
                return _Line(kind, number, text, own)
        # anything else is a damaged row, the names of a table, or a line of a footer
        own = dialect.split(COMMENT.sub("", text))
        kind = "lines-left-out"
        if len(own) == len(kinds) or any(map(NUMBER[dialect.decimal].fullmatch, own)):
            if not self._is_header(own):
                kind = kind if COMMENT.match(text) else "damaged-rows"
            elif tuple(own) != dialect.names and len({"", *own}) > len(own):
                kind = "several-tables"
        return _Line(kind, number, text, [""] * len(self._places))

    def _is_header(self, cells: Sequence[str]) -> bool:
        first = re.split(r"[\W_]", cells[0])[0]
        shared = set(cells) & set(self.dialect.names) or TIME_NAME.fullmatch(first)
        is_text = not any(cell[:1].isdigit() for cell in cells)
        return tuple(cells) == self.dialect.names or (is_text and bool(shared))

    def _refuse_other_dialect(self, number: int, cell: str, kind: Kind) -> None:
        if isinstance(kind, Notation):
            if notation_of(cell) is not None:
                raise TripError.at(self.path, "time-stamp-differs", number=number, cell=repr(cell))
            return
        is_grouped = GROUPED.fullmatch(cell) is not None
        if is_grouped or any(pattern.fullmatch(cell) for pattern in NUMBER.values()):
            problem = "number-grouped" if is_grouped else "text-in-numbers"
            where = {"names": list(self.names), "number": number, "cell": repr(cell)}
            raise TripError.at(self.path, problem, **where, decimal=repr(self.dialect.decimal))

    def _taken(self) -> list[list[str]]:
        """Return the cells of the rows among the pending lines, and note the other lines."""
        taken, self._pending = self._pending, []
        for line in taken:
            if line.kind == "several-tables":
                text = repr(line.text.strip()[:SHOWN])
                raise TripError.at(self.path, line.kind, number=line.number, strip=text)
            if line.kind:
                self._note(line.kind, line)
        return [line.cells for line in taken if line.kind != "lines-left-out"]

    def _note(self, kind: str, line: _Line) -> None:
        if kind not in self._odd:
            shown = re.sub(r"\s*;\s*", ";", line.text.strip()[:SHOWN])  # "; " separates remarks
            first = Finding("first-in-line", line_number=line.number, shown=repr(shown))
            self._odd[kind] = [0, first]
        self._odd[kind][0] += 1

    def _columns(self, rows: Sequence[Sequence[str]]) -> Block:
        columns = list(zip(*rows, strict=True)) or [()] * len(self._places)
        return tuple(
            self._stamps(pa.array(cells, pa.string()), kind, is_strict=False)
            if isinstance(kind, Notation)
            else np.array([float(cell.replace(",", ".") or "nan") for cell in cells])
            for cells, kind in zip(columns, self._kinds, strict=True)
        )

    def _check(self) -> None:
        odd = [self._odd.get(kind, (0, "")) for kind in ("lines-left-out", "damaged-rows")]
        n, first = sum(n for n, _ in odd), odd[0][1] or odd[1][1]
        if n > MOST_LEFT_OUT * self._n_rows + FOOTER_LINES:
            raise TripError.at(self.path, "too-many-odd-lines", n=n, first=first)
