"""The store of a fleet's history: an SQLite file, or a PostgreSQL server by its URL."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sql
from sqlalchemy.engine import Connection
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from suspnet.history.database import HistoryError, connect, database_url, prepare, upsert
from suspnet.history.events import Event
from suspnet.history.records import TripResult
from suspnet.history.rows import key_of, or_null, result_of, row_of
from suspnet.history.schema import acknowledgements, alarms, events, suspensions, trips
from suspnet.history.series import Series, read_series
from suspnet.maintenance.alarms import Acknowledgement, Alarm
from suspnet.recordings.manifest import Place

Kept = TypeVar("Kept", Event, Alarm, Acknowledgement)
Key = tuple[str, Place]
"""Vehicle and place: which suspension it is."""


class History:
    """Trips of all suspensions, their estimates and alarms, and what people did.

    Several programs may read and write at once. Made anew where there is nothing yet.

    Parameters
    ----------
    place : str or Path
        A file (SQLite), or a URL such as "postgresql://user:password@host/database".

    Raises
    ------
    HistoryError
        If it is no store of this version, or cannot be reached.
    """

    def __init__(self, place: str | Path) -> None:
        self._url = database_url(place)
        self._engine = connect(self._url)
        try:
            with self._transaction() as connection:
                prepare(connection, str(self))
        except BaseException:
            self.close()
            raise

    def __str__(self) -> str:
        """Return where the store is, without a password."""
        if self._url.get_backend_name() == "sqlite":
            return str(self._url.database)
        return self._url.render_as_string(hide_password=True)

    def __enter__(self) -> History:
        """Return the store."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Let go of the file or the server."""
        self._engine.dispose()

    def places(self) -> list[Key]:
        """Return vehicle and place of each suspension, sorted."""
        with self._transaction() as connection:
            return _places(connection)

    def write(self, results: Sequence[TripResult]) -> None:
        """Keep trips, all or none. One that is there already is replaced by what was read last.

        Their curves are not kept.

        Raises
        ------
        HistoryError
            If the store cannot be written.
        """
        with self._transaction() as connection:
            ids = _ids(connection, ((result.vehicle, result.place) for result in results))
            rows = [row_of(ids[result.vehicle, result.place], result) for result in results]
            upsert(connection, trips, rows)

    def read(self, vehicle: str, place: Place) -> list[TripResult]:
        """Return the trips of a suspension, by mileage; empty if there is none."""
        chosen = sql.select(trips).join(suspensions).where(_is(vehicle, place))
        with self._transaction() as connection:
            rows = connection.execute(chosen).mappings().all()
        found = [result_of(vehicle, place, row) for row in rows]
        return sorted(found, key=lambda r: (math.isnan(r.mileage_km), r.mileage_km, r.trip))

    def series(self) -> list[Series]:
        """Return the trips of all suspensions as arrays, sorted by vehicle and place.

        Far quicker than ``read``: for a view of the whole fleet.
        """
        with self._transaction() as connection:
            return read_series(connection, _kept(connection, events, Event))

    def add_event(self, vehicle: str, place: Place, event: Event) -> None:
        """Keep a maintenance event; the same one again replaces its words.

        Raises
        ------
        HistoryError
            If the store knows no trip of the suspension, or cannot be written.
        """
        with self._transaction() as connection:
            upsert(connection, events, [_row(self._id(connection, vehicle, place), event)])

    def events(self, vehicle: str, place: Place) -> list[Event]:
        """Return the maintenance events of a suspension, by mileage."""
        with self._transaction() as connection:
            return _kept(connection, events, Event, _is(vehicle, place)).get((vehicle, place), [])

    def keep_alarms(self, vehicle: str, place: Place, found: Sequence[Alarm]) -> None:
        """Keep the alarms of a suspension in place of all that were kept of it before.

        Raises
        ------
        HistoryError
            If the store knows no trip of the suspension, or cannot be written.
        """
        with self._transaction() as connection:
            one = self._id(connection, vehicle, place)
            connection.execute(alarms.delete().where(alarms.c.suspension_id == one))
            upsert(connection, alarms, [_row(one, alarm) for alarm in found])

    def alarms(self, vehicle: str, place: Place) -> list[Alarm]:
        """Return the alarms of a suspension, open or not, by the mileage where they begin."""
        with self._transaction() as connection:
            return _kept(connection, alarms, Alarm, _is(vehicle, place)).get((vehicle, place), [])

    def all_alarms(self) -> dict[Key, list[Alarm]]:
        """Return the alarms of each suspension that has any."""
        with self._transaction() as connection:
            return _kept(connection, alarms, Alarm)

    def acknowledge(self, vehicle: str, place: Place, seen: Sequence[Acknowledgement]) -> None:
        """Keep acknowledgements of alarms, for ever; the same one again replaces its words.

        Raises
        ------
        HistoryError
            If the store knows no trip of the suspension, or cannot be written.
        """
        with self._transaction() as connection:
            one = self._id(connection, vehicle, place)
            upsert(connection, acknowledgements, [_row(one, part) for part in seen])

    def acknowledgements(self, vehicle: str, place: Place) -> list[Acknowledgement]:
        """Return the acknowledgements of a suspension's alarms, by mileage and time."""
        with self._transaction() as connection:
            found = _kept(connection, acknowledgements, Acknowledgement, _is(vehicle, place))
        return found.get((vehicle, place), [])

    def all_acknowledgements(self) -> dict[Key, list[Acknowledgement]]:
        """Return the acknowledgements of each suspension that has any."""
        with self._transaction() as connection:
            return _kept(connection, acknowledgements, Acknowledgement)

    @contextmanager
    def _transaction(self) -> Iterator[Connection]:
        """Give a connection whose changes are kept together at the end, or not at all."""
        try:
            with self._engine.begin() as connection:
                yield connection
        except DBAPIError as error:
            words = str(error.orig).strip().splitlines()[0]
            raise HistoryError(f"{self}: the store cannot be used ({words})") from None
        except SQLAlchemyError as error:
            raise HistoryError(f"{self}: the store cannot be used ({error})") from None

    def _id(self, connection: Connection, vehicle: str, place: Place) -> int:
        """Return the number of a suspension that is known, for this transaction's writing alone."""
        chosen = sql.select(suspensions.c.id).where(_is(vehicle, place)).with_for_update()
        one = connection.execute(chosen).scalar()
        if one is None:
            known = "; ".join(f"{vehicle}: {one}" for vehicle, one in _places(connection))
            raise HistoryError(
                f"{self}: no trip of {vehicle}: {place} is kept here; known: {known or 'none'}"
            )
        return int(one)


def _is(vehicle: str, place: Place) -> sql.ColumnElement[bool]:
    """Return the condition that a row is of a suspension."""
    wanted = asdict(place) | {"vehicle": vehicle}
    return sql.and_(*(suspensions.c[name] == value for name, value in wanted.items()))


def _ids(connection: Connection, keys: Iterable[Key]) -> dict[Key, int]:
    """Return the number of each suspension; new ones are added."""
    wanted = list(dict.fromkeys(keys))
    upsert(connection, suspensions, [{"vehicle": name} | asdict(place) for name, place in wanted])
    chosen = (sql.select(suspensions.c.id).where(_is(*key)) for key in wanted)
    found = (connection.execute(one).scalar_one() for one in chosen)
    return dict(zip(wanted, map(int, found), strict=True))


def _places(connection: Connection) -> list[Key]:
    """Return vehicle and place of each suspension, sorted."""
    rows = connection.execute(sql.select(suspensions)).mappings()
    return sorted((key_of(row) for row in rows), key=lambda one: (one[0], str(one[1])))


def _kept(
    connection: Connection,
    table: sql.Table,
    kind: type[Kept],
    where: sql.ColumnElement[bool] | None = None,
) -> dict[Key, list[Kept]]:
    """Return what a table holds of each suspension, or of those chosen, in order of its key."""
    names = [one.name for one in fields(kind)]
    chosen = (
        sql.select(suspensions, *(table.c[name] for name in names))
        .join_from(table, suspensions)
        .where(sql.true() if where is None else where)
        .order_by(*table.primary_key.columns)
    )
    found: dict[Key, list[Kept]] = {}
    for row in connection.execute(chosen).mappings():
        values: dict[str, Any] = {
            name: math.nan if row[name] is None else row[name] for name in names
        }
        found.setdefault(key_of(row), []).append(kind(**values))
    return found


def _row(suspension: int, kept: Event | Alarm | Acknowledgement) -> dict[str, Any]:
    """Return the row of what is kept of a suspension beside its trips."""
    values = {name: or_null(value) for name, value in asdict(kept).items()}
    return values | {"suspension_id": suspension}
