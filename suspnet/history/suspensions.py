"""Suspensions of a store: their numbers there, and the revisions that say what changed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict

import sqlalchemy as sql
from sqlalchemy.engine import Connection

from suspnet.history.database import HistoryError, upsert
from suspnet.history.rows import BadRow, Key, bad_row, key_of
from suspnet.history.schema import suspensions
from suspnet.recordings.manifest import Place


def known_suspensions(
    connection: Connection,
    where: sql.ColumnElement[bool] | None = None,
    bad: list[BadRow] | None = None,
) -> dict[int, tuple[Key, int]]:
    """Return key and revision of each suspension, or of those chosen, by its number.

    Rows that cannot be read are left out, and added to `bad`.
    """
    chosen = sql.select(suspensions).where(sql.true() if where is None else where)
    found = {}
    for row in connection.execute(chosen).mappings():
        try:
            found[int(row["id"])] = key_of(row), int(row["revision"])
        except ValueError as error:
            if bad is not None:
                bad.append(bad_row(suspensions, row, error))
    return found


def places_of(connection: Connection, bad: list[BadRow] | None = None) -> list[Key]:
    """Return vehicle and place of each suspension, sorted."""
    found = [key for key, _ in known_suspensions(connection, bad=bad).values()]
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
    there = {key: one for one, (key, _) in known_suspensions(connection, where).items()}
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
