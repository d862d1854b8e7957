"""The store of a fleet's history: an SQLite file, or a PostgreSQL server by its URL."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, astuple
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from sqlalchemy.engine import Connection, Engine
from sqlalchemy.exc import SQLAlchemyError

from suspnet.ground.findings import at
from suspnet.ground.records import MOST_NAME, OK, Commissioning, Key, Place, TripResult, from_row
from suspnet.trains.history import arrays, database
from suspnet.trains.history.outbox import Outbox
from suspnet.trains.history.schema import (
    TABLES,
    BadRow,
    Condition,
    Stored,
    alarms,
    bad_row,
    check_types,
    is_of,
    is_one_of,
    known_suspensions,
    log_once,
    read_stored,
    row_of,
    row_of_stored,
    suspensions,
    trips,
    undated_key,
)
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm
from suspnet.trains.maintenance.series import Event, Series

TRIP_COLUMNS = [column for column in trips.columns if column.name != "key"]


class History(AbstractContextManager["History"]):
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
        self, place: str | Path, *, wait_s: float = database.WAIT_S, must_exist: bool = False
    ) -> None:
        self.bad_rows: list[BadRow] = []
        self._url = database.database_url(place)
        self._engine = database.connect(self._url, wait_s, must_exist=must_exist)
        try:
            with self._reading() as connection:
                is_empty = not database.has_tables(connection, str(self))
            if is_empty:
                if must_exist:
                    raise database.HistoryError(at(self, "store-empty"))
                with self._writing() as connection:
                    database.prepare(connection, str(self))
        except BaseException:
            self.close()
            raise

    def __str__(self) -> str:
        """Return where the store is, without a password."""
        if self._url.get_backend_name() == "sqlite":
            return str(self._url.database)
        return self._url.render_as_string(hide_password=True)

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
                words = connection.exec_driver_sql("PRAGMA quick_check(1)").scalar()
            if words != "ok":
                raise database.HistoryError(
                    database.DAMAGED.format(name=self, words=" ".join(str(words).split()))
                )

    def places(self) -> list[Key]:
        """Return vehicle and place of each suspension, sorted."""
        return sorted(self.revisions(), key=lambda key: (key[0], str(key[1])))

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
            ids = _add_suspensions(connection, [(r.vehicle, r.place) for r in results])
            # first, as this locks the suspensions in an order that avoids deadlocks
            _raise_revisions(connection, ids.values())
            rows = [row_of(ids[r.vehicle, r.place], r) for r in results]
            undated = [
                {"of": ids[r.vehicle, r.place], "gone": undated_key(r)} for r in results if r.start
            ]
            if undated:
                is_of_suspension = trips.c.suspension_id == sql.bindparam("of")
                gone = trips.delete().where(is_of_suspension, trips.c.key == sql.bindparam("gone"))
                connection.execute(gone, sorted(undated, key=lambda row: (row["of"], row["gone"])))
            database.upsert(connection, trips, rows)
            of_each: dict[int, dict[bytes, TripResult]] = {}
            for row, result in zip(rows, results, strict=True):
                of_each.setdefault(row["suspension_id"], {})[row["key"]] = result
            for number, of_suspension in of_each.items():
                arrays.write_curves(connection, number, of_suspension)

    def read(self, vehicle: str, place: Place) -> list[TripResult]:
        """Return the trips of a suspension by mileage; empty if there are none."""
        return self._trips((vehicle, place), sql.select(*TRIP_COLUMNS))

    def last_before(self, result: TripResult, n: int) -> list[TripResult]:
        """Return the last `n` trips of its suspension that have an estimate, before a trip."""
        chosen = sql.select(*TRIP_COLUMNS).order_by(trips.c.mileage_km.desc()).limit(n)
        is_before = sql.and_(trips.c.status == OK, trips.c.mileage_km < result.mileage_km)
        return self._trips((result.vehicle, result.place), chosen.where(is_before))

    def _trips(self, key: Key, chosen: sql.Select[Any]) -> list[TripResult]:
        results = []
        with self._reading() as connection:
            of_suspension = chosen.join(suspensions).where(is_of(*key))
            for row in connection.execute(of_suspension).mappings():
                try:
                    check_types(trips, row)
                    results.append(from_row({"vehicle": key[0], **vars(key[1]), **row}))
                except ValueError as error:
                    self.bad_rows.append(bad_row(trips, row, error, key))
        return sorted(results, key=lambda r: (math.isnan(r.mileage_km), r.mileage_km, r.trip))

    def series(self, keys: Iterable[Key] | None = None) -> list[Series]:
        """Return the trips of all suspensions as arrays, sorted by vehicle and place.

        This is far quicker than ``read``, for a view of the whole fleet. `keys` selects
        suspensions; unknown ones are left out.
        """
        with self._reading() as connection:
            return arrays.read_series(
                connection, self.bad_rows, None if keys is None else set(keys)
            )

    def comparable(
        self,
        vehicle: str,
        place: Place,
        references: Sequence[Commissioning],
        results: Sequence[TripResult] = (),
    ) -> tuple[Series | None, int]:
        """Return the trips of a suspension that are relative to one of some healthy states.

        None is returned if there is no such trip. The second value is the number of trips that are
        relative to another healthy state. Trips without an estimate are included, and those of
        `results`, which have just been stored. If one of these has no start, others of its name and
        mileage are the same trip and left out.
        """
        fitting, others = arrays.comparable(references, results)
        counted = sql.select(sql.func.count(trips.c.id)).join(suspensions)
        count = counted.where(is_of(vehicle, place), others)
        with self._reading() as connection:
            several = arrays.read_series(connection, self.bad_rows, {(vehicle, place)}, fitting)
            return next(iter(several), None), int(connection.execute(count).scalar_one())

    def responses(self, vehicle: str, place: Place) -> list[arrays.TripResponses]:
        """Return the stored transfer functions of a suspension by mileage.

        They are those of the first trip that had any, and of the newest trips. HistoryError is also
        raised if they were altered.
        """
        where = is_of(vehicle, place)
        with self._reading() as connection:
            return arrays.read_responses(connection, where, f"{self}: {vehicle}: {place}")

    def add_event(self, vehicle: str, place: Place, event: Event) -> None:
        """Store a maintenance event; the text of an existing one is replaced."""
        self._store(vehicle, place, [event])

    def events(self, vehicle: str, place: Place) -> list[Event]:
        """Return the maintenance events of a suspension by mileage."""
        return self._read(Event, is_of(vehicle, place)).get((vehicle, place), [])

    def keep_alarms(self, vehicle: str, place: Place, new_alarms: Sequence[Alarm]) -> None:
        """Replace the stored alarms of a suspension."""
        self.keep_all_alarms({(vehicle, place): new_alarms})

    def keep_all_alarms(self, of_each: Mapping[Key, Sequence[Alarm]]) -> None:
        """Replace the stored alarms of suspensions; those with the same alarms are not written."""
        with self._writing() as connection:
            ids = self._numbers(connection, of_each)
            before: dict[int, list[dict[str, Any]]] = {number: [] for number in ids.values()}
            chosen = sql.select(alarms).where(is_one_of(alarms.c.suspension_id, before))
            for row in connection.execute(chosen).mappings():
                before[row["suspension_id"]].append(dict(row))
            rows = {
                number: [row_of_stored(number, alarm) for alarm in of_each[key]]
                for key, number in ids.items()
            }
            changed = [n for n, new in rows.items() if _by_key(new) != _by_key(before[n])]
            _raise_revisions(connection, changed)
            connection.execute(alarms.delete().where(is_one_of(alarms.c.suspension_id, changed)))
            database.upsert(connection, alarms, [row for number in changed for row in rows[number]])

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

    def _read(self, kind: type[Stored], where: Condition | None = None) -> dict[Key, list[Stored]]:
        with self._reading() as connection:
            return read_stored(connection, kind, self.bad_rows, where)

    def _store(
        self, vehicle: str, place: Place, entries: Sequence[Event] | Sequence[Acknowledgement]
    ) -> None:
        with self._writing() as connection:
            (number,) = self._numbers(connection, [(vehicle, place)]).values()
            _raise_revisions(connection, [number])
            if entries:
                rows = [row_of_stored(number, entry) for entry in entries]
                database.upsert(connection, TABLES[type(entries[0])], rows)

    def _numbers(self, connection: Connection, keys: Iterable[Key]) -> dict[Key, int]:
        """Return the number of each suspension; HistoryError if one is unknown."""
        numbers = {key: number for number, (key, _) in known_suspensions(connection).items()}
        names = sorted(f"{vehicle}: {place}" for vehicle, place in numbers) or ["none"]
        for vehicle, place in (wanted := list(keys)):
            if (vehicle, place) not in numbers:
                raise database.HistoryError(
                    f"{self}: no trip of {vehicle}: {place} is stored here; known: "
                    f"{'; '.join(names)}"
                )
        return {key: numbers[key] for key in wanted}

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        """Yield a connection that sees one snapshot of the store and blocks no writer."""
        with self._transaction(database.reading(self._engine)) as connection:
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
            raise database.error_of(error, str(self)) from None


def _add_suspensions(connection: Connection, keys: Iterable[Key]) -> dict[Key, int]:
    """Return the number of each suspension; new ones are added, ValueError if a name is long."""
    wanted = list(dict.fromkeys(keys))
    for name in (text for vehicle, place in wanted for text in (vehicle, *astuple(place))):
        if len(name) > MOST_NAME:
            raise ValueError(
                f"a name must have at most {MOST_NAME} characters, got {name[:20]!r}..."
            )
    database.upsert(
        connection, suspensions, [{"vehicle": name} | asdict(place) for name, place in wanted]
    )
    chosen = {key: sql.select(suspensions.c.id).where(is_of(*key)) for key in wanted}
    return {key: int(connection.execute(query).scalar_one()) for key, query in chosen.items()}


def _raise_revisions(connection: Connection, ids: Iterable[int]) -> None:
    """Increment the revisions of suspensions, and lock them until the transaction ends.

    A transaction that changes suspensions starts with this. They are locked in order of their
    numbers, so that writers do not deadlock.
    """
    rows = [{"number": number} for number in sorted(set(ids))]
    if rows:
        update = suspensions.update().where(suspensions.c.id == sql.bindparam("number"))
        connection.execute(update.values(revision=suspensions.c.revision + 1), rows)


def _by_key(rows: Iterable[dict[str, Any]]) -> dict[tuple[Any, ...], dict[str, Any]]:
    names = [column.name for column in alarms.primary_key.columns]
    return {tuple(row[name] for name in names): row for row in rows}


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
