"""Reading of all trips of many suspensions as arrays, for a view of the whole fleet."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import sqlalchemy as sql
from numpy.typing import NDArray
from sqlalchemy.engine import Connection

from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.records import HIGHEST_KM, VALUES, Key
from suspnet.ground.types import FloatArray
from suspnet.history.schema import BadRow, bad_row, check_types, trips
from suspnet.history.suspensions import is_one_of, known_suspensions, read_stored
from suspnet.maintenance.series import NUMBERS, Event, Series, utc

ROWS = 20_000
"""Rows that are held as Python's objects at once."""
TEXTS = ("trip", "start")
VALUE_COLUMNS = [
    VALUES[key].format(name) for key in ("estimates", "half_widths") for name in PARAMETERS
]
N_NUMBERS = 2 + len(NUMBERS) + len(VALUE_COLUMNS)
"""Number of columns of numbers: suspension, whether flagged, ``NUMBERS``, and these values."""
NOT_NEGATIVE = {"mileage_km", *VALUE_COLUMNS[len(PARAMETERS) :]}
Block = tuple[FloatArray, NDArray[np.str_], NDArray[np.datetime64]]
"""Columns of some trips: numbers of shape (n_trips, N_NUMBERS), names, starts."""


def read_series(
    connection: Connection, bad: list[BadRow], keys: Collection[Key] | None = None
) -> list[Series]:
    """Return all trips of each suspension, or of those named, sorted by vehicle and place.

    Rows that cannot be read are left out, and added to `bad`.
    """
    names = {one: key for one, (key, _) in known_suspensions(connection).items()}
    chosen = None if keys is None else [one for one, key in names.items() if key in keys]
    events = read_stored(connection, Event, bad)
    numbers, texts, starts = _columns(connection, chosen, names, bad)
    owner, km = numbers[:, 0].astype(np.int64), numbers[:, 2]
    order = np.lexsort((texts, km, owner))  # NaN last
    numbers, texts, starts = numbers[order], texts[order], starts[order]
    ids, begins = np.unique(owner[order], return_index=True)
    parts = np.split(np.arange(len(order)), begins[1:]) if len(ids) else []
    found = []
    for one, part in zip(ids.tolist(), parts, strict=True):
        if one not in names:
            continue  # its suspension is a bad row, or has just been added
        vehicle, place = names[one]
        columns = iter(numbers[part].T[1:].copy())
        flagged = next(columns) > 0
        scalars = {name: next(columns) for name in NUMBERS}
        values = [{name: next(columns) for name in PARAMETERS} for _ in range(2)]
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
                **scalars,
            )
        )
    return sorted(found, key=lambda s: (s.vehicle, str(s.place)))


def _columns(
    connection: Connection, chosen: list[int] | None, names: Mapping[int, Key], bad: list[BadRow]
) -> Block:
    columns = [trips.c[name] for name in (*NUMBERS, *VALUE_COLUMNS)]
    flagged = sql.case((trips.c.flags == "", 0), else_=1)
    texts = [trips.c[name] for name in TEXTS]
    query = sql.select(trips.c.suspension_id, flagged, *columns, *texts, trips.c.id)
    if chosen is not None:
        query = query.where(is_one_of(trips.c.suspension_id, chosen))
    blocks = [_block([])]
    for rows in connection.execute(query, execution_options={"yield_per": ROWS}).partitions():
        blocks += _readable(rows, names, bad)
    numbers, trip, start = (np.concatenate(part) for part in zip(*blocks, strict=True))
    return numbers, trip, start


def _readable(rows: Sequence[Any], names: Mapping[int, Key], bad: list[BadRow]) -> list[Block]:
    """Return the columns of the rows that can be read; the others are found by halving."""
    try:
        return [_block(rows)]
    except (TypeError, ValueError, OverflowError) as error:
        why: Exception = error
    if len(rows) > 1:
        half = len(rows) // 2
        return _readable(rows[:half], names, bad) + _readable(rows[half:], names, bad)
    (row,) = rows
    try:
        check_types(trips, row._mapping)  # says which column it is
    except ValueError as error:
        why = error
    bad.append(bad_row(trips, row._mapping, why, names.get(row[0])))
    return []


def _block(rows: Sequence[Any]) -> Block:
    """Return the columns of rows.

    Raises
    ------
    TypeError, ValueError, OverflowError
        If a value of one of them cannot be used.
    """
    columns = list(zip(*rows, strict=True)) or [()] * (N_NUMBERS + len(TEXTS))
    texts = columns[N_NUMBERS : N_NUMBERS + len(TEXTS)]
    numbers = np.array(columns[:N_NUMBERS], dtype=float).T
    for name, column in zip((*NUMBERS, *VALUE_COLUMNS), numbers.T[2:], strict=True):
        least = 0.0 if name in NOT_NEGATIVE else -np.inf
        most = HIGHEST_KM if name == "mileage_km" else np.inf
        wrong = column[(column < least) | (column >= most) | (column == -np.inf)]
        if len(wrong):
            raise ValueError(f"`{name}` must not be {wrong[0]:g}")
    if not all(isinstance(text, str) for several in texts for text in several):
        raise TypeError("name and start must be text")
    start = np.array([utc(text) for text in texts[1]], dtype="datetime64[s]")
    return numbers, np.array(texts[0], dtype=str), start
