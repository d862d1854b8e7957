"""Numbers and units as text, the same in messages, tables and pages."""

import math
import re
import reprlib
from dataclasses import fields
from pathlib import Path
from shlex import join
from typing import Any

from suspnet.ground.findings import OF, Finding, kind_is, parts_of
from suspnet.ground.storage import printable

NO_NUMBER = "\N{EN DASH}"


def count(n: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is 1."""
    return f"{n} {noun}{'s' * (n != 1)}"


def command(*words: object) -> str:
    """Return a command line of suspnet that can be pasted into a shell.

    >>> command("check", Path("-x"), "healthy=Züge 1")
    "suspnet check ./-x 'healthy=Züge 1'"
    """
    # a path must not look like an option
    typed = (f"./{w}" if isinstance(w, Path) and str(w).startswith("-") else str(w) for w in words)
    return printable(join(["suspnet", *typed]))


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
    low, high = texts[0], texts[-1]
    return low if low == high else Finding("span", low=low, high=high)


def unbroken(words: str) -> str:
    """Return text without line breaks between a number and its unit, or within a number."""
    return re.sub(r"(?<=\d) (?=%|km|\d{3})", "\N{NO-BREAK SPACE}", words)


def natural(text: str) -> list[str | int]:
    """Return a sort key that puts car 2 before car 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", text)]


def files_of(read_as: str) -> dict[str, int]:
    """Return the remarks on reading a trip without file names, with the number of files of each."""
    numbers: dict[str, int] = {}
    for part in parts_of(read_as):
        words, n_files = part, 0
        if kind_is(part, OF) and kind_is(part.values["words"], "csv-dialect"):
            words, n_files = part.values["words"], 1
        numbers[words] = numbers.get(words, 0) + n_files
    return numbers


class ShortRepr:
    """A dataclass with ``repr=False`` that prints shapes of arrays, and no more of long values.

    >>> from dataclasses import dataclass
    >>> import numpy as np
    >>> @dataclass(repr=False)
    ... class Signal(ShortRepr):
    ...     values: np.ndarray
    ...     rate_hz: float
    >>> Signal(np.zeros((3, 1000)), 500.0)
    Signal(values=array(3, 1000), rate_hz=500.0)
    """

    def __repr__(self) -> str:
        shown = [f"{part.name}={_short(getattr(self, part.name))}" for part in fields(self)]  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(shown)})"


def _short(value: Any) -> str:
    shape = getattr(value, "shape", ())
    return f"array{tuple(shape)}" if shape else reprlib.repr(value)
