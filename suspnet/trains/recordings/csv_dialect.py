"""How a CSV file is written: encoding, delimiter, decimal sign, and where its table starts.

A logger's file starts with any number of lines about the recording, followed by lines of names,
units and descriptions, and the rows. All of this is detected from the first ``SAMPLE_BYTES`` bytes,
except what the manifest gives.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from suspnet.ground.findings import Finding
from suspnet.trains.recordings.columns import is_unit, unit_in_name
from suspnet.trains.recordings.dates import date_in_lines, read_date
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest_keys import DELIMITERS, CsvDialect
from suspnet.trains.recordings.stamps import Notation, notation_of

SAMPLE_BYTES = 2**18
"""Number of bytes at the start of a file from which its dialect is detected."""
TAIL_LINES = 50
"""Largest number of rows, at the end of the sample, on which candidate dialects are compared."""
NEXT_LINES = 10
"""Number of lines checked to find the first row: at least half of them must be rows."""
NAME_LINES = 4
"""Largest number of lines above the rows among which those of names and units are looked for."""
MISSING = frozenset(
    "|#N/A|#N/A N/A|#NA|-1.#IND|-1.#QNAN|-NaN|-nan|1.#IND|1.#QNAN|N/A|NA|NULL|NaN|n/a|nan|null"
    "|1.#INF|-1.#INF|NAN|-|--|---|None|none|*|***".split("|")
)
"""Cells that mean a missing value."""
SIGNS = {"\N{MINUS SIGN}": "-", "\N{INFINITY}": "inf", "\0": ""}
"""Characters that are replaced: spreadsheets write the first two, damaged files hold the last."""
_DASHES = frozenset(("", "-", "--", "---", "*", "***"))
"""Cells that may also occur in lines of names or units."""
_INFINITE = r"[-+]?(?:inf|Inf|INF|infinity|Infinity)"
NUMBER = {
    ".": re.compile(rf"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|{_INFINITE}"),
    ",": re.compile(rf"[-+]?(?:\d+,?\d*|,\d+)(?:[eE][-+]?\d+)?|{_INFINITE}"),
}
"""Numbers, by the decimal sign."""
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
_POINTED = re.compile(r"[-+]?(?:0|[1-9]\d{0,2}(?:\.\d{3})*)")
GROUPED = re.compile(r"[-+]?\d{1,3}(?:[.,'\s\u2019]\d{3})+(?:[.,]\d*)?")
"""Numbers whose digits may be grouped, which are read where they are numbers without that."""
TIME_NAME = re.compile(
    r"(?<![^\W_])(?:t(?![^\W\d_])|time|date|clock|zeit|datum|uhrzeit|utc)", re.IGNORECASE
)
_TAG = re.compile(r"[;#%!*]|\w+:$|(?:header|name|column|channel|unit)s?$", re.IGNORECASE)
"""A word ahead of the names that marks their line."""
COMMENT = re.compile(r"^\s*(#|%|//)")
_BOMS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_WORDS = {"\t": "tab", " ": "space", "": "none"}

Kind = Notation | str | None
"""What a column holds: time stamps, text (an example of it), or numbers (None)."""


@dataclass(frozen=True)
class Dialect:
    """How one file is written.

    `delimiter` is "" for a single column, and " " for any number of spaces and tabs. Lines are
    counted from 1; `header_line` is 0 if there are no names. A missing unit is "". `kinds` are
    those of the columns. `date` is the start of the recording as stated above the names or in text
    columns of the first row; `above` are the lines above the names.
    """

    delimiter: str
    decimal: str
    header_line: int
    first_line: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    kinds: tuple[Kind, ...]
    encoding: str = ""
    has_bom: bool = False
    date: str | None = None
    above: tuple[str, ...] = ()

    def __str__(self) -> str:
        line = self.header_line
        return Finding(
            "csv-dialect",
            delimiter=_WORDS.get(self.delimiter, repr(self.delimiter)),
            decimal=repr(self.decimal),
            header=Finding("names-in-line", header_line=line) if line else "no names",
            first_line=self.first_line,
            encoding=self.encoding,
            bom=" with byte-order mark" if self.has_bom else "",
        )

    @property
    def unclear(self) -> tuple[str, ...]:
        """Remarks on columns whose texts look like times, but are not read, or not whole."""
        remarks = []
        for name, kind in zip(self.names, self.kinds, strict=True):
            if isinstance(kind, Notation):
                remarks += [Finding("dates-left-out", name=repr(name))] if kind.is_unclear else []
            elif kind and (TIME_NAME.search(name) or len(re.findall(r"\d+", kind)) > 2):
                remarks.append(Finding("times-unreadable", name=repr(name), value=repr(kind[:40])))
        return tuple(remarks)


@dataclass(frozen=True)
class _Candidate:
    """One way to read the rows; `n_broken` counts rows and cells that do not fit it.

    `numeric` are columns of numbers or missing values. `is_counted` means that the first column
    holds the rows' numbers or names.
    """

    delimiter: str
    decimal: str
    kinds: tuple[Kind, ...]
    numeric: tuple[int, ...]
    n_broken: int
    thousands: bool
    is_counted: bool

    @property
    def n_columns(self) -> int:
        return len(self.kinds)

    @property
    def read(self) -> list[int]:
        """Columns of numbers or times."""
        kinds = enumerate(self.kinds)
        return [i for i, kind in kinds if i in self.numeric or isinstance(kind, Notation)]

    def fits(self, line: str) -> list[bool]:
        """Return of each cell of numbers or times that is not empty whether it is one.

        The result is empty for lines of another number of cells, or without values.
        """
        cells, read = split(line, self.delimiter), self.read
        if len(cells) != self.n_columns or all(cells[i] in _DASHES for i in read):
            return []
        filled = [(cells[i], self.kinds[i]) for i in read if cells[i]]
        return [cell in MISSING or is_of_kind(cell, kind, self.decimal) for cell, kind in filled]

    def is_row(self, line: str) -> bool:
        """Return whether each numeric or time column holds a fitting or missing value."""
        fits = self.fits(line)
        return bool(fits) and all(fits)

    def is_damaged_row(self, line: str) -> bool:
        """Return whether a line is a row in which words replace some of the numbers."""
        fits = self.fits(line)
        return bool(fits) and fits[0] and 2 * sum(fits) >= len(fits)

    def has_numbers(self, cells: Sequence[str]) -> bool:
        """Return whether a line above the rows has a number in a column of numbers."""
        own = [cells[i] for i in self.numeric if cells[i] not in MISSING]
        return any(NUMBER[self.decimal].fullmatch(cell) for cell in own)


def find_dialect(path: Path, stated: CsvDialect | None = None) -> Dialect:
    """Return how a CSV file is written.

    Raises TripError, with what to give in the manifest, if there is no table of numbers or more
    than one way to read it.
    """
    stated = CsvDialect() if stated is None else stated
    encoding, has_bom, lines = _first_lines(path, stated)
    # Recognise rows at the end of the sample, which holds no header.
    filled = [line for line in lines[stated.header_line or 0 :] if line.strip()]
    tail = filled[-max(min(TAIL_LINES, len(filled) // 2), 1) :]
    candidates = _candidates(tail, stated)
    if not candidates:
        raise _unreadable(path, "no row of numbers was found: it is empty, cut off or no table")
    # Choose the preferred one of the candidates that have a table in the whole sample.
    tables = [(table, way) for way in candidates if (table := _table(lines, way, stated))]
    if not tables:
        raise _unreadable(path, "no row has as many values as there are names")
    # prefer names, more columns, and a decimal point
    best, candidate = max(
        tables,
        key=lambda pair: (pair[0].header_line > 0, len(pair[1].read), pair[0].decimal == "."),
    )
    # Refuse a file that can be read in two ways rather than guess.
    rivals = [
        other
        for other, _ in tables
        if other.header_line == best.header_line == 0 and len(other.names) != len(best.names)
    ]
    if rivals and stated.header_line is None and stated.delimiter is None:
        raise _unreadable(path, Finding("no-names-ambiguous", one=str(best), other=str(rivals[0])))
    if candidate.thousands and stated.decimal is None:
        raise _unreadable(path, "a comma may be its decimal sign or separate thousands")
    if stated.decimal is None and _may_group(lines[best.first_line - 1 :], best):
        raise _unreadable(path, "a point may be its decimal sign or separate thousands")
    above = lines[: (best.header_line or best.first_line) - 1]
    date = date_in_lines(above) or _date_in_row(lines[best.first_line - 1], candidate)
    return replace(best, encoding=encoding, has_bom=has_bom, date=date, above=tuple(above))


def _may_group(lines: Sequence[str], table: Dialect) -> bool:
    """Return whether all points may separate thousands, and a column has numbers without one."""
    if table.decimal != "." or table.delimiter == ",":
        return False
    rows = [split(line, table.delimiter) for line in lines]
    rows = [cells for cells in rows if len(cells) == len(table.kinds)]
    columns = [
        [cell for cell in cells if NUMBER["."].fullmatch(cell)]
        for cells, kind in zip(zip(*rows, strict=True), table.kinds, strict=True)
        if kind is None
    ]
    if not all(_POINTED.fullmatch(cell) for cells in columns for cell in cells if "." in cell):
        return False
    # a logger may write 0 and 12.345, but neither 345 nor 1036 next to 12.345
    return any(
        all(map(_POINTED.fullmatch, cells))
        and {"." in cell for cell in cells if cell.strip("+-0")} == {False, True}
        for cells in columns
    )


def _first_lines(path: Path, stated: CsvDialect) -> tuple[str, bool, list[str]]:
    """Return encoding, whether there is a byte-order mark, and the lines of the sample."""
    with path.open("rb") as stream:
        sample = stream.read(SAMPLE_BYTES)
        is_whole = not stream.read(1)
    encoding, has_bom = _encoding(sample)
    encoding = stated.encoding or encoding
    try:
        text = codecs.getincrementaldecoder(encoding)("strict").decode(sample)
    except (UnicodeError, LookupError) as error:
        raise _unreadable(path, Finding("other-encoding", encoding=encoding)) from error
    text = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    text = text.translate({ord(sign): plain for sign, plain in SIGNS.items()})
    lines = text.split("\n")  # splitlines() would also split at form feeds
    return encoding, has_bom, _unwrapped(lines if is_whole else lines[:-1])


def _unwrapped(lines: list[str]) -> list[str]:
    """Return lines with quoted cells that go over two or three lines moved to the last of these."""
    for i, line in enumerate(lines):
        before = line.rpartition('"')[0]
        filled = before.rstrip()
        is_first = not filled or filled[-1] in ",;|" or "\t" in before[len(filled) :]
        for n in (2, 3) if is_first and line.count('"') % 2 else ():
            text = " ".join(part.strip() for part in lines[i : i + n])
            if text.count('"') % 2 == 0:
                lines[i : i + n] = [*[""] * (len(lines[i : i + n]) - 1), text]
                break
    return lines


def _date_in_row(line: str, way: _Candidate) -> str | None:
    """Return the date and time of day in the text columns of a row; None if there are none."""
    read = [i for i in way.read if getattr(way.kinds[i], "is_dated", True)]
    cells = enumerate(split(line, way.delimiter))
    text = " ".join(cell for i, cell in cells if cell and i not in read)
    return text if re.search(r"\d:\d\d", text) and read_date(text) is not None else None


EXAMPLE = 'csv: {delimiter: ";", decimal: ",", header_line: 12, encoding: utf-8}'


def _unreadable(path: Path, reason: str) -> TripError:
    return TripError.at(path, "say-how-written", reason=reason, example=EXAMPLE)


def _encoding(sample: bytes) -> tuple[str, bool]:
    """Return encoding and byte-order mark: UTF-16 by its zero bytes, or else UTF-8 or Latin-1."""
    for bom, name in _BOMS:
        if sample.startswith(bom):
            return name, True
    even, odd = (sample[i::2].count(0) for i in (0, 1))
    if abs(even - odd) > len(sample) // 5:  # a block of zeros has as many of both
        return ("utf-16-le" if odd > even else "utf-16-be"), False
    try:
        codecs.getincrementaldecoder("utf-8")("strict").decode(sample)
    except UnicodeDecodeError:
        return "latin-1", False
    return "utf-8", False


def unread(kind: Kind) -> str:
    """Return why a column of a kind cannot be read; empty if it can."""
    if not isinstance(kind, str):
        return ""
    if GROUPED.fullmatch(kind):
        return Finding("grouped", value=repr(kind[:40]))
    return Finding("column-of-text", value=repr(kind[:40]))


def is_of_kind(cell: str, kind: Kind, decimal: str) -> bool:
    """Return whether a cell that is not empty is one of its column's kind."""
    if isinstance(kind, Notation):
        return kind.is_that_of(cell)
    return kind is not None or NUMBER[decimal].fullmatch(cell) is not None


def split(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line."""
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


def _candidates(tail: Sequence[str], stated: CsvDialect) -> list[_Candidate]:
    """Return the combinations of delimiter and decimal sign with the fewest misfits."""
    delimiters = (*DELIMITERS.values(), "") if stated.delimiter is None else (stated.delimiter,)
    decimals = (".", ",") if stated.decimal is None else (stated.decimal,)
    quoted = any('"' in line for line in tail)
    ways = []
    for delimiter in delimiters:
        rows = [split(line, delimiter) for line in tail]
        n_columns, n_rows = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        is_one = n_columns == 1 and delimiter and not stated.delimiter
        if n_columns == 0 or is_one or n_rows < 0.5 * len(tail):
            continue
        rows = [row for row in rows if len(row) == n_columns]
        for decimal in decimals:
            if delimiter != decimal or quoted:
                way = _read(delimiter, decimal, rows, len(tail) - len(rows))
                ways += [way] if way.numeric else []
    fewest = min((way.n_broken for way in ways), default=0)
    return [way for way in ways if way.n_broken == fewest]


def _read(delimiter: str, decimal: str, rows: Sequence[Sequence[str]], n_others: int) -> _Candidate:
    """Return the candidate of a delimiter and decimal sign for rows split at that delimiter."""
    # what most cells of a column are decides its kind; the others count as misfits
    kinds: list[Kind] = []
    numeric, commas, n_broken = [], list[str](), n_others
    for i, cells in enumerate(zip(*rows, strict=True)):
        filled = [cell for cell in cells if cell]
        numbers = [cell for cell in filled if NUMBER[decimal].fullmatch(cell)]
        rest = [cell for cell in filled if cell not in MISSING and cell not in numbers]
        stamps = {cell: notation for cell in rest if (notation := notation_of(cell))}
        words = [cell for cell in rest if cell not in stamps]
        kind: Kind = None
        if stamps:
            kind = Counter(stamps[cell] for cell in rest if cell in stamps).most_common(1)[0][0]
        elif len(words) > len(numbers):
            kind = words[0]
        elif filled:
            numeric.append(i)
            commas += [cell for cell in numbers if "," in cell]
        kinds.append(kind)
        n_broken += sum(cell.lstrip("+-.,")[:1].isdigit() for cell in words)
        commas += [cell for cell in stamps if decimal == "," and "," in cell]
    # commas that all may separate thousands leave the decimal sign open
    thousands = bool(commas) and all(_THOUSANDS.fullmatch(cell) for cell in commas)
    firsts = [row[0] for row in rows]
    is_counted = isinstance(kinds[0], str) or (
        len(firsts) > 1
        and all(cell.isdecimal() and len(cell) < 10 for cell in firsts)
        and all(int(b) - int(a) == 1 for a, b in pairwise(firsts))
    )
    return _Candidate(
        delimiter, decimal, tuple(kinds), tuple(numeric), n_broken, thousands, is_counted
    )


def _table(lines: Sequence[str], way: _Candidate, stated: CsvDialect) -> Dialect | None:
    """Return where the table of a candidate starts, with its columns; None if there is none."""
    begin = stated.header_line or 0
    first = next((i for i in range(begin, len(lines)) if _begins(lines, i, way)), None)
    if first is None:
        return None
    # Rows with a word in place of a number are rows, not names.
    while first > begin and way.is_damaged_row(lines[first - 1]):
        first -= 1
    number = split(lines[first], way.delimiter)[0]
    if number.isdecimal() and number != "1":
        way = replace(way, is_counted=False)
    # names and units are among the lines above, or in the line that the manifest names
    above = [i for i in range(begin, first) if re.search(r"\w", lines[i])]
    header, names, units = -1, [""] * way.n_columns, list[str]()
    if stated.header_line is None and above:
        header, names, units = _names(lines, above, way)
    elif begin:
        header, names = begin - 1, _padded(lines[begin - 1], way)
        units = _padded(lines[above[0]], way) if len(above) == 1 else []
    if not names:
        return None  # the numbers of names and columns differ
    names = [name or f"column_{i + 1}" for i, name in enumerate(names)]
    units = units or [unit_in_name(name) for name in names]
    return Dialect(
        way.delimiter,
        way.decimal,
        header + 1,
        first + 1,
        _distinct(names),
        tuple(unit.strip("[]() ") for unit in units),
        _kinds(lines[first : first + TAIL_LINES], way),
    )


def _names(
    lines: Sequence[str], above: Sequence[int], way: _Candidate
) -> tuple[int, list[str], list[str]]:
    """Return the index of the line of names, names and units; -1 and nothing if there are none.

    Lines of units and descriptions may follow the names.
    """
    block: list[tuple[int, list[str]]] = []  # lines of text with a cell for each column, upwards
    for i in reversed(above[-NAME_LINES:]):
        cells = _padded(lines[i], way)
        if not cells or (block and way.has_numbers(cells)):
            break
        if not way.has_numbers(cells):
            block.append((i, cells))
    if not block and (cells := _padded(lines[above[-1]], way)):
        block = [(above[-1], cells)]
    if not block:
        return -1, [], []
    units = next((n for n, (_, cells) in enumerate(block) if _are_units(cells)), -1)
    # the names are the next line above the units, unless a further one names a column of times
    names = range(units + 1, len(block)) or range(1)
    times = (n for n in names if any(map(TIME_NAME.search, block[n][1])))
    header = next(times, names[0])
    return *block[header], (block[units][1] if units not in (-1, header) else [])


def _kinds(lines: Sequence[str], way: _Candidate) -> tuple[Kind, ...]:
    """Return the kinds of the columns, by the first rows where the tail shows no numbers or times.

    The tail of a short file may be damaged, and that of a long one empty in some column.
    """
    kinds = list(way.kinds)
    rows = [split(line, way.delimiter) for line in lines]
    rows = [cells for cells in rows if len(cells) == way.n_columns]
    for i, cells in enumerate(zip(*rows, strict=True)):
        if isinstance(kinds[i], Notation) or i in way.numeric:
            continue
        filled = [cell for cell in cells if cell not in MISSING]
        n_numbers = sum(bool(NUMBER[way.decimal].fullmatch(cell)) for cell in filled)
        if filled:
            is_text = 2 * n_numbers < len(filled)
            kinds[i] = notation_of(filled[0]) or (filled[0] if is_text else None)
    return tuple(kinds)


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    """Return names with a number behind those that are equal, which all get one."""
    total, so_far = Counter(names), Counter[str]()
    distinct = []
    for name in names:
        so_far[name] += 1
        distinct.append(name if total[name] == 1 else f"{name}.{so_far[name]}")
    return tuple(distinct)


def _begins(lines: Sequence[str], i: int, way: _Candidate) -> bool:
    """Return whether the rows start at line `i`: it is a row, as are half of the next lines."""
    if not way.is_row(lines[i]):
        return False
    following = [line for line in lines[i : i + NEXT_LINES] if line.strip()]
    return 2 * sum(map(way.is_row, following)) >= len(following)


def _padded(line: str, way: _Candidate) -> list[str]:
    """Return the cells of a line of names or units; empty if there are too few or too many.

    Empty columns at the end, as after a delimiter at the end of each row, need no name, nor does a
    first column that counts the rows. A word ahead of the names that marks their line is left out.
    """
    cells = split(COMMENT.sub("", line), way.delimiter)
    filled = max(way.read) + 1
    if len(cells) > way.n_columns and not any(cells[way.n_columns :]):
        cells = cells[: way.n_columns]
    if len(cells) == way.n_columns + 1 and _TAG.match(cells[0]):
        cells = cells[1:]
    if len(cells) == way.n_columns - 1 == filled - 1 and way.is_counted:
        cells = ["", *cells]
    if not filled <= len(cells) <= way.n_columns:
        return []
    return cells + [""] * (way.n_columns - len(cells))


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether a line holds units: at least one known unit, and short texts only."""
    filled = [cell.strip("[]() ") for cell in cells if cell.strip("[]() ")]
    return any(is_unit(cell) for cell in filled) and all(len(cell) < 12 for cell in filled)
