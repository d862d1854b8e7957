"""Suspensions of a store: their numbers there, and the revisions that say what changed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict

import sqlalchemy as sql
from sqlalchemy.engine import Connection

from suspnet.history.database import HistoryError, upsert
from suspnet.history.rows import key_of
from suspnet.history.schema import suspensions
from suspnet.recordings.manifest import Place

Key = tuple[str, Place]
"""Vehicle and place: which suspension it is."""


def known_suspensions(
    connection: Connection, where: sql.ColumnElement[bool] | None = None
) -> dict[int, Key]:
    """Return vehicle and place of each suspension, or of those chosen, by its number."""
    chosen = sql.select(suspensions).where(sql.true() if where is None else where)
    rows = connection.execute(chosen).mappings()
    return {int(row["id"]): key_of(row) for row in rows}


def places_of(connection: Connection) -> list[Key]:
    """Return vehicle and place of each suspension, sorted."""
    found = known_suspensions(connection).values()
    return sorted(found, key=lambda one: (one[0], str(one[1])))


def is_one_of(column: sql.Column[int], ids: Iterable[int]) -> sql.ColumnElement[bool]:
    """Return the condition that a number is one of some, of which there may be many."""
    # written into the statement: databases limit the number of its parameters
    wanted: sql.BindParameter[list[int]] = sql.bindparam(
        None, sorted(ids), expanding=True, literal_execute=True
    )
    return column.in_(wanted)


def is_of(vehicle: str, place: Place) -> sql.ColumnElement[bool]:
    """Return the condition that a row is of a suspension."""
    wanted = asdict(place) | {"vehicle": vehicle}
    return sql.and_(*(suspensions.c[name] == value for name, value in wanted.items()))


def add_suspensions(connection: Connection, keys: Iterable[Key]) -> dict[Key, int]:
    """Return the number of each suspension; new ones are added."""
    wanted = list(dict.fromkeys(keys))
    upsert(connection, suspensions, [{"vehicle": name} | asdict(place) for name, place in wanted])
    chosen = (sql.select(suspensions.c.id).where(is_of(*key)) for key in wanted)
    found = (connection.execute(one).scalar_one() for one in chosen)
    return dict(zip(wanted, map(int, found), strict=True))


def numbers_of(connection: Connection, keys: Iterable[Key], name: str) -> dict[Key, int]:
    """Return the number of each suspension.

    Raises
    ------
    HistoryError
        If one is not known; it begins with the store's `name`.
    """
    wanted = list(keys)
    where = is_of(*wanted[0]) if len(wanted) == 1 else None  # all, if it is more than one
    there = {key: one for one, key in known_suspensions(connection, where).items()}
    for vehicle, place in wanted:
        if (vehicle, place) not in there:
            known = "; ".join(f"{other}: {one}" for other, one in places_of(connection))
            raise HistoryError(
                f"{name}: no trip of {vehicle}: {place} is kept here; known: {known or 'none'}"
            )
    return {key: there[key] for key in wanted}


def raise_revisions(connection: Connection, ids: Iterable[int]) -> None:
    """Raise the revisions of suspensions, and lock them for other writers until the end.

    A transaction that changes suspensions begins with this. They are locked one after the other, by
    their numbers, so that no two writers wait for each other.
    """
    rows = [{"one": one} for one in sorted(set(ids))]
    if rows:
        one = suspensions.update().where(suspensions.c.id == sql.bindparam("one"))
        connection.execute(one.values(revision=suspensions.c.revision + 1), rows)
