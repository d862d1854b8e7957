"""How a CSV file is written: encoding, delimiter, decimal sign, and where its table begins.

A logger's file begins with any number of lines about the recording. Then come a line of names, in
some files a line of units, and the rows. All of it is found out from the beginning of the file;
what is given in the manifest is not asked for again.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from suspnet.recordings.columns import is_unit, unit_in_name
from suspnet.recordings.dates import date_in_lines, read_date
from suspnet.recordings.manifest import DELIMITERS, CsvDialect
from suspnet.recordings.manifest_keys import TripError

SAMPLE_BYTES = 2**18
"""Number of bytes at the beginning of a file from which its dialect is found out."""

TAIL_LINES = 50
"""Largest number of rows at the end of the sample that candidates are compared on."""

NEXT_LINES = 10
"""The first row is one that is followed by rows, as half of this many lines at least."""

MISSING = frozenset(
    "|#N/A|#N/A N/A|#NA|-1.#IND|-1.#QNAN|-NaN|-nan|1.#IND|1.#QNAN|N/A|NA|NULL|NaN|n/a|nan|null"
    "|NAN|-|--|---|None|none|*|***".split("|")
)
"""Cells without a value."""

_DASHES = frozenset(("", "-", "--", "---", "*", "***"))
"""Cells that may stand in lines of names or units, too."""

_INFINITE = r"[-+]?(?:inf|Inf|INF|infinity|Infinity)"
_NUMBER = {
    ".": re.compile(rf"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|{_INFINITE}"),
    ",": re.compile(rf"[-+]?(?:\d+,?\d*|,\d+)(?:[eE][-+]?\d+)?|{_INFINITE}"),
}
_CLOCK = re.compile(r"(?:.* )?\d{1,2}:\d\d:\d\d,\d+")
"""A time of day with a decimal comma, alone or after a date."""
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
_STAMP = re.compile(
    r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?(Z|[+-]\d\d(?::?\d\d)?)?"
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

    Attributes
    ----------
    encoding : str
    delimiter : str
        "" if there is one column only; " " stands for any number of spaces and tabs.
    decimal : {".", ","}
    header_line : int
        Line of the names, counted from 1; 0 if there are none.
    first_line : int
        Line of the first row.
    names, units : tuples of str
        A unit is empty where none is given.
    stamps : tuple of str
        Of each column "" for numbers, "local" or "utc" for time stamps without or with a zone.
    has_bom : bool
    date : str or None
        When the recording began, by the lines above the names or columns of words in the first row.
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

    def __str__(self) -> str:
        """Return what was found as text."""
        header = f"names in line {self.header_line}" if self.header_line else "no names"
        bom = " with byte-order mark" if self.has_bom else ""
        delimiter = _WORDS.get(self.delimiter, repr(self.delimiter))
        return (
            f"delimiter {delimiter}, decimal sign {self.decimal!r}, {header}, rows from line "
            f"{self.first_line} on, {self.encoding}{bom}"
        )


@dataclass(frozen=True)
class _Candidate:
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
        """Return whether a line has a number, time or nothing wherever it should."""
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

    Raises
    ------
    TripError
        If there is no table of numbers, or more than one way to read it; the message names what to
        give in the manifest.
    """
    given = CsvDialect() if given is None else given
    encoding, has_bom, lines = _first_lines(path, given)
    # Rows are recognised at the end of the sample, where no header is.
    filled = [line for line in lines[given.header_line or 0 :] if line.strip()]
    tail = filled[-max(min(TAIL_LINES, len(filled) // 2), 1) :]
    candidates = _candidates(tail, given)
    if not candidates:
        raise _unreadable(path, "no row of numbers was found: it is empty, cut off or no table")
    # Of those that explain the whole sample, the one that explains most of it is taken.
    found = [_table(lines, one, given) for one in candidates]
    whole = [pair for pair in zip(found, candidates, strict=True) if pair[0] is not None]
    if not whole:
        raise _unreadable(path, "no row has as many values as there are names")
    best, candidate = max(whole, key=lambda pair: _preference(*pair))
    assert best is not None
    # A file that may be read in two ways is refused rather than guessed.
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
    return Found(
        encoding,
        best.delimiter,
        best.decimal,
        best.header_line,
        best.first_line,
        best.names,
        best.units,
        best.stamps,
        has_bom,
        date_in_lines(lines[: (best.header_line or best.first_line) - 1])
        or _date_in_row(lines[best.first_line - 1], candidate),
    )


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
    """Return the date and time of day in a row's columns of words; None if there are none."""
    read = {*one.numeric, *one.stamped}
    text = " ".join(cell for i, cell in enumerate(one.splits(line)) if cell and i not in read)
    return text if re.search(r"\d:\d\d", text) and read_date(text) is not None else None


def _unreadable(path: Path, reason: str) -> TripError:
    return TripError(
        f"{path}: {reason}; say how it is written in the manifest, next to its `file`, like "
        '`csv: {delimiter: ";", decimal: ",", header_line: 12, encoding: utf-8}`'
    )


def _encoding(sample: bytes) -> tuple[str, bool]:
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
    """Return what rows hold if they are read with a delimiter and a decimal sign."""
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
    """Return where the table of a candidate begins and what its columns are; None if nowhere."""
    begin = 0 if given.header_line is None else given.header_line
    first = next((i for i in range(begin, len(lines)) if _begins(lines, i, one)), None)
    if first is None:
        return None
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
        return None  # another number of names than of columns
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
    """Return whether the rows begin in a line: it is one, and so are half of the next lines."""
    if not one.is_row(lines[i]):
        return False
    following = [line for line in lines[i : i + NEXT_LINES] if line.strip()]
    return 2 * sum(map(one.is_row, following)) >= len(following)


def _padded(line: str, one: _Candidate) -> list[str]:
    """Return the cells of a line of names or units; none if there are not as many as columns.

    Names may lack where columns are empty, as behind a delimiter at the end of each row.
    """
    cells = one.splits(re.sub(r"^\s*(#|%|//)", "", line))
    filled = max((*one.numeric, *one.stamped)) + 1
    if len(cells) > one.n_columns and not any(cells[one.n_columns :]):
        cells = cells[: one.n_columns]
    if not filled <= len(cells) <= one.n_columns:
        return []
    return cells + [""] * (one.n_columns - len(cells))


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether a line holds units: one at least that is known, the others short."""
    filled = [cell.strip("[]() ") for cell in cells if cell.strip("[]() ")]
    return any(is_unit(cell) for cell in filled) and all(len(cell) < 12 for cell in filled)


def _preference(found: Found | None, one: _Candidate) -> tuple[bool, int, int, bool]:
    """Return what makes a way to read better: names, more columns, and a decimal point."""
    assert found is not None
    n_read = len(one.numeric) + len(one.stamped)
    return found.header_line > 0, n_read, -one.n_broken, found.decimal == "."
