"""How a CSV file is written: encoding, delimiter, decimal sign, and where its table starts.

A logger's file starts with any number of lines about the recording, followed by lines of names,
units and descriptions, and the rows. All of this is detected from the first ``SAMPLE_BYTES`` bytes,
except what the manifest gives.
"""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from suspnet.ground.findings import Finding
from suspnet.trains.recordings.columns import is_unit, unit_in_name
from suspnet.trains.recordings.dates import Notation, date_in_lines, notation_of, read_date
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest_sources import DELIMITERS, CsvDialect

SAMPLE_BYTES = 2**18  # number of bytes at the start of a file from which its dialect is detected
TAIL_LINES = 50  # largest number of rows, at the end of the sample, on which dialects are compared
NEXT_LINES = 10  # number of lines checked to find the first row: at least half of them must be rows
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
COMMENT = re.compile(r"^\s*(#|%|//)")
_BOMS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_WORDS = {"\t": "tab", " ": "space", "": "none"}
EXAMPLE = 'csv: {delimiter: ";", decimal: ",", header_line: 12, encoding: utf-8}'

Kind = Notation | str | None
"""What a column holds: time stamps, text (an example of it, "" if it is empty), or numbers."""


@dataclass(frozen=True)
class Dialect:
    """How one file is written.

    `delimiter` is "" for a single column, and " " for any number of spaces and tabs. `kinds` are
    those of the columns. Lines are counted from 1; `header_line` is 0 if there are no names. A
    missing unit is "". `date` is the start of the recording as stated above the names or in text
    columns of the first row; `above` are the lines above the names.
    """

    delimiter: str
    decimal: str
    kinds: tuple[Kind, ...]
    header_line: int = 0
    first_line: int = 1
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    encoding: str = ""
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

    @property
    def value_places(self) -> list[int]:
        """Places of the columns of numbers or times."""
        return [i for i, kind in enumerate(self.kinds) if not isinstance(kind, str)]

    def split(self, line: str) -> list[str]:
        """Return the cells of a line."""
        if self.delimiter == " ":
            return line.split()
        if not self.delimiter:
            return [line.strip().strip('"')]
        if '"' not in line:
            return [cell.strip() for cell in line.split(self.delimiter)]
        try:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=self.delimiter))]
        except (csv.Error, StopIteration):
            return []

    def fits(self, line: str) -> list[bool]:
        """Return of each cell of numbers or times that is not empty whether it is one.

        The result is empty for lines of another number of cells, or without values.
        """
        cells, places = self.split(line), self.value_places
        if len(cells) != len(self.kinds) or all(cells[i] in _DASHES for i in places):
            return []
        return [cells[i] in MISSING or self.is_value(cells[i], i) for i in places if cells[i]]

    def is_value(self, cell: str, place: int) -> bool:
        """Return whether a cell that is not missing is one of its column's kind."""
        kind = self.kinds[place]
        if isinstance(kind, Notation):
            return kind.is_that_of(cell)
        return kind is not None or NUMBER[self.decimal].fullmatch(cell) is not None

    def begins_at(self, lines: Sequence[str]) -> bool:
        """Return whether the first line is a row, and at least half of the next ones are."""
        fits = [self.fits(line) for line in lines[:NEXT_LINES] if line.strip()]
        are_rows = [bool(fit) and all(fit) for fit in fits]
        return bool(fits) and are_rows[0] and 2 * sum(are_rows) >= len(fits)

    def padded(self, line: str) -> list[str]:
        """Return the cells of a line of names or units; empty if there are too few or too many.

        Empty columns at the end, as after a delimiter at the end of each row, need no name.
        """
        cells, n = self.split(COMMENT.sub("", line)), len(self.kinds)
        if len(cells) > n and not any(cells[n:]):
            cells = cells[:n]
        if not max(self.value_places) < len(cells) <= n:
            return []
        return cells + [""] * (n - len(cells))

    def has_numbers(self, cells: Sequence[str]) -> bool:
        """Return whether a line above the rows has a number in a column of numbers."""
        numbers = [cells[i] for i, kind in enumerate(self.kinds) if kind is None]
        return any(cell not in MISSING and NUMBER[self.decimal].fullmatch(cell) for cell in numbers)


def find_dialect(path: Path, stated: CsvDialect | None = None) -> Dialect:
    """Return how a CSV file is written.

    Raises TripError, with what to give in the manifest, if there is no table of numbers or more
    than one way to read it.
    """
    stated = CsvDialect() if stated is None else stated
    encoding, lines = _first_lines(path, stated)
    # Recognise rows at the end of the sample, which holds no header.
    filled = [line for line in lines[stated.header_line or 0 :] if line.strip()]
    ways = _ways(filled[-max(min(TAIL_LINES, len(filled) // 2), 1) :], stated)
    if not ways:
        raise _unreadable(path, "no row of numbers was found: it is empty, cut off or no table")
    tables = [table for way in ways if (table := _table(lines, way, stated))]
    if not tables:
        raise _unreadable(path, "no row has as many values as there are names")
    # prefer names, more columns, and a decimal point
    best = max(tables, key=lambda t: (t.header_line > 0, len(t.value_places), t.decimal == "."))
    # Refuse a file that can be read in two ways rather than guess.
    rivals = [t for t in tables if t.header_line == 0 and len(t.names) != len(best.names)]
    if rivals and not best.header_line and (stated.header_line, stated.delimiter) == (None, None):
        raise _unreadable(path, Finding("no-names-ambiguous", one=str(best), other=str(rivals[0])))
    if stated.decimal is None and (sign := _may_group(lines[best.first_line - 1 :], best)):
        raise _unreadable(path, f"a {sign} may be its decimal sign or separate thousands")
    above = lines[: (best.header_line or best.first_line) - 1]
    date = date_in_lines(above) or _date_in_row(lines[best.first_line - 1], best)
    return replace(best, encoding=encoding, date=date, above=tuple(above))


def _unreadable(path: Path, reason: str) -> TripError:
    return TripError.at(path, "say-how-written", reason=reason, example=EXAMPLE)


def _first_lines(path: Path, stated: CsvDialect) -> tuple[str, list[str]]:
    with path.open("rb") as stream:
        sample = stream.read(SAMPLE_BYTES)
        is_whole = not stream.read(1)
    encoding = stated.encoding or _encoding(sample)
    try:
        text = codecs.getincrementaldecoder(encoding)("strict").decode(sample)
    except (UnicodeError, LookupError) as error:
        raise _unreadable(path, Finding("other-encoding", encoding=encoding)) from error
    text = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    text = text.translate({ord(sign): plain for sign, plain in SIGNS.items()})
    lines = text.split("\n")  # splitlines() would also split at form feeds
    return encoding, lines if is_whole else lines[:-1]


def _encoding(sample: bytes) -> str:
    for bom, name in _BOMS.items():
        if sample.startswith(bom):
            return name
    even, odd = (sample[i::2].count(0) for i in (0, 1))
    if abs(even - odd) > len(sample) // 5:  # a block of zeros has as many of both
        return "utf-16-le" if odd > even else "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")("strict").decode(sample)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _ways(tail: Sequence[str], stated: CsvDialect) -> list[Dialect]:
    delimiters = (*DELIMITERS.values(), "") if stated.delimiter is None else (stated.delimiter,)
    decimals = (".", ",") if stated.decimal is None else (stated.decimal,)
    quoted = any('"' in line for line in tail)
    ways = []
    for delimiter in delimiters:
        rows = list(map(Dialect(delimiter, ".", ()).split, tail))
        n_columns, n_rows = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        is_one = n_columns == 1 and delimiter and not stated.delimiter
        if n_columns == 0 or is_one or n_rows < 0.5 * len(tail):
            continue
        columns = list(zip(*(row for row in rows if len(row) == n_columns), strict=True))
        for decimal in decimals:
            if delimiter != decimal or quoted:
                kinds, misfits = zip(*(_kind(cells, decimal) for cells in columns), strict=True)
                if None in kinds:
                    n_broken = len(tail) - n_rows + sum(misfits)
                    ways.append((n_broken, Dialect(delimiter, decimal, kinds)))
    fewest = min((n_broken for n_broken, _ in ways), default=0)
    return [way for n_broken, way in ways if n_broken == fewest]


def _kind(cells: Sequence[str], decimal: str) -> tuple[Kind, int]:
    """Return the kind of a column, which most of its cells decide, and how many look like others'.

    Words without a digit are no misfits: they stand in place of missing values.
    """
    filled = [cell for cell in cells if cell]
    others = [c for c in filled if c not in MISSING and not NUMBER[decimal].fullmatch(c)]
    stamps = Counter(notation for cell in others if (notation := notation_of(cell)))
    words = [cell for cell in others if notation_of(cell) is None]
    n_misfits = sum(cell.lstrip("+-.,")[:1].isdigit() for cell in words)
    if stamps:
        return stamps.most_common(1)[0][0], n_misfits
    if not filled or len(words) > sum(map(bool, map(NUMBER[decimal].fullmatch, filled))):
        return (words or [""])[0], n_misfits
    return None, n_misfits


def _table(lines: Sequence[str], way: Dialect, stated: CsvDialect) -> Dialect | None:
    """Return a dialect with the start of its table and the names; None if there is no table."""
    begin, n = stated.header_line or 0, len(way.kinds)
    first = next((i for i in range(begin, len(lines)) if way.begins_at(lines[i:])), None)
    if first is None:
        return None
    # Rows with a word in place of a number are rows, not names.
    while first > begin and (fits := way.fits(lines[first - 1])) and fits[0]:
        if 2 * sum(fits) < len(fits):
            break
        first -= 1
    if "" in way.kinds:  # the tail may be empty in some column: the first rows decide
        rows = [row for r in lines[first : first + TAIL_LINES] if len(row := way.split(r)) == n]
        kinds = [_kind(cells, way.decimal)[0] for cells in zip(*rows, strict=True)]
        pairs = zip(way.kinds, kinds, strict=True)
        way = replace(way, kinds=tuple(early if late == "" else late for late, early in pairs))
    # names and units are among the lines above, or in the line that the manifest names
    above = [i for i in range(begin, first) if re.search(r"\w", lines[i])]
    header, names, units = -1, [""] * n, list[str]()
    if stated.header_line is None and above:
        header, names, units = _names(lines, above, way)
    elif begin:
        header, names = begin - 1, way.padded(lines[begin - 1])
        units = way.padded(lines[above[0]]) if len(above) == 1 else []
    if not names:
        return None  # the numbers of names and columns differ
    names = [name or f"column_{i + 1}" for i, name in enumerate(names)]
    units = [unit.strip("[]() ") for unit in units or map(unit_in_name, names)]
    way = replace(way, header_line=header + 1, first_line=first + 1)
    return replace(way, names=_distinct(names), units=tuple(units))


def _names(
    lines: Sequence[str], above: Sequence[int], way: Dialect
) -> tuple[int, list[str], list[str]]:
    """Return the index of the line of names, names and units; -1 and nothing if there are none.

    Lines of units and descriptions may follow the names.
    """
    block: list[tuple[int, list[str]]] = []  # lines of text with a cell for each column, upwards
    for i in reversed(above[-NAME_LINES:]):
        cells = way.padded(lines[i])
        if not cells or (block and way.has_numbers(cells)):
            break
        if not way.has_numbers(cells):
            block.append((i, cells))
    if not block and (cells := way.padded(lines[above[-1]])):
        block = [(above[-1], cells)]
    if not block:
        return -1, [], []
    units = next((n for n, (_, cells) in enumerate(block) if _are_units(cells)), -1)
    # the names are the next line above the units, unless a further one names a column of times
    names = range(units + 1, len(block)) or range(1)
    times = (n for n in names if any(map(TIME_NAME.search, block[n][1])))
    header = next(times, names[0])
    return *block[header], (block[units][1] if units not in (-1, header) else [])


def _are_units(cells: Sequence[str]) -> bool:
    filled = [cell.strip("[]() ") for cell in cells if cell.strip("[]() ")]
    return any(is_unit(cell) for cell in filled) and all(len(cell) < 12 for cell in filled)


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    total, so_far = Counter(names), Counter[str]()
    distinct = []
    for name in names:
        so_far[name] += 1
        distinct.append(name if total[name] == 1 else f"{name}.{so_far[name]}")
    return tuple(distinct)


def _may_group(lines: Sequence[str], table: Dialect) -> str:
    """Return the sign that may separate thousands in all numbers of a sample; empty if none."""
    rows = [cells for line in lines if len(cells := table.split(line)) == len(table.kinds)]
    columns = [[c for c in cells if c not in MISSING] for cells in zip(*rows, strict=True)]
    of_numbers = [cells for cells, kind in zip(columns, table.kinds, strict=True) if kind is None]
    signed = [c for cells in of_numbers for c in cells if table.decimal in c]
    if table.decimal == ",":
        of_times = (columns[i] for i in table.value_places if table.kinds[i] is not None)
        signed += [cell for cells in of_times for cell in cells if "," in cell]
        return "comma" if signed and all(map(_THOUSANDS.fullmatch, signed)) else ""
    if table.delimiter == "," or not all(map(_POINTED.fullmatch, signed)):
        return ""
    # a logger may write 0 and 12.345, but neither 345 nor 1036 next to 12.345
    mixed = (
        all(map(_POINTED.fullmatch, cells))
        and {"." in cell for cell in cells if cell.strip("+-0")} == {False, True}
        for cells in of_numbers
    )
    return "point" if any(mixed) else ""


def _date_in_row(line: str, table: Dialect) -> str | None:
    """Return the date and time of day in the text columns of a row; None if there are none."""
    places = [i for i in table.value_places if getattr(table.kinds[i], "is_dated", True)]
    text = " ".join(cell for i, cell in enumerate(table.split(line)) if cell and i not in places)
    return text if re.search(r"\d:\d\d", text) and read_date(text) is not None else None


def unread(kind: Kind) -> str:
    """Return why a column of a kind cannot be read; empty if it can."""
    if not isinstance(kind, str) or not kind:
        return ""
    value = repr(kind[:40])
    return Finding("grouped" if GROUPED.fullmatch(kind) else "column-of-text", value=value)
