"""The store of a fleet's history: an SQLite file, or a PostgreSQL server by its URL."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine, RowMapping, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError, SQLAlchemyError

from suspnet.history.records import Quality, TripResult
from suspnet.history.schema import (
    NUMBERS,
    PLACE,
    SCHEMA,
    TEXTS,
    VALUES,
    estimates,
    events,
    metadata,
    suspensions,
    trips,
    versions,
)
from suspnet.recordings.manifest import Place

KINDS = ("exchanged", "reprofiled", "other")
"""Kinds of maintenance: a part exchanged, wheels reprofiled, or what the words say."""
WAIT_S = 60
"""Time that a writer waits for another one, [s]."""
LOCK = 0x73757370
"""Number of the lock of PostgreSQL under which the tables are made."""


class HistoryError(ValueError):
    """The store cannot be used: another file, another version, a server that does not answer."""


@dataclass(frozen=True)
class Event:
    """Maintenance of a suspension: what trips show from then on starts anew.

    Attributes
    ----------
    mileage_km : float, [km]
        The first trips of this mileage or more are after it.
    kind : str
        One of ``KINDS``.
    words : str
        What was done.
    """

    mileage_km: float
    kind: str = "other"
    words: str = ""

    def __post_init__(self) -> None:
        if not math.isfinite(self.mileage_km):
            raise ValueError(f"an event needs a mileage in km, got {self.mileage_km}")
        if self.kind not in KINDS:
            raise ValueError(f"an event is one of {', '.join(KINDS)}, got {self.kind!r}")

    def __str__(self) -> str:
        """Return the event in words."""
        km = f"{self.mileage_km:,.0f}".replace(",", " ")
        return f"{self.kind if not self.words else self.words} at {km} km"


class History:
    """Trips of all suspensions, their estimates, and maintenance events.

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
        self._url = _url(place)
        self._engine = _engine(self._url)
        try:
            with self._transaction() as connection:
                self._check(connection)
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

    def places(self) -> list[tuple[str, Place]]:
        """Return vehicle and place of each suspension, sorted."""
        with self._transaction() as connection:
            return self._places(connection)

    def write(self, results: Sequence[TripResult]) -> None:
        """Keep trips, all or none. One that is there already is replaced by what was read last.

        Their curves are not kept.

        Raises
        ------
        HistoryError
            If the store cannot be written.
        """
        with self._transaction() as connection:
            ids = {
                key: self._suspension(connection, *key)
                for key in dict.fromkeys((result.vehicle, result.place) for result in results)
            }
            for result in results:
                self._write(connection, ids[result.vehicle, result.place], result)

    def read(self, vehicle: str, place: Place) -> list[TripResult]:
        """Return the trips of a suspension, by mileage; empty if there is none."""
        chosen = sql.select(trips).join(suspensions).where(_is(vehicle, place))
        with self._transaction() as connection:
            rows = connection.execute(chosen).mappings().all()
            ids = chosen.with_only_columns(trips.c.id)
            numbers = connection.execute(
                sql.select(estimates).where(estimates.c.trip_id.in_(ids))
            ).mappings()
            by_trip: dict[int, list[RowMapping]] = {}
            for number in numbers:
                by_trip.setdefault(number["trip_id"], []).append(number)
        found = [_result(vehicle, place, row, by_trip.get(row["id"], [])) for row in rows]
        return sorted(found, key=lambda r: (math.isnan(r.mileage_km), r.mileage_km, r.trip))

    def add_event(self, vehicle: str, place: Place, event: Event) -> None:
        """Keep a maintenance event; the same one again replaces its words.

        Raises
        ------
        HistoryError
            If the store knows no trip of the suspension, or cannot be written.
        """
        with self._transaction() as connection:
            chosen = connection.execute(
                sql.select(suspensions.c.id).where(_is(vehicle, place))
            ).scalar()
            if chosen is None:
                known = "; ".join(f"{vehicle}: {one}" for vehicle, one in self._places(connection))
                raise HistoryError(
                    f"{self}: no trip of {vehicle}: {place} is kept here; known: {known or 'none'}"
                )
            row = asdict(event) | {"suspension_id": chosen}
            self._upsert(connection, events, [row], ("suspension_id", "mileage_km", "kind"))

    def events(self, vehicle: str, place: Place) -> list[Event]:
        """Return the maintenance events of a suspension, by mileage."""
        chosen = (
            sql.select(events.c.mileage_km, events.c.kind, events.c.words)
            .join(suspensions)
            .where(_is(vehicle, place))
            .order_by(events.c.mileage_km, events.c.kind)
        )
        with self._transaction() as connection:
            return [Event(**row) for row in connection.execute(chosen).mappings()]

    @staticmethod
    def _places(connection: Connection) -> list[tuple[str, Place]]:
        """Return vehicle and place of each suspension, sorted."""
        rows = connection.execute(sql.select(suspensions)).mappings()
        found = [(row["vehicle"], Place(**{key: row[key] for key in PLACE})) for row in rows]
        return sorted(found, key=lambda one: (one[0], str(one[1])))

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

    def _check(self, connection: Connection) -> None:
        """Make the tables where there are none; HistoryError if they are of another version."""
        if connection.dialect.name == "postgresql":  # two programs may be the first at once
            connection.execute(sql.select(sql.func.pg_advisory_xact_lock(LOCK)))
        there = set(sql.inspect(connection).get_table_names())
        if versions.name not in there:
            if there & set(metadata.tables):
                raise HistoryError(f"{self}: this is no store of suspnet, but has tables like it")
            metadata.create_all(connection)
            connection.execute(versions.insert().values(schema=SCHEMA))
            return
        version = connection.execute(sql.select(versions.c.schema)).scalar()
        if version != SCHEMA:
            raise HistoryError(
                f"{self}: a store of version {version}, this suspnet reads version {SCHEMA}; use "
                "the suspnet that wrote it, or begin a new store and evaluate the trips again"
            )

    def _suspension(self, connection: Connection, vehicle: str, place: Place) -> int:
        """Return the number of a suspension, which is added if it is new."""
        row = {"vehicle": vehicle} | asdict(place)
        self._upsert(connection, suspensions, [row], ("vehicle", *PLACE))
        chosen = sql.select(suspensions.c.id).where(_is(vehicle, place))
        return int(connection.execute(chosen).scalar_one())

    def _write(self, connection: Connection, suspension: int, result: TripResult) -> None:
        """Keep one trip."""
        row = {name: getattr(result, name) for name in TEXTS}
        row |= {name: _known(getattr(result, name)) for name in NUMBERS}
        row |= {"suspension_id": suspension, "key": trip_key(result)}
        row |= {"quality": {k: _known(v) for k, v in asdict(result.quality).items()}}
        self._upsert(connection, trips, [row], ("suspension_id", "key"))
        where = (trips.c.suspension_id == suspension) & (trips.c.key == row["key"])
        trip = connection.execute(sql.select(trips.c.id).where(where)).scalar_one()
        connection.execute(estimates.delete().where(estimates.c.trip_id == trip))
        values = {name: getattr(result, name) for name in VALUES}
        parameters = dict.fromkeys(p for part in values.values() for p in part)
        rows = [
            {"trip_id": trip, "parameter": parameter}
            | {name: _known(part.get(parameter, math.nan)) for name, part in values.items()}
            for parameter in parameters
        ]
        if rows:
            connection.execute(estimates.insert(), rows)

    @staticmethod
    def _upsert(
        connection: Connection, table: sql.Table, rows: list[dict[str, Any]], key: Sequence[str]
    ) -> None:
        """Insert rows; one whose key is there already takes its other values."""
        dialect = postgresql if connection.dialect.name == "postgresql" else sqlite
        statement = dialect.insert(table)
        others = {name: statement.excluded[name] for name in rows[0] if name not in key}
        if others:
            statement = statement.on_conflict_do_update(index_elements=key, set_=others)
        else:
            statement = statement.on_conflict_do_nothing(index_elements=key)
        connection.execute(statement, rows)


def _url(place: str | Path) -> URL:
    """Return the URL of a store that is named by a file or a URL."""
    text = str(place)
    if "://" not in text:
        return URL.create("sqlite", database=text)
    try:
        url = make_url(text)
    except ArgumentError:
        raise HistoryError(f"{text!r} is no URL of a database") from None
    if url.drivername in ("postgresql", "postgres"):
        url = url.set(drivername="postgresql+psycopg")
    if url.get_backend_name() not in ("sqlite", "postgresql"):
        raise HistoryError(
            f"a store is a file or postgresql://user:password@host/database, not "
            f"{url.drivername}://"
        )
    return url


def _engine(url: URL) -> Engine:
    """Return the engine of a store; SQLite waits for other writers from the first statement on."""
    if url.get_backend_name() == "postgresql":
        try:
            return sql.create_engine(url, pool_size=1)
        except (ImportError, NoSuchModuleError):
            raise HistoryError(
                'PostgreSQL needs its driver: pip install "suspnet[postgres]"'
            ) from None
    if not url.database or url.database == ":memory:":
        raise HistoryError("a store needs the path of a file")
    folder = Path(url.database).absolute().parent
    if not folder.is_dir():
        raise HistoryError(f"{url.database}: there is no folder {folder}")
    engine = sql.create_engine(url, connect_args={"timeout": WAIT_S})

    @sql.event.listens_for(engine, "connect")
    def _connected(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # transactions are begun below, not by the driver
        connection.execute("PRAGMA foreign_keys = ON")

    @sql.event.listens_for(engine, "begin")
    def _begun(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    return engine


def _is(vehicle: str, place: Place) -> sql.ColumnElement[bool]:
    """Return the condition that a row is of a suspension."""
    wanted = asdict(place) | {"vehicle": vehicle}
    return sql.and_(*(suspensions.c[name] == value for name, value in wanted.items()))


def trip_key(result: TripResult) -> str:
    """Return what tells a trip from the others of its suspension: a hash of 64 letters."""
    content = [result.trip, result.start, repr(float(result.mileage_km))]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _known(value: Any) -> Any:
    """Return a value, None in place of NaN."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _number(value: float | None) -> float:
    """Return a number of the store, NaN in place of NULL."""
    return math.nan if value is None else float(value)


def _result(
    vehicle: str, place: Place, row: RowMapping, numbers: Sequence[RowMapping]
) -> TripResult:
    """Return the trip of a row."""
    fields: dict[str, Any] = {name: row[name] for name in TEXTS}
    fields |= {name: _number(row[name]) for name in NUMBERS}
    for name in VALUES:
        known = [one for one in numbers if one[name] is not None]
        fields[name] = {one["parameter"]: float(one[name]) for one in known}
    quality: dict[str, Any] = {k: _number(v) if v is None else v for k, v in row["quality"].items()}
    return TripResult(vehicle=vehicle, place=place, quality=Quality(**quality), **fields)
