"""Keys of a manifest and their checks, each defined once, at its dataclass field; CSV dialects.

A key is the metadata of a field (see `manifest`): its check, type, unit, default and meaning.
Parsing, messages, writing and the tables of docs/recordings.md are derived from it.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from suspnet.ground.findings import Finding, at
from suspnet.ground.records import MOST_NAME
from suspnet.ground.storage import printable
from suspnet.trains.recordings.dates import date_problem, time_zone
from suspnet.trains.recordings.errors import TripError, all_of

POSITIVE = math.ulp(0.0)
"""Smallest number above 0."""
LARGEST = 1e300
"""Largest magnitude of a number in a manifest."""


Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Value:
    """An unchecked value of a manifest and its position.

    `path` is the file; `name` joins the keys that lead to the value by dots, "" for the whole file.
    """

    path: Path
    name: str
    content: Any

    def at(self, key: object) -> Value:
        """Return the value of a key of this mapping, or of an index of this list."""
        if isinstance(key, int):
            return Value(self.path, f"{self.name}[{key}]", self.content[key])
        return Value(self.path, self._name_of(key), self.content.get(key))

    def refuse(self, rule: str) -> TripError:
        """Return an error that names file, key, rule and value."""
        name = f"`{self.name}`" if self.name else "the manifest"
        got = " ".join(reprlib.repr(self.content).split())
        return TripError.at(self.path, "not-so", key=name, rule=rule, got=got)

    def read(self, keys: Mapping[str, ManifestKey]) -> dict[str, Any]:
        """Return the checked values of a mapping, without optional ones that are null.

        Raises TripError if it is not a mapping, or else with all unknown keys, missing keys and
        refused values.
        """
        if not isinstance(self.content, dict):
            raise self.refuse("a mapping")
        required = [name for name, key in keys.items() if key.is_required]
        allowed = (*required, *(name for name in keys if name not in required))
        problems = [
            at(self.path, "key-unknown", name_of=self._name_of(name), allowed=str(allowed))
            for name in self.content
            if name not in allowed
        ]
        present = [name for name in keys if self.content.get(name) is not None]
        problems += [
            at(self.path, "key-missing", name_of=self._name_of(name))
            for name in required
            if name not in present
        ]
        values = all_of([partial(keys[name].check, self.at(name)) for name in present], problems)
        return dict(zip(present, values, strict=True))

    def _name_of(self, key: object) -> str:
        return ".".join(filter(None, (self.name, str(key))))


@dataclass(frozen=True)
class ManifestKey:
    """One key of a mapping of a manifest.

    `check` returns the checked content of a `Value` or raises TripError. The texts are for the
    table in docs/recordings.md; a key with the default "-" is required.
    """

    check: Callable[[Value], Any]
    type: str
    meaning: str
    unit: str = ""
    default: str = "-"

    @property
    def is_required(self) -> bool:
        """Whether there is no default."""
        return self.default == "-"

    def row(self, name: str) -> str:
        """Return the key's row of the table in docs/recordings.md."""
        cells = f"| `{name}` | {self.type} | {self.unit} | {self.default} | {self.meaning} |"
        return cells.replace("|  |", "| |")


def key(*arguments: Any, **named: Any) -> dict[str, ManifestKey]:
    """Return the metadata of a dataclass field that is a key, by the arguments of `ManifestKey`."""
    return {"key": ManifestKey(*arguments, **named)}


def required(*arguments: Any, **named: Any) -> Any:
    """Return a dataclass field for a required key; arguments as for `ManifestKey`."""
    return field(metadata=key(*arguments, **named))


def optional(*arguments: Any, **named: Any) -> Any:
    """Return a field for an optional key, None by default; arguments as for `ManifestKey`."""
    return field(default=None, metadata=key(*arguments, **named))


def keys_of(kind: type) -> dict[str, ManifestKey]:
    """Return the keys of the mapping from which a dataclass is read."""
    return {own.name: own.metadata["key"] for own in fields(kind) if "key" in own.metadata}


# checks


def text(value: Value) -> str:
    """Return a text that is not blank."""
    if not isinstance(value.content, str) or not value.content.strip():
        raise value.refuse("text (put it in quotes if it looks like anything else)")
    return value.content


def name(value: Value) -> str:
    """Return a short text of one line that is not blank, without surrounding blanks."""
    stripped = text(value).strip()
    if "\n" in stripped or len(printable(stripped)) > MOST_NAME:
        raise value.refuse(Finding("name-rule", most_name=MOST_NAME))
    return stripped


def one_of(allowed: Sequence[Any]) -> Callable[[Value], Any]:
    """Return a check for one of the allowed values."""

    def check(value: Value) -> Any:
        if value.content not in list(allowed):
            raise value.refuse(Finding("one-of", allowed=list(allowed)))
        return value.content

    return check


def number(
    rule: str = "a finite number", low: float = -LARGEST, high: float = LARGEST
) -> Callable[[Value], float]:
    """Return a check for a number from `low` to `high`; `rule` describes it in the message."""

    def check(value: Value) -> float:
        if isinstance(value.content, bool) or not isinstance(value.content, int | float):
            raise value.refuse(Finding("written-like", rule=rule))
        if not low <= value.content <= high:  # neither is NaN
            raise value.refuse(rule)
        return float(value.content)

    return check


positive = number("a number > 0", POSITIVE)


def mapping_of(kind: type[Kind]) -> Callable[[Value], Kind]:
    """Return a check for a mapping from which a dataclass is read."""
    return lambda value: kind(**value.read(keys_of(kind)))


def either(first: int, second: int) -> Callable[[Value], int]:
    """Return a check for one of two whole numbers."""
    rule = Finding("either", first=first, second=second)

    def check(value: Value) -> int:
        checked = number(rule)(value)
        if checked not in (first, second):
            raise value.refuse(rule)
        return int(checked)

    return check


def start(value: Value) -> datetime:
    """Return the start of a trip from text, or from the datetime of a manifest to be written."""
    content = value.content
    try:
        moment = content if isinstance(content, datetime) else datetime.fromisoformat(content)
    except (TypeError, ValueError) as error:
        raise value.refuse("a time like 2015-08-03T08:00:00") from error
    if problem := date_problem(moment):
        stated = {"isoformat": moment.isoformat(), "problem": problem}
        raise TripError.at(value.path, "start-implausible", **stated)
    return moment


def zone(value: Value) -> str:
    """Return the name of a known time zone."""
    try:
        time_zone(text(value))
    except TripError:
        raise
    except ValueError as error:
        raise value.refuse('one like "UTC", "+02:00" or "Europe/Berlin"') from error
    return str(value.content)


def header_line(value: Value) -> int:
    """Return the number of a line, or 0."""
    line = value.content
    if isinstance(line, bool) or not isinstance(line, int) or line < 0:
        raise value.refuse("a line counted from 1, or 0 if there are no names")
    return line


def encoding(value: Value) -> str:
    """Return the name of a known encoding."""
    name = text(value)
    try:
        "a;1".encode(name)
    except (LookupError, ValueError) as error:
        raise value.refuse("one like utf-8, utf-16 or latin-1") from error
    return name


DELIMITERS = {",": ",", ";": ";", "tab": "\t", "space": " ", "|": "|"}
"""Delimiters of CSV files by their names in manifests; "space" means any number of blanks."""


def _delimiter(value: Value) -> str:
    signs = DELIMITERS | {sign: sign for sign in DELIMITERS.values()}
    return signs[one_of(list(signs))(value)]


@dataclass(frozen=True)
class CsvDialect:
    """How a CSV file is written; None is detected."""

    delimiter: str | None = optional(
        _delimiter,
        "`,` `;` `tab` `space`, or the vertical bar in quotes",
        "`space` is any number of blanks",
        default="detected",
    )
    decimal: str | None = optional(
        one_of([".", ","]), "`.` or `,`", "decimal sign", default="detected"
    )
    header_line: int | None = optional(
        header_line,
        "whole number",
        "line with the names of the columns, counted from 1; 0 if there are none, so that columns "
        "are `column_1` and so on",
        default="detected",
    )
    encoding: str | None = optional(
        encoding, "text", "as Python names it: `utf-8`, `utf-16`, `latin-1`", default="detected"
    )
