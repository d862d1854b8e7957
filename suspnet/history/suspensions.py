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


def known_suspensions(connection: Connection) -> dict[int, Key]:
    """Return vehicle and place of each suspension by its number."""
    rows = connection.execute(sql.select(suspensions)).mappings()
    return {int(row["id"]): key_of(row) for row in rows}


def places_of(connection: Connection) -> list[Key]:
    """Return vehicle and place of each suspension, sorted."""
    found = known_suspensions(connection).values()
    return sorted(found, key=lambda one: (one[0], str(one[1])))


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
    there = {key: one for one, key in known_suspensions(connection).items()}
    wanted = list(keys)
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
