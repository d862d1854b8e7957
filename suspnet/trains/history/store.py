"""The store of a fleet's history: an SQLite file, or a PostgreSQL server by its URL."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import sqlalchemy as sql
from sqlalchemy.engine import Connection, Engine
from sqlalchemy.exc import SQLAlchemyError

from suspnet.ground.findings import at
from suspnet.ground.records import Key, Place, TripResult
from suspnet.trains.history.arrays import (
    Reference,
    TripResponses,
    comparable,
    read_responses,
    read_series,
    write_curves,
)
from suspnet.trains.history.database import (
    WAIT_S,
    HistoryError,
    check_file,
    connect,
    database_url,
    error_of,
    prepare,
    reading,
    upsert,
    version_of,
)
from suspnet.trains.history.outbox import Outbox
from suspnet.trains.history.schema import (
    SCHEMA,
    BadRow,
    log_once,
    row_of,
    trips,
    undated_key,
)
from suspnet.trains.history.suspensions import (
    Stored,
    add_suspensions,
    count_trips,
    delete_trips,
    is_of,
    known_suspensions,
    numbers_of,
    places_of,
    raise_revisions,
    read_stored,
    read_trips,
    replace_alarms,
    write_stored,
)
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm
from suspnet.trains.maintenance.series import Event, Series


class History:
    """Trips of all suspensions with their estimates and alarms, maintenance and acknowledgements.

    Several programs may read and write concurrently. A missing or empty file becomes a new store;
    any other file is refused and left unchanged. Each call that writes is atomic. All methods raise
    ``HistoryError`` if the store cannot be used; methods that write also raise it if no trip of the
    suspension is stored. Unreadable rows are left out and collected in `bad_rows`.

    Parameters
    ----------
    place : str or Path
        A file (SQLite), or a URL such as "postgresql://user:password@host/database".
    wait_s : float, [s]
        Longest time that a transaction waits for other programs.
    must_exist : bool
        Whether a missing or empty store is refused.
    """

    def __init__(
        self, place: str | Path, *, wait_s: float = WAIT_S, must_exist: bool = False
    ) -> None:
        self.bad_rows: list[BadRow] = []
        self._url = database_url(place)
        self._engine = connect(self._url, wait_s, must_exist=must_exist)
        try:
            with self._reading() as connection:
                version = version_of(connection, str(self))
            if version != SCHEMA:
                if must_exist and version is None:
                    raise HistoryError(at(self, "store-empty"))
                with self._writing() as connection:
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
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections to the file or server."""
        self._engine.dispose()

    def outbox(self) -> Outbox:
        """Return the messages about alarms, waiting and sent."""
        return Outbox(self._reading, self._writing, self.bad_rows)

    def check(self) -> None:
        """Raise HistoryError if an SQLite file is damaged; a server is not checked."""
        if self._url.get_backend_name() == "sqlite":
            with self._reading() as connection:
                check_file(connection, str(self))

    def places(self) -> list[Key]:
        """Return vehicle and place of each suspension, sorted."""
        with self._reading() as connection:
            return places_of(connection, self.bad_rows)

    def revisions(self) -> dict[Key, int]:
        """Return the revision of each suspension, a number that grows with each change of its data.

        Data are its trips, maintenance, alarms and acknowledgements. Data read after this call are
        of these revisions or later ones.
        """
        with self._reading() as connection:
            return dict(known_suspensions(connection, bad=self.bad_rows).values())

    def write(self, results: Sequence[TripResult]) -> None:
        """Store trips; those that exist already are replaced.

        A stored trip without a start is replaced by one of the same name and mileage with a start.
        Curves are stored of the first trip of each suspension that has any, and of the ``N_NEWEST``
        newest trips; overviews of the signals are not stored.
        """
        with self._writing() as connection:
            ids = add_suspensions(connection, ((r.vehicle, r.place) for r in results))
            # first, as this locks the suspensions in an order that avoids deadlocks
            raise_revisions(connection, ids.values())
            rows = [row_of(ids[r.vehicle, r.place], r) for r in results]
            dated = [r for r in results if r.start]
            delete_trips(connection, [(ids[r.vehicle, r.place], undated_key(r)) for r in dated])
            upsert(connection, trips, rows)
            of_each: dict[int, dict[bytes, TripResult]] = {}
            for row, result in zip(rows, results, strict=True):
                of_each.setdefault(row["suspension_id"], {})[row["key"]] = result
            for number, own in of_each.items():
                write_curves(connection, number, own)

    def read(self, vehicle: str, place: Place) -> list[TripResult]:
        """Return the trips of a suspension by mileage; empty if there are none."""
        with self._reading() as connection:
            return read_trips(connection, vehicle, place, self.bad_rows)

    def series(self, keys: Iterable[Key] | None = None) -> list[Series]:
        """Return the trips of all suspensions as arrays, sorted by vehicle and place.

        This is far quicker than ``read``, for a view of the whole fleet. `keys` selects
        suspensions; unknown ones are left out.
        """
        with self._reading() as connection:
            return read_series(connection, self.bad_rows, None if keys is None else set(keys))

    def comparable(
        self,
        vehicle: str,
        place: Place,
        references: Sequence[Reference],
        results: Sequence[TripResult] = (),
    ) -> tuple[Series | None, int]:
        """Return the trips of a suspension that are relative to one of some healthy states.

        None is returned if there is no such trip. The second value is the number of trips that are
        relative to another healthy state. Trips without an estimate are included, and those of
        `results`, which have just been stored. If one of these has no start, others of its name and
        mileage are the same trip and left out.
        """
        of = is_of(vehicle, place)
        fitting, others = comparable(references, results)
        with self._reading() as connection:
            several = read_series(connection, self.bad_rows, {(vehicle, place)}, fitting)
            return next(iter(several), None), count_trips(connection, of, others)

    def comparable_trips(
        self,
        vehicle: str,
        place: Place,
        references: Sequence[Reference],
        results: Sequence[TripResult] = (),
    ) -> tuple[list[TripResult], int]:
        """Return what ``comparable`` does, but the trips with all that is stored of them."""
        of = is_of(vehicle, place)
        fitting, others = comparable(references, results)
        with self._reading() as connection:
            found = read_trips(connection, vehicle, place, self.bad_rows, fitting)
            return found, count_trips(connection, of, others)

    def responses(self, vehicle: str, place: Place) -> list[TripResponses]:
        """Return the stored transfer functions of a suspension by mileage.

        They are those of the first trip that had any, and of the newest trips. HistoryError is also
        raised if they were altered.
        """
        where = is_of(vehicle, place)
        with self._reading() as connection:
            return read_responses(connection, where, f"{self}: {vehicle}: {place}")

    def add_event(self, vehicle: str, place: Place, event: Event) -> None:
        """Store a maintenance event; the text of an existing one is replaced."""
        self._store(vehicle, place, [event])

    def events(self, vehicle: str, place: Place) -> list[Event]:
        """Return the maintenance events of a suspension by mileage."""
        return self._read(Event, is_of(vehicle, place)).get((vehicle, place), [])

    def keep_alarms(self, vehicle: str, place: Place, alarms: Sequence[Alarm]) -> None:
        """Replace the stored alarms of a suspension."""
        self.keep_all_alarms({(vehicle, place): alarms})

    def keep_all_alarms(self, alarms: Mapping[Key, Sequence[Alarm]]) -> None:
        """Replace the stored alarms of suspensions; those with the same alarms are not written."""
        with self._writing() as connection:
            ids = numbers_of(connection, alarms, str(self))
            replace_alarms(connection, {number: alarms[key] for key, number in ids.items()})

    def alarms(self, vehicle: str, place: Place) -> list[Alarm]:
        """Return the alarms of a suspension, active or cleared, by the mileage where they start."""
        return self._read(Alarm, is_of(vehicle, place)).get((vehicle, place), [])

    def all_alarms(self) -> dict[Key, list[Alarm]]:
        """Return the alarms of each suspension that has any."""
        return self._read(Alarm)

    def acknowledge(self, vehicle: str, place: Place, seen: Sequence[Acknowledgement]) -> None:
        """Store acknowledgements of alarms; the text of an existing one is replaced."""
        self._store(vehicle, place, seen)

    def acknowledgements(self, vehicle: str, place: Place) -> list[Acknowledgement]:
        """Return the acknowledgements of a suspension's alarms by mileage and time."""
        return self._read(Acknowledgement, is_of(vehicle, place)).get((vehicle, place), [])

    def all_acknowledgements(self) -> dict[Key, list[Acknowledgement]]:
        """Return the acknowledgements of each suspension that has any."""
        return self._read(Acknowledgement)

    def _read(
        self, kind: type[Stored], where: sql.ColumnElement[bool] | None = None
    ) -> dict[Key, list[Stored]]:
        with self._reading() as connection:
            return read_stored(connection, kind, self.bad_rows, where)

    def _store(
        self, vehicle: str, place: Place, kept: Sequence[Event] | Sequence[Acknowledgement]
    ) -> None:
        with self._writing() as connection:
            ids = list(numbers_of(connection, [(vehicle, place)], str(self)).values())
            raise_revisions(connection, ids)
            write_stored(connection, ids[0], kept)

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        """Yield a connection that sees one snapshot of the store and blocks no writer."""
        with self._transaction(reading(self._engine)) as connection:
            yield connection
        self.bad_rows[:] = dict.fromkeys(self.bad_rows)  # a program that polls finds them often
        log_once(str(self), self.bad_rows)

    def _writing(self) -> AbstractContextManager[Connection]:
        """Return a connection whose changes are committed together at the end, or not at all."""
        return self._transaction(self._engine)

    @contextmanager
    def _transaction(self, engine: Engine) -> Iterator[Connection]:
        try:
            with engine.begin() as connection:
                yield connection
        except (SQLAlchemyError, UnicodeDecodeError) as error:  # damaged names of tables
            raise error_of(error, str(self)) from None


def acknowledge_alarms(
    store: History,
    vehicle: str,
    place: Place,
    alarms: Sequence[Alarm],
    at_km: float,
    by: str,
    words: str = "",
) -> list[Acknowledgement]:
    """Store that a person acknowledges alarms of a suspension now, and return what is stored.

    `alarms` are as the person saw them: they need another acknowledgement if they get worse.
    `at_km` is the mileage of the newest trip, `by` the name of the person. ValueError is raised if
    one of these is missing.
    """
    now = datetime.now(UTC).isoformat(timespec="seconds")
    seen = [
        Acknowledgement(alarm.parameter, alarm.cause, alarm.severity, at_km, by, now, words)
        for alarm in alarms
    ]
    store.acknowledge(vehicle, place, seen)
    return seen
