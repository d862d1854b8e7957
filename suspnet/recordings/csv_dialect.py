"""How a CSV file is written: encoding, delimiter, decimal sign, and where its table starts.

A logger's file starts with any number of lines about the recording, followed by a line of names, in
some files a line of units, and the rows. All of this is detected from the first ``SAMPLE_BYTES``
bytes, except what the manifest gives.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from suspnet.recordings.columns import is_unit, unit_in_name
from suspnet.recordings.dates import date_in_lines, read_date
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest_keys import DELIMITERS, CsvDialect

SAMPLE_BYTES = 2**18
"""Number of bytes at the start of a file from which its dialect is detected."""
TAIL_LINES = 50
"""Largest number of rows, at the end of the sample, on which candidate dialects are compared."""
NEXT_LINES = 10
"""Number of lines checked to find the first row: at least half of them must be rows."""
MISSING = frozenset(
    "|#N/A|#N/A N/A|#NA|-1.#IND|-1.#QNAN|-NaN|-nan|1.#IND|1.#QNAN|N/A|NA|NULL|NaN|n/a|nan|null"
    "|NAN|-|--|---|None|none|*|***".split("|")
)
"""Cells that mean a missing value."""
_DASHES = frozenset(("", "-", "--", "---", "*", "***"))
"""Cells that may also occur in lines of names or units."""
_INFINITE = r"[-+]?(?:inf|Inf|INF|infinity|Infinity)"
_NUMBER = {
    ".": re.compile(rf"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|{_INFINITE}"),
    ",": re.compile(rf"[-+]?(?:\d+,?\d*|,\d+)(?:[eE][-+]?\d+)?|{_INFINITE}"),
}
_CLOCK = re.compile(r"(?:.* )?\d{1,2}:\d\d:\d\d,\d+")
"""A time of day with a decimal comma, alone or after a date."""
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
_STAMP = re.compile(
    r"(?:\d{4}-\d\d-\d\d[T ]|\d{1,2}\.\d{1,2}\.\d{4}\s)"
    r"\d{1,2}:\d\d(?::\d\d(?:[.,]\d{1,9})?)?(Z|[+-]\d\d(?::?\d\d)?)?"
)
_BOMS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_WORDS = {"\t": "tab", " ": "space", "": "none"}


@dataclass(frozen=True)
class Found:
    """How one file is written.

    `delimiter` is "" for a single column, and " " for any number of spaces and tabs. Lines are
    counted from 1; `header_line` is 0 if there are no names. A missing unit is "". `stamps` is, for
    each column, "" for numbers, "local" or "utc" for time stamps without or with a zone. `date` is
    the start of the recording as stated above the names or in text columns of the first row;
    `above` are the lines above the names.
    """

    encoding: str
    delimiter: str
    decimal: str
    header_line: int
    first_line: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    stamps: tuple[str, ...]
    has_bom: bool
    date: str | None = None
    above: tuple[str, ...] = ()

    def __str__(self) -> str:
        header = f"names in line {self.header_line}" if self.header_line else "no names"
        bom = " with byte-order mark" if self.has_bom else ""
        delimiter = _WORDS.get(self.delimiter, repr(self.delimiter))
        return (
            f"delimiter {delimiter}, decimal sign {self.decimal!r}, {header}, rows from line "
            f"{self.first_line} on, {self.encoding}{bom}"
        )


@dataclass(frozen=True)
class _Candidate:
    """One way to read the rows; `n_broken` counts rows and cells that do not fit it."""

    delimiter: str
    decimal: str
    n_columns: int
    numeric: tuple[int, ...]
    stamped: tuple[int, ...]
    n_broken: int
    thousands: bool

    def splits(self, line: str) -> list[str]:
        return _split(line, self.delimiter)

    def is_row(self, line: str) -> bool:
        """Return whether each numeric or time column holds a fitting or missing value."""
        cells = self.splits(line)
        if len(cells) != self.n_columns:
            return False
        numbers = [cells[i] for i in self.numeric if cells[i] not in MISSING]
        stamps = [cells[i] for i in self.stamped if cells[i] not in MISSING]
        filled = [cells[i] for i in (*self.numeric, *self.stamped)]
        return not all(cell in _DASHES for cell in filled) and (
            all(_NUMBER[self.decimal].fullmatch(cell) for cell in numbers)
            and all(_STAMP.fullmatch(cell) for cell in stamps)
        )


def find_dialect(path: Path, given: CsvDialect | None = None) -> Found:
    """Return how a CSV file is written.

    Raises TripError, with what to give in the manifest, if there is no table of numbers or more
    than one way to read it.
    """
    given = CsvDialect() if given is None else given
    encoding, has_bom, lines = _first_lines(path, given)
    # Recognise rows at the end of the sample, which holds no header.
    filled = [line for line in lines[given.header_line or 0 :] if line.strip()]
    tail = filled[-max(min(TAIL_LINES, len(filled) // 2), 1) :]
    candidates = _candidates(tail, given)
    if not candidates:
        raise _unreadable(path, "no row of numbers was found: it is empty, cut off or no table")
    # Choose the preferred one of the candidates that have a table in the whole sample.
    found = [_table(lines, one, given) for one in candidates]
    whole = [pair for pair in zip(found, candidates, strict=True) if pair[0] is not None]
    if not whole:
        raise _unreadable(path, "no row has as many values as there are names")
    best, candidate = max(whole, key=lambda pair: _preference(*pair))
    assert best is not None
    # Refuse a file that can be read in two ways rather than guess.
    rivals = [
        other
        for other, one in whole
        if other is not None
        and other.header_line == best.header_line == 0
        and len(other.names) != len(best.names)
        and one.n_broken == candidate.n_broken
    ]
    if rivals and given.header_line is None and given.delimiter is None:
        raise _unreadable(path, f"it has no names and may be read with {best} or {rivals[0]}")
    if candidate.thousands and given.decimal is None:
        raise _unreadable(path, "a comma may be its decimal sign or separate thousands")
    above = lines[: (best.header_line or best.first_line) - 1]
    date = date_in_lines(above) or _date_in_row(lines[best.first_line - 1], candidate)
    return replace(best, encoding=encoding, has_bom=has_bom, date=date, above=tuple(above))


def _first_lines(path: Path, given: CsvDialect) -> tuple[str, bool, list[str]]:
    """Return encoding, whether there is a byte-order mark, and the lines of the sample."""
    with path.open("rb") as stream:
        sample = stream.read(SAMPLE_BYTES)
        is_whole = not stream.read(1)
    encoding, has_bom = _encoding(sample)
    encoding = given.encoding or encoding
    try:
        text = codecs.getincrementaldecoder(encoding)("strict").decode(sample)
    except (UnicodeError, LookupError) as error:
        raise _unreadable(path, f"it is not {encoding} text") from error
    text = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")  # splitlines() would also split at form feeds
    if not is_whole:
        lines = lines[:-1]
    return encoding, has_bom, lines


def _date_in_row(line: str, one: _Candidate) -> str | None:
    """Return the date and time of day in the text columns of a row; None if there are none."""
    read = {*one.numeric, *one.stamped}
    text = " ".join(cell for i, cell in enumerate(one.splits(line)) if cell and i not in read)
    return text if re.search(r"\d:\d\d", text) and read_date(text) is not None else None


def _unreadable(path: Path, reason: str) -> TripError:
    return TripError(
        f"{path}: {reason}; say how it is written in the manifest, next to its `file`, like "
        '`csv: {delimiter: ";", decimal: ",", header_line: 12, encoding: utf-8}`'
    )


def _encoding(sample: bytes) -> tuple[str, bool]:
    """Return encoding and byte-order mark: UTF-16 by its zero bytes, or else UTF-8 or Latin-1."""
    for bom, name in _BOMS:
        if sample.startswith(bom):
            return name, True
    zeros = [sample[i::2].count(0) for i in (0, 1)]
    if max(zeros) > len(sample) // 5:
        return ("utf-16-le" if zeros[1] > zeros[0] else "utf-16-be"), False
    try:
        codecs.getincrementaldecoder("utf-8")("strict").decode(sample)
    except UnicodeDecodeError:
        return "latin-1", False
    return "utf-8", False


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    if not delimiter:
        return [line.strip().strip('"')]
    if '"' in line:
        try:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]
        except (csv.Error, StopIteration):
            return []
    return [cell.strip() for cell in line.split(delimiter)]


def _candidates(tail: Sequence[str], given: CsvDialect) -> list[_Candidate]:
    """Return the combinations of delimiter and decimal sign with the fewest misfits."""
    delimiters = (*DELIMITERS.values(), "") if given.delimiter is None else (given.delimiter,)
    found = []
    for delimiter in delimiters:
        rows = [_split(line, delimiter) for line in tail]
        n_columns, n_rows = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        if n_rows == 0 or n_columns == 0 or (n_columns == 1 and delimiter and not given.delimiter):
            continue
        rows = [row for row in rows if len(row) == n_columns]
        quoted = any('"' in line for line in tail)
        for decimal in (".", ",") if given.decimal is None else (given.decimal,):
            if delimiter == decimal == "," and not quoted:
                continue
            one = _read(delimiter, decimal, rows, len(tail) - len(rows))
            if one.numeric and n_rows >= 0.5 * len(tail):
                found.append(one)
    fewest = min((one.n_broken for one in found), default=0)
    return [one for one in found if one.n_broken == fewest]


def _read(delimiter: str, decimal: str, rows: Sequence[Sequence[str]], n_others: int) -> _Candidate:
    """Return the candidate of a delimiter and decimal sign for rows split at that delimiter."""
    numeric, stamped, n_broken = [], [], n_others
    commas: list[str] = []

    def is_number(cell: str) -> bool:
        return cell in MISSING or _NUMBER[decimal].fullmatch(cell) is not None

    for i, cells in enumerate(zip(*rows, strict=True)):
        filled = [cell for cell in cells if cell]
        numbers = [cell for cell in filled if is_number(cell)]
        stamps = [cell for cell in filled if _STAMP.fullmatch(cell)]
        if stamps:
            stamped.append(i)
        elif numbers:
            numeric.append(i)
            commas += [cell for cell in numbers if "," in cell]
        others = [cell for cell in filled if not (is_number(cell) or _STAMP.fullmatch(cell))]
        n_broken += sum(cell.lstrip("+-.,")[:1].isdigit() for cell in others)
        commas += [cell for cell in others if decimal == "," and _CLOCK.fullmatch(cell)]
    thousands = bool(commas) and all(_THOUSANDS.fullmatch(cell) for cell in commas)
    places = tuple(numeric), tuple(stamped)
    return _Candidate(delimiter, decimal, len(rows[0]), *places, n_broken, thousands)


def _table(lines: Sequence[str], one: _Candidate, given: CsvDialect) -> Found | None:
    """Return where the table of a candidate starts, with its columns; None if there is none."""
    begin = 0 if given.header_line is None else given.header_line
    first = next((i for i in range(begin, len(lines)) if _begins(lines, i, one)), None)
    if first is None:
        return None
    # The names are in the last line of text above the rows, or before it if that line holds units.
    above = [i for i in range(first) if re.search(r"\w", lines[i])]
    header: int | None = None
    units: list[str] = []
    if given.header_line is not None:
        header = given.header_line - 1 if given.header_line else None
        between = [i for i in above if header is not None and i > header]
        if len(between) == 1 and (cells := _padded(lines[between[0]], one)):
            units = cells
    elif above:
        header = above[-1]
        cells, before = _padded(lines[header], one), above[-2:-1]
        names = _padded(lines[before[0]], one) if before else []
        if names and len(names) == len(cells) and _are_units(cells):
            header, units = before[0], cells
    names = [] if header is None else _padded(lines[header], one)
    if header is not None and not names:
        return None  # the numbers of names and columns differ
    names = [name or f"column_{i + 1}" for i, name in enumerate(names or [""] * one.n_columns)]
    if not units:
        units = [unit_in_name(name) for name in names]
    stamps = [""] * one.n_columns
    for line in lines[first : first + TAIL_LINES]:
        for i, cell in enumerate(one.splits(line)[: one.n_columns]):
            if not stamps[i] and (match := _STAMP.fullmatch(cell)):
                stamps[i] = "utc" if match.group(1) else "local"
    return Found(
        "",
        one.delimiter,
        one.decimal,
        0 if header is None else header + 1,
        first + 1,
        tuple(names),
        tuple(unit.strip("[]() ") for unit in units),
        tuple(stamps),
        False,
    )


def _begins(lines: Sequence[str], i: int, one: _Candidate) -> bool:
    """Return whether the rows start at line `i`: it is a row, as are half of the next lines."""
    if not one.is_row(lines[i]):
        return False
    following = [line for line in lines[i : i + NEXT_LINES] if line.strip()]
    return 2 * sum(map(one.is_row, following)) >= len(following)


def _padded(line: str, one: _Candidate) -> list[str]:
    """Return the cells of a line of names or units; empty if there are too few or too many.

    Empty columns at the end, as after a delimiter at the end of each row, need no name.
    """
    cells = one.splits(re.sub(r"^\s*(#|%|//)", "", line))
    filled = max((*one.numeric, *one.stamped)) + 1
    if len(cells) > one.n_columns and not any(cells[one.n_columns :]):
        cells = cells[: one.n_columns]
    if not filled <= len(cells) <= one.n_columns:
        return []
    return cells + [""] * (one.n_columns - len(cells))


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether a line holds units: at least one known unit, and short texts only."""
    filled = [cell.strip("[]() ") for cell in cells if cell.strip("[]() ")]
    return any(is_unit(cell) for cell in filled) and all(len(cell) < 12 for cell in filled)


def _preference(found: Found | None, one: _Candidate) -> tuple[bool, int, int, bool]:
    """Return the sort key of a candidate: names, more columns, fewer misfits, decimal point."""
    assert found is not None
    n_read = len(one.numeric) + len(one.stamped)
    return found.header_line > 0, n_read, -one.n_broken, found.decimal == "."
