"""A trip's result as a row of the store, and back; rows that cannot be read."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import sqlalchemy as sql
from sqlalchemy.engine import RowMapping

from suspnet.dynamics import PARAMETERS
from suspnet.history.records import Quality, TripResult
from suspnet.history.schema import NUMBERS, PLACE, TEXTS, VALUES, suspensions, trips
from suspnet.recordings.manifest import Place

log = logging.getLogger(__name__)
MOST_LOGGED = 1000
"""Largest number of bad rows that are logged, so that a damaged store fills no disk."""
_LOGGED: set[str] = set()
"""Bad rows that this process has logged: a program that follows a store reads them often."""
Key = tuple[str, Place]
"""Vehicle and place: which suspension it is."""
KINDS: dict[type, Any] = {sql.String: str, sql.Double: (int, float), sql.Integer: int}
"""Types of the values of a column, by its type. SQLite holds any value in any column."""
_FIELDS = {one.name: str(one.type) for one in fields(Quality)}
"""Each field of a trip's quality with the name of its type."""


@dataclass(frozen=True)
class BadRow:
    """A row that cannot be read and is left out.

    Attributes
    ----------
    table : str
    row : str
        Its primary key in words.
    why : str
    key : tuple of vehicle and Place, optional
        Suspension that it is of.
    """

    table: str
    row: str
    why: str
    key: Key | None = None

    def __str__(self) -> str:
        """Return which row it is, and why it is left out."""
        of = "" if self.key is None else f" of {self.key[0]}: {self.key[1]}"
        return f"{self.table}, row {self.row}{of}: {self.why}"


def bad_row(
    table: sql.Table, row: RowMapping, error: Exception | str, key: Key | None = None
) -> BadRow:
    """Return a row that an error keeps from being read."""
    names = [one.name for one in table.primary_key.columns if one.name in row]
    words = ", ".join(f"{name}={str(row[name])[:40]}" for name in names)
    return BadRow(table.name, words, " ".join(str(error).split())[:200], key)


def log_once(name: str, rows: Iterable[BadRow]) -> None:
    """Log the rows of a store, by its name, that this process has not logged yet."""
    for one in rows:
        words = f"{name}: {one}; it is left out: correct or delete it"
        if words not in _LOGGED and len(_LOGGED) < MOST_LOGGED:
            _LOGGED.add(words)
            log.warning("%s", words)


def check_types(table: sql.Table, row: RowMapping) -> None:
    """Raise ValueError if a value is not of the type of its column."""
    for name, value in row.items():
        column = table.columns.get(name)
        if column is None or (value is None and column.nullable):
            continue
        wanted = next((KINDS[one] for one in type(column.type).__mro__ if one in KINDS), object)
        if not isinstance(value, wanted):
            raise ValueError(f"`{name}` must not be {str(value)[:40]!r}")


def trip_key(result: TripResult) -> bytes:
    """Return what tells a trip from the others of its suspension: a hash of 16 bytes."""
    content = [result.trip, result.start, repr(float(result.mileage_km))]
    return hashlib.sha256(json.dumps(content).encode()).digest()[:16]


def undated_key(result: TripResult) -> bytes:
    """Return the key of a trip as it is where its start is not known."""
    return trip_key(replace(result, start=""))


def row_of(suspension: int, result: TripResult) -> dict[str, Any]:
    """Return the row of a trip."""
    row: dict[str, Any] = {name: getattr(result, name) for name in TEXTS}
    row |= {name: or_null(getattr(result, name)) for name in NUMBERS}
    row |= {name: or_null(getattr(result.quality, name)) for name in _FIELDS}
    for name, column in VALUES.items():
        values = getattr(result, name)
        row |= {column.format(p): or_null(values.get(p, math.nan)) for p in PARAMETERS}
    return row | {"suspension_id": suspension, "key": trip_key(result)}


def result_of(vehicle: str, place: Place, row: RowMapping) -> TripResult:
    """Return the trip of a row.

    Raises
    ------
    ValueError
        If a value is not of the type of its column.
    """
    check_types(trips, row)
    given: dict[str, Any] = {name: row[name] for name in TEXTS}
    given |= {name: or_nan(row[name]) for name in NUMBERS}
    for name, column in VALUES.items():
        columns = {parameter: row[column.format(parameter)] for parameter in PARAMETERS}
        given[name] = {parameter: v for parameter, v in columns.items() if v is not None}
    quality: dict[str, Any] = {
        name: or_nan(row[name]) if kind == "float" else row[name] for name, kind in _FIELDS.items()
    }
    return TripResult(vehicle=vehicle, place=place, quality=Quality(**quality), **given)


def or_null(value: Any) -> Any:
    """Return a value, None in place of NaN."""
    return None if isinstance(value, float) and math.isnan(value) else value


def or_nan(value: float | None) -> float:
    """Return a number of the store, NaN in place of NULL."""
    return math.nan if value is None else float(value)


def key_of(row: RowMapping) -> Key:
    """Return vehicle and place of a suspension's row.

    Raises
    ------
    ValueError
        If one of them is not text.
    """
    check_types(suspensions, row)
    return row["vehicle"], Place(**{name: row[name] for name in PLACE})
