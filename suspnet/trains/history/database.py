"""The database under a store: an SQLite file, or a PostgreSQL server by its URL."""

import functools
import logging
import math
import re
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError, SQLAlchemyError

from suspnet.ground.extras import install_command
from suspnet.ground.findings import at
from suspnet.ground.own_files import ACTING, check_own
from suspnet.trains.history.schema import SCHEMA, metadata, versions

log = logging.getLogger(__name__)
WAIT_S = 60.0  # longest time that a writer waits for another one, [s]
CONNECT_S = 5  # longest time to connect to a server, [s]
APPLICATION_ID = 0x73757368  # number in the header of an SQLite store, by which it is recognised
DAMAGED = (
    "{name}: the store is damaged ({words}); put a copy in its place, or evaluate the trips again "
    "into a new one"
)
READS = "suspnet_reads"
"""Execution option of read-only connections, for which SQLite takes no write lock."""
LOCK = 0x73757370  # number of PostgreSQL's advisory lock under which the tables are created


class HistoryError(ValueError):
    """The store cannot be used: not a store, another version, or a server that does not answer."""


def check_exists(place: str) -> None:
    """Raise HistoryError if a store that is a file does not exist."""
    if "://" not in place and not Path(place).is_file():
        raise HistoryError(at(place, "store-missing-made-by"))


class BusyError(HistoryError):
    """Another program has locked the store for too long."""


def database_url(place: str | Path) -> URL:
    """Return the URL of a store from a path or a URL; HistoryError for other kinds of database."""
    text = str(place)
    if "://" not in text:
        return URL.create("sqlite", database=text)
    try:
        url = make_url(text)
    except ArgumentError:
        shown = re.sub(r":[^:/@]*@", ":***@", text)  # without the password
        raise HistoryError(f"{shown!r} is not a database URL") from None
    if url.drivername in ("postgresql", "postgres"):
        url = url.set(drivername="postgresql+psycopg")
    if url.get_backend_name() not in ("sqlite", "postgresql"):
        raise HistoryError(
            f"a store is a file or postgresql://user:password@host/database, not "
            f"{url.drivername}://"
        )
    return url


def connect(url: URL, wait_s: float = WAIT_S, *, must_exist: bool = False) -> Engine:
    """Return the engine of a store; a foreign file is refused before SQLite opens it.

    A statement waits at most `wait_s` for other programs. HistoryError is raised if a driver, the
    folder or, with `must_exist`, the file is missing, or if it is not a store.
    """
    if url.get_backend_name() == "postgresql":
        return _connect_server(url, wait_s)
    # what the URL names must be a file of ours, or one that may be made
    if not url.database or url.database == ":memory:":
        raise HistoryError("a store needs the path of a file")
    if url.query:
        raise HistoryError(f"{url.database}: give the path of the store without options")
    path = Path(url.database).absolute()
    if not path.parent.is_dir():
        raise HistoryError(at(url.database, "no-folder", parent=path.parent))
    if must_exist and not path.exists():
        raise HistoryError(at(url.database, "store-missing"))
    try:
        check_own(Path(url.database), APPLICATION_ID, "store of suspnet")
    except ValueError as error:
        raise HistoryError(str(error)) from None
    # SQLite itself must not make a file that has gone since
    address = f"{path.as_uri()}?mode={'rw' if must_exist else 'rwc'}"
    engine = sql.create_engine(
        "sqlite://",
        creator=lambda: sqlite3.connect(address, timeout=wait_s, uri=True, check_same_thread=False),
        poolclass=sql.QueuePool,
    )

    @sql.event.listens_for(engine, "connect")
    def _connected(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # transactions are started below, not by the driver
        # by default one damaged character would make the whole query fail
        connection.text_factory = functools.partial(str, encoding="utf-8", errors="replace")
        connection.execute("PRAGMA foreign_keys = ON")

    @sql.event.listens_for(engine, "begin")
    def _begun(connection: Connection) -> None:
        reads = connection.get_execution_options().get(READS)
        connection.exec_driver_sql("BEGIN" if reads else "BEGIN IMMEDIATE")

    return engine


def _connect_server(url: URL, wait_s: float) -> Engine:
    try:
        engine = sql.create_engine(url, pool_size=1, connect_args={"connect_timeout": CONNECT_S})
    except (ImportError, NoSuchModuleError):
        raise HistoryError(f"PostgreSQL needs its driver: {install_command('postgres')}") from None

    @sql.event.listens_for(engine, "begin")
    def _begun(connection: Connection) -> None:
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {math.ceil(1000 * wait_s)}")

    return engine


def reading(engine: Engine) -> Engine:
    """Return the engine for read-only transactions, each of which sees one snapshot of the store.

    In SQLite they do not wait for the transaction of a writer.
    """
    if engine.dialect.name == "sqlite":
        return engine.execution_options(**{READS: True})
    return engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)


def has_tables(connection: Connection, name: str) -> bool:
    """Return whether the tables of a store are there.

    HistoryError, whose message starts with `name`, is raised if they are of another version or of
    another application.
    """
    is_file = connection.dialect.name == "sqlite"
    if is_file and connection.exec_driver_sql(ACTING).first() is not None:
        raise HistoryError(at(name, "store-acting"))
    tables = set(sql.inspect(connection).get_table_names())
    if versions.name not in tables:
        if tables & set(metadata.tables):
            raise HistoryError(at(name, "store-foreign"))
        return False
    version = connection.execute(sql.select(versions.c.schema)).scalar()
    if version != SCHEMA:
        raise HistoryError(at(name, "store-version", version=version, schema=SCHEMA))
    return True


def prepare(connection: Connection, name: str) -> None:
    """Create the tables; errors as in ``has_tables``.

    Nothing is done if another program has just done so.
    """
    if connection.dialect.name == "postgresql":  # two programs may create them concurrently
        connection.execute(sql.select(sql.func.pg_advisory_xact_lock(LOCK)))
    if has_tables(connection, name):
        return
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(f"PRAGMA application_id = {APPLICATION_ID}")
    elif others := sql.inspect(connection).get_table_names():
        log.warning("%s: new tables of a store, next to %d other tables", name, len(others))
    metadata.create_all(connection)
    connection.execute(versions.insert().values(schema=SCHEMA))


def error_of(error: SQLAlchemyError | UnicodeDecodeError, name: str) -> HistoryError:
    """Return an error of the database as a HistoryError of one line that starts with `name`."""
    words = " ".join(str(getattr(error, "orig", None) or error).split("\n")[0].split())
    cause = error.orig if isinstance(error, DBAPIError) else None
    code = getattr(cause, "sqlite_errorcode", 0) & 0xFF
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED) or "lock timeout" in words:
        return BusyError(at(name, "store-locked", words=words))
    is_damaged = code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
    if is_damaged or isinstance(error, UnicodeDecodeError):
        return HistoryError(DAMAGED.format(name=name, words=words))
    return HistoryError(at(name, "store-unusable", words=words))


def upsert(connection: Connection, table: sql.Table, rows: Sequence[dict[str, Any]]) -> None:
    """Insert rows, or update those whose unique columns exist.

    Rows are written in the order of these columns, so that concurrent writers do not deadlock.
    """
    if not rows:
        return
    unique = [c for c in table.constraints if isinstance(c, sql.UniqueConstraint)]
    key = [column.name for column in (unique[0] if unique else table.primary_key).columns]
    dialect = postgresql if connection.dialect.name == "postgresql" else sqlite
    statement = dialect.insert(table)
    others = {name: statement.excluded[name] for name in rows[0] if name not in key}
    if others:
        statement = statement.on_conflict_do_update(index_elements=key, set_=others)
    else:
        statement = statement.on_conflict_do_nothing(index_elements=key)
    connection.execute(statement, sorted(rows, key=lambda row: [row[name] for name in key]))
