"""A trip's result as a row of the store, and back."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import fields
from typing import Any

from sqlalchemy.engine import RowMapping

from suspnet.dynamics import PARAMETERS
from suspnet.history.records import Quality, TripResult
from suspnet.history.schema import NUMBERS, PLACE, TEXTS, VALUES
from suspnet.recordings.manifest import Place

_FIELDS = {one.name: str(one.type) for one in fields(Quality)}
"""Each field of a trip's quality with the name of its type."""


def trip_key(result: TripResult) -> bytes:
    """Return what tells a trip from the others of its suspension: a hash of 16 bytes."""
    content = [result.trip, result.start, repr(float(result.mileage_km))]
    return hashlib.sha256(json.dumps(content).encode()).digest()[:16]


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
    """Return the trip of a row."""
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


def key_of(row: RowMapping) -> tuple[str, Place]:
    """Return vehicle and place of a suspension's row."""
    return row["vehicle"], Place(**{name: row[name] for name in PLACE})
