"""Tables of the history, the same in SQLite and PostgreSQL, and unreadable rows.

A trip is identified by its suspension and its key: a hash of name, start and mileage. A trip that
was stored without its start is replaced once that is known. NaN is stored as NULL. The columns for
a view of the whole fleet come first, because SQLite reads a row only up to the last one needed.
"""

import hashlib
import json
import logging
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, TypeVar

import sqlalchemy as sql
from sqlalchemy import Column, Double, Integer, LargeBinary, String, Table
from sqlalchemy.engine import Connection, RowMapping

from suspnet.ground import records
from suspnet.ground.findings import Finding, restored, stored
from suspnet.ground.parameters import ESTIMATED
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm
from suspnet.trains.maintenance.series import Event

log = logging.getLogger(__name__)
MOST_LOGGED = 1000
"""Largest number of bad rows that are logged, so that a damaged store does not fill the disk."""
_LOGGED: set[str] = set()
"""Bad rows that this process has logged: a program that polls a store reads them often."""
KINDS: dict[type, Any] = {sql.String: str, sql.Double: (int, float), sql.Integer: int}
"""Python types of values by column type; SQLite itself accepts any value in any column."""
SCHEMA = 12  # version of the tables; a store of any other is refused

metadata = sql.MetaData()
Kind = type[sql.types.TypeEngine[Any]]
Condition = sql.ColumnElement[bool]


def _key(**kinds: Kind) -> list[Column[Any]]:
    return [Column(name, kind, primary_key=True) for name, kind in kinds.items()]


def _needed(**kinds: Kind) -> list[Column[Any]]:
    return [Column(name, kind, nullable=False) for name, kind in kinds.items()]


def _suspension(**options: Any) -> Column[Any]:
    return Column("suspension_id", sql.ForeignKey("suspensions.id", ondelete="CASCADE"), **options)


versions = Table("suspnet_version", metadata, *_key(schema=Integer))

suspensions = Table(
    "suspensions",
    metadata,
    *_key(id=Integer),
    *_needed(vehicle=String, **dict.fromkeys(records.PLACE_FROM_TRAIN, String)),
    Column("revision", sql.BigInteger, nullable=False, server_default="0"),
    sql.UniqueConstraint("vehicle", *records.PLACE_FROM_TRAIN),
)
"""The revision grows with each transaction that changes data of the suspension."""

QUALITY = {"float": Double, "int": Integer, "str": String}
"""Column types of a trip's quality, by the types of its fields."""

trips = Table(
    "trips",
    metadata,
    *_key(id=Integer),
    _suspension(nullable=False),
    *(Column(name, Double) for name in records.NUMBERS),
    *(
        Column(column.format(name), Double)
        for column in records.VALUES.values()
        for name in ESTIMATED
    ),
    *_needed(**dict.fromkeys(records.TEXTS, String)),
    *(Column(name, QUALITY[kind]) for name, kind in records.QUALITY_TYPES.items()),
    Column("key", LargeBinary(16), nullable=False),
    sql.UniqueConstraint("suspension_id", "key"),
)

curves = Table(
    "curves",
    metadata,
    *_key(suspension_id=Integer),
    Column("key", LargeBinary(16), primary_key=True),
    *_needed(arrays=LargeBinary),
    Column("sha256", String(64), nullable=False),
    sql.ForeignKeyConstraint(
        ["suspension_id", "key"], ["trips.suspension_id", "trips.key"], ondelete="CASCADE"
    ),
)
"""Curves of some trips: arrays in the safetensors format, and the hash of these bytes."""

events = Table(
    "events",
    metadata,
    _suspension(primary_key=True),
    *_key(mileage_km=Double, kind=String),
    *_needed(words=String),
)

alarms = Table(
    "alarms",
    metadata,
    _suspension(primary_key=True),
    *_key(begin_km=Double, parameter=String, cause=String),
    *_needed(severity=Integer),
    Column("end_km", Double),
    *_needed(words=String),
)

acknowledgements = Table(
    "acknowledgements",
    metadata,
    _suspension(primary_key=True),
    *_key(at_km=Double, at=String, parameter=String, cause=String, by=String),
    *_needed(severity=Integer, words=String),
)

outbox = Table(
    "outbox",
    metadata,
    *_key(id=String),
    *_needed(recipient=String, channel=String, address=String, kind=String, content=String),
    *_needed(created_s=Double, due_s=Double, leased_s=Double, attempts=Integer),
    Column("sent_s", Double),
    *_needed(error=String),
)
"""Messages to people and systems, waiting or sent; times are seconds since 1970, UTC."""

told = Table(
    "told",
    metadata,
    *_key(recipient=String),
    _suspension(primary_key=True),
    *_key(parameter=String, cause=String),
    *_needed(severity=Integer, at_km=Double, is_open=Integer),
)
"""The last alarm of each parameter and cause that is in a message to a recipient, up to `at_km`."""


@dataclass(frozen=True)
class BadRow:
    """An unreadable row that is left out; `row` is its primary key, `key` its suspension."""

    table: str
    row: str
    why: str
    key: records.Key | None = None

    def __str__(self) -> str:
        of = "" if self.key is None else f" of {self.key[0]}: {self.key[1]}"
        return Finding("bad-row", table=self.table, row=self.row, of=of, why=self.why)


def bad_row(table: Table, row: RowMapping, error: object, key: records.Key | None = None) -> BadRow:
    """Return the description of a row that `error` makes unreadable."""
    names = [column.name for column in table.primary_key.columns if column.name in row]
    words = ", ".join(f"{name}={str(row[name])[:40]}" for name in names)
    return BadRow(table.name, words, " ".join(str(error).split())[:200], key)


def log_once(name: str, rows: Iterable[BadRow]) -> None:
    """Log the bad rows of the store `name` that this process has not logged yet."""
    for row in rows:
        words = f"{name}: {row}; it is left out: correct or delete it"
        if words not in _LOGGED and len(_LOGGED) < MOST_LOGGED:
            _LOGGED.add(words)
            log.warning("%s", words)


def check_types(table: sql.Table, row: RowMapping) -> None:
    """Raise ValueError if a value is not of the type of its column."""
    for name, value in row.items():
        column = table.columns.get(name)
        if column is None or (value is None and column.nullable):
            continue
        wanted = next((KINDS[kind] for kind in type(column.type).__mro__ if kind in KINDS), object)
        if not isinstance(value, wanted):
            raise ValueError(Finding("bad-value", name=name, value=repr(str(value)[:40])))


def trip_key(result: records.TripResult) -> bytes:
    """Return the key of a trip within its suspension, a hash of 16 bytes."""
    content = [result.trip, result.start, repr(float(result.mileage_km))]
    return hashlib.sha256(json.dumps(content).encode()).digest()[:16]


def undated_key(result: records.TripResult) -> bytes:
    """Return the key that the trip has if its start is unknown."""
    return trip_key(replace(result, start=""))


def row_of(suspension: int, result: records.TripResult) -> dict[str, Any]:
    """Return a trip as a row of the table."""
    row = {name: or_null(value) for name, value in records.to_row(result).items()}
    for name in ("vehicle", *records.PLACE):
        del row[name]  # columns of the suspensions
    return row | {"suspension_id": suspension, "key": trip_key(result)}


def or_null(value: Any) -> Any:
    """Return a value, with None for NaN; half widths may be infinite."""
    return None if isinstance(value, float) and math.isnan(value) else value


def key_of(row: RowMapping) -> records.Key:
    """Return vehicle and place of a suspension's row; ValueError if a value has a wrong type."""
    check_types(suspensions, row)
    return row["vehicle"], records.Place(**{name: row[name] for name in records.PLACE})


Stored = TypeVar("Stored", Event, Alarm, Acknowledgement)
TABLES: dict[type, sql.Table] = {Event: events, Alarm: alarms, Acknowledgement: acknowledgements}
"""Table of each stored class."""


def known_suspensions(
    connection: Connection, where: Condition | None = None, bad: list[BadRow] | None = None
) -> dict[int, tuple[records.Key, int]]:
    """Return key and revision of each suspension, or of those selected by `where`, by number.

    Unreadable rows are left out and appended to `bad`.
    """
    chosen = sql.select(suspensions).where(sql.true() if where is None else where)
    by_number = {}
    for row in connection.execute(chosen).mappings():
        try:
            by_number[int(row["id"])] = key_of(row), int(row["revision"])
        except ValueError as error:
            if bad is not None:
                bad.append(bad_row(suspensions, row, error))
    return by_number


def is_one_of(column: sql.Column[int], ids: Iterable[int]) -> Condition:
    """Return the condition that a column is one of `ids`, of which there may be many."""
    # literals, because databases limit the number of bound parameters
    wanted: sql.BindParameter[list[int]] = sql.bindparam(
        None, sorted(ids), expanding=True, literal_execute=True
    )
    return column.in_(wanted)


def is_of(vehicle: str, place: records.Place) -> Condition:
    """Return the condition that selects a suspension."""
    wanted = asdict(place) | {"vehicle": vehicle}
    return sql.and_(*(suspensions.c[name] == value for name, value in wanted.items()))


def read_stored(
    connection: Connection, kind: type[Stored], bad: list[BadRow], where: Condition | None = None
) -> dict[records.Key, list[Stored]]:
    """Return the objects of one class of each suspension, or of those selected by `where`.

    They are sorted by the primary key of the table. Unreadable rows are left out and appended to
    `bad`.
    """
    table, names = TABLES[kind], [field.name for field in fields(kind)]
    places = (suspensions.c[name] for name in ("vehicle", *records.PLACE))
    chosen = (
        sql.select(*places, *(table.c[name] for name in names))
        .join_from(table, suspensions)
        .where(sql.true() if where is None else where)
        .order_by(*table.primary_key.columns)
    )
    of_key: dict[records.Key, list[Stored]] = {}
    for row in connection.execute(chosen).mappings():
        try:
            key = key_of(row)
        except ValueError:  # a bad row of the table of suspensions, not of this one
            continue
        try:
            check_types(table, row)
            values: dict[str, Any] = {n: math.nan if row[n] is None else row[n] for n in names}
            if kind is Alarm:
                values["words"] = restored(values["words"])
            of_key.setdefault(key, []).append(kind(**values))
        except ValueError as error:
            bad.append(bad_row(table, row, error, key))
    return of_key


def row_of_stored(suspension: int, entry: Event | Alarm | Acknowledgement) -> dict[str, Any]:
    """Return an object as a row of its table."""
    values = {name: or_null(value) for name, value in asdict(entry).items()}
    return values | {"suspension_id": suspension, "words": stored(entry.words)}
