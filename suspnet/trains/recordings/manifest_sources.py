"""Sources in the manifest of a trip: where accelerometers and the speed are stored, and how.

A key is the metadata of a dataclass field (see `manifest`): its check, type, unit, default and
meaning. Parsing, messages, writing and the tables of docs/recordings.md are derived from it.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from suspnet.ground.findings import Finding, at
from suspnet.ground.parameters import SIDES
from suspnet.ground.records import MOST_NAME
from suspnet.ground.storage import printable
from suspnet.trains.recordings.dates import date_problem, time_zone
from suspnet.trains.recordings.errors import TripError, all_of

ACCELERATION_UNITS = {"m/s2": 1.0, "g": 9.80665}  # size of each unit in m/s2
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6}  # size of each unit in m/s
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # size of each unit in s
UNITS = {"acceleration": ACCELERATION_UNITS, "speed": SPEED_UNITS, "time": TIME_UNITS}
"""Units of each kind, the SI unit first."""
MIDDLE = "middle"  # side of a single sensor midway between left and right, or of the mean of both
OTHER_AXLE = "axle2"  # word in the names of sensors at the other axle of the bogie
_IN_FILE = "from the file"
POSITIVE = math.ulp(0.0)  # smallest number above 0
LARGEST = 1e300  # largest magnitude of a number in a manifest


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
        required = [name for name, key in keys.items() if key.default == "-"]
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


def key(*arguments: Any, **named: Any) -> dict[str, ManifestKey]:
    """Return the metadata of a dataclass field that is a key, by the arguments of `ManifestKey`."""
    return {"key": ManifestKey(*arguments, **named)}


def required(*arguments: Any, **named: Any) -> Any:
    """Return a dataclass field for a required key; arguments as for `ManifestKey`."""
    return field(metadata=key(*arguments, **named))


def optional(*arguments: Any, value: Any = None, **named: Any) -> Any:
    """Return a field for a key that is `value` if not given; arguments as for `ManifestKey`."""
    return field(default=value, metadata=key(*arguments, **named))


def keys_of(kind: type) -> dict[str, ManifestKey]:
    """Return the keys of the mapping from which a dataclass is read."""
    return {f.name: f.metadata["key"] for f in fields(kind) if "key" in f.metadata}


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
    """Return a check for one of the allowed texts or numbers."""

    def check(value: Value) -> Any:
        if isinstance(value.content, bool) or value.content not in list(allowed):
            raise value.refuse(Finding("one-of", allowed=list(allowed)))
        return allowed[list(allowed).index(value.content)]

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


def mapping_from(
    names: Sequence[str], check: Callable[[Value], Kind], default: str = "-"
) -> Callable[[Value], dict[str, Kind]]:
    """Return a check for a mapping from these names, each of which has the same check."""
    key = ManifestKey(check, "", "", default=default)
    return lambda value: value.read(dict.fromkeys(names, key))


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
    name = text(value)
    try:
        time_zone(name)
    except ValueError as error:
        raise value.refuse('one like "UTC", "+02:00" or "Europe/Berlin"') from error
    return name


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


def _unit(units: Mapping[str, float]) -> Any:
    return optional(
        one_of(list(units)),
        "`m/s2`, `g`; of the speed `m/s`, `km/h`",
        "unit of the values",
        default=_IN_FILE,
    )


@dataclass(frozen=True)
class FileSource:
    """Where and how one measured quantity is stored; `kind` is one of ``UNITS``."""

    kind: ClassVar[str] = "acceleration"
    file: str = required(text, "text", "a file of one of the [formats](#files)")
    unit: str | None = _unit(ACCELERATION_UNITS | SPEED_UNITS)
    column: str | None = optional(
        text, "text", "column, variable or channel of the file", default="the only one"
    )
    rate_hz: float | None = optional(
        positive,
        "number above 0",
        "sampling rate; with `time`, both must agree within 1 %",
        "Hz",
        _IN_FILE,
    )
    time: str | None = optional(
        text, "text", "column of times, instead of `rate_hz` or as well", default=_IN_FILE
    )
    start_s: float = optional(
        number(),
        "number",
        "time of the first sample on the trip's clock; with `time`, an offset added to it",
        "s",
        "0",
        value=0.0,
    )
    time_unit: str | None = optional(
        one_of(list(TIME_UNITS)),
        "`s`, `ms`, `us`, `ns`",
        "unit of times that are numbers",
        default="from the file, else detected",
    )
    time_zone: str | None = optional(
        zone,
        "text",
        'zone of time stamps without one: `UTC`, `"+02:00"`, `Europe/Berlin`',
        default="unknown",
    )
    csv: CsvDialect | None = optional(
        mapping_of(CsvDialect), "mapping", "how a CSV file is written, below", default="detected"
    )

    @property
    def si_size(self) -> float:
        """Size of the stated unit in the SI unit, which is assumed without one."""
        return 1.0 if self.unit is None else UNITS[self.kind][self.unit]


@dataclass(frozen=True)
class SpeedSource(FileSource):
    """Where the speed of the train is stored."""

    kind: ClassVar[str] = "speed"
    unit: str | None = _unit(SPEED_UNITS)


@dataclass(frozen=True)
class SensorSource(FileSource):
    """Where one accelerometer is stored."""

    unit: str | None = _unit(ACCELERATION_UNITS)
    sign: int = optional(
        one_of([1, -1]),
        "1 or -1",
        "-1 for a sensor that is mounted upside down",
        default="1",
        value=1,
    )
    range: float | None = optional(
        positive,
        "number above 0",
        "largest magnitude that the sensor can measure, to detect saturation; full scale of "
        "integers in WAV files",
        "the channel's",
        "unknown",
    )
    side: str | None = optional(
        one_of([*SIDES, MIDDLE]),
        "`left`, `right`; `middle` for a single sensor",
        "side of a sensor",
        default="the first is left; the suspension's",
    )
    axle: int | None = optional(
        one_of([1, 2]),
        "1 or 2",
        "axle of a sensor on `axle_box` or `bogie`; [each part](parts.md) is read with those of "
        "the bogie's other axle, 2, too",
        default="1",
    )

    @property
    def is_elsewhere(self) -> bool:
        """Whether the sensor is at the other axle of the bogie."""
        return self.axle == 2


Several = tuple[SensorSource, ...]
"""Accelerometers of one channel, those of axle 1 first, the left one of a pair first."""
Pair = tuple[SensorSource, SensorSource]  # two accelerometers at one place, the left one first


def partner_of(name: str) -> str:
    """Return the name of the other sensor of a pair; empty for a single sensor.

    >>> partner_of("bogie left"), partner_of("axle_box axle2 right"), partner_of("bogie axle2")
    ('bogie right', 'axle_box axle2 left', '')
    """
    place, _, side = name.rpartition(" ")
    return f"{place} {SIDES[side == SIDES[0]]}" if side in SIDES else ""


def channel_of(name: str) -> str:
    """Return the channel to which a sensor belongs; empty for one at the bogie's other axle.

    >>> channel_of("bogie left"), channel_of("bogie axle2")
    ('bogie', '')
    """
    channel, *where = name.split()
    return "" if OTHER_AXLE in where else channel
