"""Trips as arrays for a view of the fleet, and the stored curves of some of them."""

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
    Commissioning,
    Key,
    TripResult,
    or_nan,
    to_arrays,
    to_responses,
    utc,
)
from suspnet.ground.storage import DamagedFileError, dump_arrays, load_arrays
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.trains.history.database import HistoryError, upsert
from suspnet.trains.history.schema import (
    BadRow,
    Condition,
    bad_row,
    check_types,
    curves,
    is_of,
    is_one_of,
    known_suspensions,
    read_stored,
    suspensions,
    trip_key,
    trips,
)
from suspnet.trains.maintenance.directions import SIGNS
from suspnet.trains.maintenance.series import NUMBERS, Event, Series, make_series

ROWS = 20_000  # number of rows that are Python objects at the same time, which bounds the memory
TEXTS = ("trip", "start", "sensors", "worn")
VALUE_COLUMNS = [
    VALUES[key].format(name) for key in ("estimates", "half_widths") for name in ESTIMATED
]
NUMERIC = ("suspension_id", "flagged", *NUMBERS, *VALUE_COLUMNS)
"""Columns of numbers of a block of trips; 1 is flagged."""
NOT_NEGATIVE = {"mileage_km", *VALUE_COLUMNS[len(ESTIMATED) :]}
SAME = 1e-9  # largest relative difference of two healthy values that count as equal
Block = dict[str, NDArray[Any]]
"""Some trips: ``TEXTS``, (n_trips,), and "numbers", (n_trips, n_numeric), as ``NUMERIC``."""


def comparable(
    references: Iterable[Commissioning], results: Sequence[TripResult]
) -> tuple[Condition, Condition]:
    """Return the conditions that a trip is comparable with `results`, and that it is not.

    A trip is if it is relative to one of `references`, has no estimate, or is of `results`. One
    with a start is neither if it is one of `results` that has none: it is the same trip.
    """
    is_in_results = trips.c.key.in_([trip_key(result) for result in results])
    chosen = sql.or_(trips.c.status != OK, is_in_results, *map(_is_relative_to, references))
    same = (
        sql.and_(trips.c.trip == result.trip, _is(trips.c.mileage_km, result.mileage_km))
        for result in results
        if not result.start
    )
    is_again = sql.and_(trips.c.start != "", sql.or_(sql.false(), *same))
    # false, not NULL, where a column is NULL
    chosen, is_again = (sql.func.coalesce(c, sql.false()) for c in (chosen, is_again))
    return sql.and_(chosen, ~is_again), sql.and_(~chosen, ~is_again)


def _is_relative_to(reference: Commissioning) -> Condition:
    healthy = {VALUES["healthy_si"].format(name): v for name, v in reference.healthy_si.items()}
    if not all(map(math.isfinite, healthy.values())):
        return sql.false()
    same = (sql.func.abs(trips.c[name] - v) <= SAME * abs(v) for name, v in healthy.items())
    return sql.and_(_is(trips.c.healthy_since_km, reference.since_km), *same)


def _is(column: sql.Column[float], value: float) -> Condition:
    """Return the condition that a column has a value; NaN is NULL there."""
    return column.is_(None) if math.isnan(value) else column == value


def read_series(
    connection: Connection,
    bad: list[BadRow],
    keys: Collection[Key] | None = None,
    where: Condition | None = None,
) -> list[Series]:
    """Return the trips of each suspension, or of those in `keys`, sorted by vehicle and place.

    `where` selects trips. Unreadable rows are left out and appended to `bad`.
    """
    only = is_of(*next(iter(keys))) if keys is not None and len(keys) == 1 else None
    key_of = {number: key for number, (key, _) in known_suspensions(connection, only).items()}
    chosen = None if keys is None else [number for number, key in key_of.items() if key in keys]
    of_chosen = None if chosen is None else is_one_of(suspensions.c.id, chosen)
    events = read_stored(connection, Event, bad, of_chosen)
    block = _read_block(connection, chosen, key_of, bad, where)
    # the rows of each suspension in one go
    owner = block["numbers"][:, 0].astype(np.int64)
    order = np.argsort(owner, kind="stable")
    numbers, begins = np.unique(owner[order], return_index=True)
    several = []
    for number, rows in zip(numbers.tolist(), np.split(order, begins)[1:], strict=True):
        if number not in key_of:
            continue  # its suspension is unreadable, or has just been added
        columns = dict(zip(NUMERIC, block["numbers"][rows].T, strict=True))
        series = make_series(
            columns["mileage_km"],
            {name: columns[name] for name in ESTIMATED},
            {name: columns[VALUES["half_widths"].format(name)] for name in ESTIMATED},
            columns["flagged"] > 0,
            events.get(key_of[number], ()),
            vehicle=key_of[number][0],
            place=key_of[number][1],
            **{name: columns[name] for name in NUMBERS[1:]},
            **{name: block[name][rows] for name in TEXTS},
        )
        several.append(series.widened())
    return sorted(several, key=lambda series: (series.vehicle, str(series.place)))


def _read_block(
    connection: Connection,
    chosen: list[int] | None,
    key_of: Mapping[int, Key],
    bad: list[BadRow],
    where: Condition | None,
) -> Block:
    special = {
        "flagged": sql.case((trips.c.flags == "", 0), else_=1),
        "direction": sql.case(*((trips.c.direction == name, n) for name, n in SIGNS.items())),
    }
    columns = (special[name] if name in special else trips.c[name] for name in (*NUMERIC, *TEXTS))
    query = sql.select(*columns, trips.c.id)
    if chosen is not None:
        query = query.where(is_one_of(trips.c.suspension_id, chosen))
    if where is not None:
        query = query.where(where)
    blocks = [_block([])]
    for rows in connection.execute(query, execution_options={"yield_per": ROWS}).partitions():
        blocks += _readable(rows, key_of, bad)
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _readable(rows: Sequence[Any], key_of: Mapping[int, Key], bad: list[BadRow]) -> list[Block]:
    """Return the columns of the readable rows; the others are searched by bisection."""
    try:
        return [_block(rows)]
    except (TypeError, ValueError, OverflowError) as error:
        why: Exception = error
    if len(rows) > 1:
        half = len(rows) // 2
        return _readable(rows[:half], key_of, bad) + _readable(rows[half:], key_of, bad)
    (row,) = rows
    try:
        check_types(trips, row._mapping)  # its message names the column
    except ValueError as error:
        why = error
    bad.append(bad_row(trips, row._mapping, why, key_of.get(row[0])))
    return []


def _block(rows: Sequence[Any]) -> Block:
    """Return the columns of rows; TypeError, ValueError or OverflowError if a value is invalid."""
    columns = list(zip(*rows, strict=True)) or [()] * len((*NUMERIC, *TEXTS))
    numbers = np.array(columns[: len(NUMERIC)], dtype=float).T
    texts = dict(zip(TEXTS, columns[len(NUMERIC) :], strict=False))  # the row's number is left
    for name, column in zip(NUMERIC[2:], numbers.T[2:], strict=True):
        least = 0.0 if name in NOT_NEGATIVE else -np.inf
        most = HIGHEST_KM if name == "mileage_km" else np.inf
        wrong = column[(column < least) | (column >= most) | (column == -np.inf)]
        if len(wrong):
            raise ValueError(Finding("bad-value", name=name, value=f"{wrong[0]:g}"))
    if not all(isinstance(text, str) for several in texts.values() for text in several):
        raise TypeError("name, start, sensors and worn parts must be text")
    return {
        "numbers": numbers,
        "trip": np.array(texts["trip"], dtype=str),
        "start": np.array([utc(text) for text in texts["start"]], dtype="datetime64[s]"),
        "sensors": np.array(texts["sensors"], dtype=str),
        # objects, as few texts are long and most of them empty
        "worn": np.array(texts["worn"], dtype=object),
    }


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


def _order(mileage_km: float | None, start: str, trip: str) -> tuple[bool, float, str, str]:
    """Return the key that sorts the trips of a suspension by mileage, start and name.

    Trips without a mileage come first, so that they never count as the newest.
    """
    km = or_nan(mileage_km)
    return not math.isnan(km), 0.0 if math.isnan(km) else km, start, trip


def write_curves(
    connection: Connection, suspension: int, results: Mapping[bytes, TripResult]
) -> None:
    """Store the curves of the first and of the newest trips of a suspension, and delete others.

    `results` are trips of the suspension by key: their stored curves are replaced, or deleted if
    they have none now. The transaction of `connection` must have locked the suspension.
    """
    chosen = (
        sql.select(curves.c.key, trips.c.mileage_km, trips.c.start, trips.c.trip)
        .join(trips, _same_trip())
        .where(curves.c.suspension_id == suspension)
    )
    stored = {row[0]: _order(*row[1:]) for row in connection.execute(chosen)}
    new = {key: result.curves for key, result in results.items() if result.curves is not None}
    # which of the stored and the new ones remain
    orders = {key: place for key, place in stored.items() if key not in results}
    for key in new:
        result = results[key]
        orders[key] = _order(result.mileage_km, result.start, result.trip)
    ordered = sorted(orders, key=lambda key: orders[key])
    remaining = {*ordered[:1], *ordered[-N_NEWEST:]}
    gone = [{"of": suspension, "gone": key} for key in stored if key not in remaining]
    if gone:
        match = sql.and_(
            curves.c.suspension_id == sql.bindparam("of"), curves.c.key == sql.bindparam("gone")
        )
        connection.execute(curves.delete().where(match), gone)
    rows = []
    for key in new.keys() & remaining:
        arrays = to_arrays(new[key])
        content = dump_arrays({name: arrays[name] for name in NAMES})
        row = {"suspension_id": suspension, "key": key, "arrays": content}
        rows.append(row | {"sha256": hashlib.sha256(content).hexdigest()})
    upsert(connection, curves, rows)


def read_responses(connection: Connection, where: Condition, name: str) -> list[TripResponses]:
    """Return the stored curves of the suspension selected by `where`, by mileage.

    HistoryError, whose message starts with `name`, is raised if they were altered.
    """
    # NullType returns a value of any type unchanged, so that it can be refused with a message
    arrays = sql.type_coerce(curves.c.arrays, sql.types.NullType())
    columns = trips.c.trip, trips.c.mileage_km, trips.c.start, arrays, curves.c.sha256
    joined = sql.select(*columns).join_from(curves, trips, _same_trip()).join(suspensions)
    of_trips = []
    for row in connection.execute(joined.where(where)).all():
        if not all(isinstance(value, kind) for value, kind in zip(row, ROW, strict=True)):
            raise HistoryError(at(name, "curves-damaged"))
        trip, mileage_km, start, content, sha256 = row
        subject = f"{name}: the stored curves of {trip}"
        try:
            stored = load_arrays(bytes(content), subject, sha256)
        except DamagedFileError as error:
            raise HistoryError(" ".join(str(error).split())) from None
        shapes = {key: array.shape for key, array in stored.items()}
        both = (2, *shapes.get("frequencies_hz", ()))
        if shapes != dict.fromkeys(NAMES, both) | {"frequencies_hz": both[1:]} or len(both) != 2:
            raise HistoryError(f"{subject} is damaged: it holds {shapes}")
        stored["responses"] = to_responses(stored.pop("real"), stored.pop("imaginary"))
        of_trips.append(TripResponses(trip, or_nan(mileage_km), start, **stored))
    return sorted(of_trips, key=lambda curves: _order(curves.mileage_km, curves.start, curves.trip))


def _same_trip() -> Condition:
    is_same_suspension = curves.c.suspension_id == trips.c.suspension_id
    return sql.and_(is_same_suspension, curves.c.key == trips.c.key)
