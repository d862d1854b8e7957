"""Numbers and units as text, the same in messages, tables and pages."""

from __future__ import annotations

import math
import re

NO_NUMBER = "\N{EN DASH}"
_FILE = re.compile(r"[^;:]+\.\w+: (?=delimiter )")
"""Name of a CSV file before the words on how it is read."""


def count(n: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is 1."""
    return f"{n} {noun}{'s' * (n != 1)}"


def number(value: float | None, digits: int = 1, scale: float = 1.0) -> str:
    """Return a number with a typographic minus sign, or a dash if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return NO_NUMBER
    text = f"{value * scale:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}" if float(text) else "")


def thousands(value: float) -> str:
    """Return a whole number with spaces between thousands, or a dash if it is not finite."""
    return f"{value:,.0f}".replace(",", " ") if math.isfinite(value) else NO_NUMBER


def kilometres(value: float) -> str:
    """Return a mileage with its unit."""
    return f"{thousands(value)} km"


def span(*texts: str) -> str:
    """Return the ends of a range, or one text if both are equal."""
    return " to ".join(dict.fromkeys(texts))


def unbroken(words: str) -> str:
    """Return text without line breaks between a number and its unit, or within a number."""
    return re.sub(r"(?<=\d) (?=%|km|\d{3})", "\N{NO-BREAK SPACE}", words)


def natural(text: str) -> list[str | int]:
    """Return a sort key that puts car 2 before car 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", text)]


def files_of(read_as: str) -> dict[str, int]:
    """Return what is said of reading a trip, without names of files, with their number; 0: none.

    >>> files_of("a.csv: delimiter tab, utf-8; b.csv: delimiter tab, utf-8")
    {'delimiter tab, utf-8': 2}
    """
    found: dict[str, int] = {}
    for part in filter(None, read_as.split("; ")):
        words, n_files = _FILE.subn("", part)
        found[words] = found.get(words, 0) + n_files
    return found
