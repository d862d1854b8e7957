"""Stored data of suspensions: revisions, trips, maintenance, alarms and acknowledgements."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, fields
from typing import Any, TypeVar

import sqlalchemy as sql
from sqlalchemy.engine import Connection

from suspnet.ground.findings import restored, stored
from suspnet.ground.records import MOST_NAME, PLACE, Key, Place, TripResult
from suspnet.trains.history.database import HistoryError, upsert
from suspnet.trains.history.schema import (
    BadRow,
    acknowledgements,
    alarms,
    bad_row,
    check_types,
    events,
    key_of,
    or_null,
    result_of,
    suspensions,
    trips,
)
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm
from suspnet.trains.maintenance.series import Event

Stored = TypeVar("Stored", Event, Alarm, Acknowledgement)
TABLES: dict[type, sql.Table] = {Event: events, Alarm: alarms, Acknowledgement: acknowledgements}
"""Table of each stored class."""


def known_suspensions(
    connection: Connection,
    where: sql.ColumnElement[bool] | None = None,
    bad: list[BadRow] | None = None,
) -> dict[int, tuple[Key, int]]:
    """Return key and revision of each suspension, or of those selected by `where`, by number.

    Unreadable rows are left out and appended to `bad`.
    """
    chosen = sql.select(suspensions).where(sql.true() if where is None else where)
    known = {}
    for row in connection.execute(chosen).mappings():
        try:
            known[int(row["id"])] = key_of(row), int(row["revision"])
        except ValueError as error:
            if bad is not None:
                bad.append(bad_row(suspensions, row, error))
    return known


def places_of(connection: Connection, bad: list[BadRow] | None = None) -> list[Key]:
    """Return vehicle and place of each suspension, sorted."""
    keys = [key for key, _ in known_suspensions(connection, bad=bad).values()]
    return sorted(keys, key=lambda key: (key[0], str(key[1])))


def is_one_of(column: sql.Column[int], ids: Iterable[int]) -> sql.ColumnElement[bool]:
    """Return the condition that a column is one of `ids`, of which there may be many."""
    # literals, because databases limit the number of bound parameters
    wanted: sql.BindParameter[list[int]] = sql.bindparam(
        None, sorted(ids), expanding=True, literal_execute=True
    )
    return column.in_(wanted)


def is_of(vehicle: str, place: Place) -> sql.ColumnElement[bool]:
    """Return the condition that selects a suspension."""
    wanted = asdict(place) | {"vehicle": vehicle}
    return sql.and_(*(suspensions.c[name] == value for name, value in wanted.items()))


def add_suspensions(connection: Connection, keys: Iterable[Key]) -> dict[Key, int]:
    """Return the number of each suspension; new ones are added, ValueError if a name is long."""
    wanted = list(dict.fromkeys(keys))
    for name in (text for vehicle, place in wanted for text in (vehicle, *astuple(place))):
        if len(name) > MOST_NAME:
            raise ValueError(
                f"a name must have at most {MOST_NAME} characters, got {name[:20]!r}..."
            )
    upsert(connection, suspensions, [{"vehicle": name} | asdict(place) for name, place in wanted])
    chosen = {key: sql.select(suspensions.c.id).where(is_of(*key)) for key in wanted}
    return {key: int(connection.execute(query).scalar_one()) for key, query in chosen.items()}


def numbers_of(connection: Connection, keys: Iterable[Key], name: str) -> dict[Key, int]:
    """Return the number of each suspension; HistoryError with the store's `name` if unknown."""
    wanted = list(keys)
    where = is_of(*wanted[0]) if len(wanted) == 1 else None  # all, if it is more than one
    numbers = {key: number for number, (key, _) in known_suspensions(connection, where).items()}
    for vehicle, place in wanted:
        if (vehicle, place) not in numbers:
            known = "; ".join(f"{other}: {where}" for other, where in places_of(connection))
            raise HistoryError(
                f"{name}: no trip of {vehicle}: {place} is stored here; known: {known or 'none'}"
            )
    return {key: numbers[key] for key in wanted}


def raise_revisions(connection: Connection, ids: Iterable[int]) -> None:
    """Increment the revisions of suspensions, and lock them until the transaction ends.

    A transaction that changes suspensions starts with this. They are locked in order of their
    numbers, so that writers do not deadlock.
    """
    rows = [{"number": number} for number in sorted(set(ids))]
    if rows:
        update = suspensions.update().where(suspensions.c.id == sql.bindparam("number"))
        connection.execute(update.values(revision=suspensions.c.revision + 1), rows)


def read_trips(
    connection: Connection,
    vehicle: str,
    place: Place,
    bad: list[BadRow],
    where: sql.ColumnElement[bool] | None = None,
) -> list[TripResult]:
    """Return the trips of a suspension by mileage, or those selected by `where`.

    Unreadable rows are appended to `bad`.
    """
    columns = [column for column in trips.columns if column.name != "key"]
    chosen = sql.select(*columns).join(suspensions).where(is_of(vehicle, place))
    if where is not None:
        chosen = chosen.where(where)
    results = []
    for row in connection.execute(chosen).mappings():
        try:
            results.append(result_of((vehicle, place), row))
        except ValueError as error:
            bad.append(bad_row(trips, row, error, (vehicle, place)))
    return sorted(results, key=lambda r: (math.isnan(r.mileage_km), r.mileage_km, r.trip))


def count_trips(connection: Connection, *where: sql.ColumnElement[bool]) -> int:
    """Return the number of trips selected by all of these conditions."""
    chosen = sql.select(sql.func.count(trips.c.id)).join(suspensions).where(*where)
    return int(connection.execute(chosen).scalar_one())


def delete_trips(connection: Connection, keys: Collection[tuple[int, bytes]]) -> None:
    """Delete trips by suspension and key, with their curves; missing ones are ignored."""
    rows = [{"of": suspension, "gone": key} for suspension, key in sorted(keys)]
    if rows:
        of, key = trips.c.suspension_id == sql.bindparam("of"), trips.c.key == sql.bindparam("gone")
        connection.execute(trips.delete().where(of, key), rows)


def read_stored(
    connection: Connection,
    kind: type[Stored],
    bad: list[BadRow],
    where: sql.ColumnElement[bool] | None = None,
) -> dict[Key, list[Stored]]:
    """Return the objects of one class of each suspension, or of those selected by `where`.

    They are sorted by the primary key of the table. Unreadable rows are left out and appended to
    `bad`.
    """
    table, names = TABLES[kind], [field.name for field in fields(kind)]
    places = (suspensions.c[name] for name in ("vehicle", *PLACE))
    chosen = (
        sql.select(*places, *(table.c[name] for name in names))
        .join_from(table, suspensions)
        .where(sql.true() if where is None else where)
        .order_by(*table.primary_key.columns)
    )
    of_key: dict[Key, list[Stored]] = {}
    for row in connection.execute(chosen).mappings():
        try:
            key = key_of(row)
        except ValueError:  # a bad row of the table of suspensions, not of this one
            continue
        try:
            check_types(table, row)
            values: dict[str, Any] = {
                name: math.nan if row[name] is None else row[name] for name in names
            }
            if kind is Alarm:
                values["words"] = restored(values["words"])
            of_key.setdefault(key, []).append(kind(**values))
        except ValueError as error:
            bad.append(bad_row(table, row, error, key))
    return of_key


def write_stored(
    connection: Connection, suspension: int, kept: Sequence[Event | Alarm | Acknowledgement]
) -> None:
    """Store objects of one class; those with an existing primary key are updated."""
    if kept:
        upsert(connection, TABLES[type(kept[0])], [_row(suspension, entry) for entry in kept])


def replace_alarms(connection: Connection, of_each: Mapping[int, Sequence[Alarm]]) -> None:
    """Replace the stored alarms of suspensions, by number; unchanged ones are not written."""
    stored_rows: dict[int, list[dict[str, Any]]] = {number: [] for number in of_each}
    chosen = sql.select(alarms).where(is_one_of(alarms.c.suspension_id, of_each))
    for row in connection.execute(chosen).mappings():
        stored_rows[row["suspension_id"]].append(dict(row))
    changed = []
    for number, own in of_each.items():
        rows = [_row(number, alarm) for alarm in own]
        if _by_key(rows) != _by_key(stored_rows[number]):
            changed.append(number)
    raise_revisions(connection, changed)
    connection.execute(alarms.delete().where(is_one_of(alarms.c.suspension_id, changed)))
    for number in changed:
        write_stored(connection, number, of_each[number])


def _by_key(rows: Iterable[dict[str, Any]]) -> dict[tuple[Any, ...], dict[str, Any]]:
    names = [column.name for column in alarms.primary_key.columns]
    return {tuple(row[name] for name in names): row for row in rows}


def _row(suspension: int, kept: Event | Alarm | Acknowledgement) -> dict[str, Any]:
    values = {name: or_null(value) for name, value in asdict(kept).items()}
    return values | {"suspension_id": suspension, "words": stored(kept.words)}
