"""Trips as arrays for a view of the fleet, and the stored curves of some of them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sqlalchemy as sql
from numpy.typing import NDArray
from sqlalchemy.engine import Connection

from suspnet.ground.findings import Finding, at
from suspnet.ground.parameters import ESTIMATED
from suspnet.ground.records import (
    HIGHEST_KM,
    OK,
    VALUES,
    Key,
    TripCurves,
    TripResult,
    or_nan,
    to_arrays,
    to_responses,
    utc,
)
from suspnet.ground.storage import DamagedFileError, dump_arrays, load_arrays
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.history.database import HistoryError, upsert
from suspnet.history.schema import (
    BadRow,
    bad_row,
    check_types,
    curves,
    suspensions,
    trip_key,
    trips,
)
from suspnet.history.suspensions import is_of, is_one_of, known_suspensions, read_stored
from suspnet.maintenance.directions import SIGNS
from suspnet.maintenance.series import NUMBERS, Event, Series, with_estimates

ROWS = 20_000
"""Number of rows that are Python objects at the same time, which bounds the memory."""
TEXTS = ("trip", "start", "sensors", "worn")
VALUE_COLUMNS = [
    VALUES[key].format(name) for key in ("estimates", "half_widths") for name in ESTIMATED
]
N_NUMBERS = 2 + len(NUMBERS) + len(VALUE_COLUMNS)
"""Number of numeric columns: suspension, whether flagged, ``NUMBERS`` and ``VALUE_COLUMNS``."""
SAME = 1e-9
"""Largest relative difference of two healthy values that count as equal."""
NOT_NEGATIVE = {"mileage_km", *VALUE_COLUMNS[len(ESTIMATED) :]}
Block = tuple[
    FloatArray, NDArray[np.str_], NDArray[np.datetime64], NDArray[np.str_], NDArray[np.object_]
]
"""Columns of some trips: numbers of shape (n_trips, ``N_NUMBERS``), and ``TEXTS``."""


@dataclass(frozen=True)
class Reference:
    """A healthy state to which estimates are relative.

    `since_km` is the mileage of its first healthy trip, [km], NaN for a nominal vehicle;
    `healthy_si` are its values, [N/m, N s/m, kg].
    """

    since_km: float
    healthy_si: Mapping[str, float]


def is_comparable(
    references: Iterable[Reference], results: Sequence[TripResult]
) -> sql.ColumnElement[bool]:
    """Return the condition that a trip is relative to one of `references`, or has no estimate.

    It also holds for the trips of `results`.
    """
    own = trips.c.key.in_([trip_key(one) for one in results])
    return _certain(sql.or_(trips.c.status != OK, own, *map(_is_relative_to, references)))


def is_dated_again(results: Sequence[TripResult]) -> sql.ColumnElement[bool]:
    """Return the condition that a trip with a start is one of `results` that has none."""
    undated = [one for one in results if not one.start]
    same = (
        sql.and_(trips.c.trip == one.trip, _is(trips.c.mileage_km, one.mileage_km))
        for one in undated
    )
    return _certain(sql.and_(trips.c.start != "", sql.or_(sql.false(), *same)))


def _is_relative_to(one: Reference) -> sql.ColumnElement[bool]:
    columns = {VALUES["healthy_si"].format(name): value for name, value in one.healthy_si.items()}
    if not all(map(math.isfinite, columns.values())):
        return sql.false()
    same = (
        sql.func.abs(trips.c[name] - value) <= SAME * abs(value) for name, value in columns.items()
    )
    return sql.and_(_is(trips.c.healthy_since_km, one.since_km), *same)


def _certain(condition: sql.ColumnElement[bool]) -> sql.ColumnElement[bool]:
    """Return a condition that is false, not NULL, where a column is NULL."""
    return sql.func.coalesce(condition, sql.false())


def _is(column: sql.Column[float], value: float) -> sql.ColumnElement[bool]:
    """Return the condition that a column has a value; NaN is NULL there."""
    return column.is_(None) if math.isnan(value) else column == value


def read_series(
    connection: Connection,
    bad: list[BadRow],
    keys: Collection[Key] | None = None,
    where: sql.ColumnElement[bool] | None = None,
) -> list[Series]:
    """Return the trips of each suspension, or of those in `keys`, sorted by vehicle and place.

    `where` selects trips. Unreadable rows are left out and appended to `bad`.
    """
    one_key = is_of(*next(iter(keys))) if keys is not None and len(keys) == 1 else None
    names = {one: key for one, (key, _) in known_suspensions(connection, one_key).items()}
    chosen = None if keys is None else [one for one, key in names.items() if key in keys]
    of_chosen = None if chosen is None else is_one_of(suspensions.c.id, chosen)
    events = read_stored(connection, Event, bad, of_chosen)
    numbers, texts, starts, sensors, worn = _columns(connection, chosen, names, bad, where)
    owner, km = numbers[:, 0].astype(np.int64), numbers[:, 2]
    order = np.lexsort((texts, km, owner))  # NaN last
    numbers, texts, starts = numbers[order], texts[order], starts[order]
    sensors, worn = sensors[order], worn[order]
    ids, begins = np.unique(owner[order], return_index=True)
    parts = np.split(np.arange(len(order)), begins[1:]) if len(ids) else []
    found = []
    for one, part in zip(ids.tolist(), parts, strict=True):
        if one not in names:
            continue  # its suspension is unreadable, or has just been added
        vehicle, place = names[one]
        columns = iter(numbers[part].T[1:].copy())
        flagged = next(columns) > 0
        scalars = {name: next(columns) for name in NUMBERS}
        values = [{name: next(columns) for name in ESTIMATED} for _ in range(2)]
        kept = with_estimates(values[0])
        values = [{name: part[name] for name in kept} for part in values]
        found.append(
            Series(
                vehicle,
                place,
                texts[part],
                starts[part],
                flagged,
                estimates=values[0],
                half_widths=values[1],
                events=tuple(events.get((vehicle, place), ())),
                sensors=sensors[part],
                worn=worn[part],
                **scalars,
            ).widened()
        )
    return sorted(found, key=lambda s: (s.vehicle, str(s.place)))


def _columns(
    connection: Connection,
    chosen: list[int] | None,
    names: Mapping[int, Key],
    bad: list[BadRow],
    where: sql.ColumnElement[bool] | None,
) -> Block:
    sign = sql.case(*((trips.c.direction == one, number) for one, number in SIGNS.items()))
    columns = [
        sign if name == "direction" else trips.c[name] for name in (*NUMBERS, *VALUE_COLUMNS)
    ]
    flagged = sql.case((trips.c.flags == "", 0), else_=1)
    texts = [trips.c[name] for name in TEXTS]
    query = sql.select(trips.c.suspension_id, flagged, *columns, *texts, trips.c.id)
    if chosen is not None:
        query = query.where(is_one_of(trips.c.suspension_id, chosen))
    if where is not None:
        query = query.where(where)
    blocks = [_block([])]
    for rows in connection.execute(query, execution_options={"yield_per": ROWS}).partitions():
        blocks += _readable(rows, names, bad)
    numbers, trip, start, sensors, worn = (np.concatenate(one) for one in zip(*blocks, strict=True))
    return numbers, trip, start, sensors, worn


def _readable(rows: Sequence[Any], names: Mapping[int, Key], bad: list[BadRow]) -> list[Block]:
    """Return the columns of the readable rows; the others are found by bisection."""
    try:
        return [_block(rows)]
    except (TypeError, ValueError, OverflowError) as error:
        why: Exception = error
    if len(rows) > 1:
        half = len(rows) // 2
        return _readable(rows[:half], names, bad) + _readable(rows[half:], names, bad)
    (row,) = rows
    try:
        check_types(trips, row._mapping)  # its message names the column
    except ValueError as error:
        why = error
    bad.append(bad_row(trips, row._mapping, why, names.get(row[0])))
    return []


def _block(rows: Sequence[Any]) -> Block:
    """Return the columns of rows; TypeError, ValueError or OverflowError if a value is invalid."""
    columns = list(zip(*rows, strict=True)) or [()] * (N_NUMBERS + len(TEXTS))
    texts = columns[N_NUMBERS : N_NUMBERS + len(TEXTS)]
    numbers = np.array(columns[:N_NUMBERS], dtype=float).T
    for name, column in zip((*NUMBERS, *VALUE_COLUMNS), numbers.T[2:], strict=True):
        least = 0.0 if name in NOT_NEGATIVE else -np.inf
        most = HIGHEST_KM if name == "mileage_km" else np.inf
        wrong = column[(column < least) | (column >= most) | (column == -np.inf)]
        if len(wrong):
            raise ValueError(Finding("curves-must-not", name=name, wrong=wrong[0]))
    if not all(isinstance(text, str) for several in texts for text in several):
        raise TypeError("name, start, sensors and worn parts must be text")
    trip, sensors = np.array(texts[0], dtype=str), np.array(texts[2], dtype=str)
    start = np.array([utc(text) for text in texts[1]], dtype="datetime64[s]")
    # objects, as few texts are long and most of them empty
    return numbers, trip, start, sensors, np.array(texts[3], dtype=object)


N_NEWEST = 3
"""Number of newest trips whose curves are stored, in addition to those of the first trip."""
NAMES = ("frequencies_hz", "real", "imaginary", "coherences", "deviations")
"""Names of the stored arrays of a trip."""


ROW = (str, int | float | None, str, bytes | memoryview, str)
"""Types of a row: name, mileage and start of a trip, its arrays and their hash."""


@dataclass(frozen=True, eq=False)
class TripResponses:
    """Stored transfer functions of one trip; the fields are as in ``TripCurves``."""

    trip: str
    mileage_km: float
    start: str
    frequencies_hz: FloatArray
    responses: ComplexArray
    coherences: FloatArray
    deviations: FloatArray


Order = tuple[int, float, str, str]


def order(mileage_km: float, start: str, trip: str) -> Order:
    """Return the key that sorts the trips of a suspension by mileage, start and name.

    Trips without a mileage come first, so that they never count as the newest.
    """
    known = not math.isnan(mileage_km)
    return int(known), mileage_km if known else 0.0, start, trip


def write_curves(
    connection: Connection, suspension: int, results: Mapping[bytes, TripResult]
) -> None:
    """Store the curves of the first and of the newest trips of a suspension, and delete others.

    `results` are trips of the suspension by key: their stored curves are replaced, or deleted if
    they have none now. The transaction of `connection` must have locked the suspension.
    """
    of_one = curves.c.suspension_id == suspension
    chosen = (
        sql.select(curves.c.key, trips.c.mileage_km, trips.c.start, trips.c.trip)
        .join(trips, _same_trip())
        .where(of_one)
    )
    there = {row[0]: order(or_nan(row[1]), row[2], row[3]) for row in connection.execute(chosen)}
    new = {key: one.curves for key, one in results.items() if one.curves is not None}
    orders = {key: order(r.mileage_km, r.start, r.trip) for key, r in results.items() if key in new}
    known = {key: place for key, place in there.items() if key not in results} | orders
    ordered = sorted(known, key=lambda key: known[key])
    kept = {*ordered[:1], *ordered[-N_NEWEST:]}
    gone = [{"of": suspension, "gone": key} for key in there if key not in kept]
    if gone:
        match = sql.and_(
            curves.c.suspension_id == sql.bindparam("of"), curves.c.key == sql.bindparam("gone")
        )
        connection.execute(curves.delete().where(match), gone)
    rows = [_row(suspension, key, found) for key, found in new.items() if key in kept]
    upsert(connection, curves, rows)


def read_responses(
    connection: Connection, where: sql.ColumnElement[bool], name: str
) -> list[TripResponses]:
    """Return the stored curves of the suspension selected by `where`, by mileage.

    HistoryError, whose message starts with `name`, is raised if they were altered.
    """
    # NullType returns a value of any type unchanged, so that it can be refused with a message
    arrays = sql.type_coerce(curves.c.arrays, sql.types.NullType())
    columns = trips.c.trip, trips.c.mileage_km, trips.c.start, arrays, curves.c.sha256
    chosen = (
        sql.select(*columns).join_from(curves, trips, _same_trip()).join(suspensions).where(where)
    )
    rows = connection.execute(chosen).all()
    for row in rows:
        if not all(isinstance(one, kind) for one, kind in zip(row, ROW, strict=True)):
            raise HistoryError(at(name, "curves-damaged"))
    rows = sorted(rows, key=lambda row: order(or_nan(row[1]), row[2], row[0]))
    return [_responses(*row, name=name) for row in rows]


def _same_trip() -> sql.ColumnElement[bool]:
    same = curves.c.suspension_id == trips.c.suspension_id, curves.c.key == trips.c.key
    return sql.and_(*same)


def _row(suspension: int, key: bytes, found: TripCurves) -> dict[str, object]:
    arrays = to_arrays(found)
    content = dump_arrays({name: arrays[name] for name in NAMES})
    digest = hashlib.sha256(content).hexdigest()
    return {"suspension_id": suspension, "key": key, "arrays": content, "sha256": digest}


def _responses(
    trip: str, mileage_km: float | None, start: str, content: bytes, sha256: str, *, name: str
) -> TripResponses:
    """Return curves from their stored bytes; HistoryError if these were altered."""
    what = f"{name}: the stored curves of {trip}"
    try:
        arrays = load_arrays(bytes(content), what, sha256)
    except DamagedFileError as error:
        raise HistoryError(" ".join(str(error).split())) from None
    shapes = {key: one.shape for key, one in arrays.items()}
    both = (2, *shapes.get("frequencies_hz", ()))
    if shapes != dict.fromkeys(NAMES, both) | {"frequencies_hz": both[1:]} or len(both) != 2:
        raise HistoryError(f"{what} is damaged: it holds {shapes}")
    responses = to_responses(arrays.pop("real"), arrays.pop("imaginary"))
    return TripResponses(trip, or_nan(mileage_km), start, responses=responses, **arrays)
