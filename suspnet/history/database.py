"""The database under a store: an SQLite file, or a PostgreSQL server by its URL."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine, make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError

from suspnet.history.schema import SCHEMA, metadata, versions

WAIT_S = 60
"""Time that a writer waits for another one, [s]."""
READS = "suspnet_reads"
"""Option of a connection that SQLite begins without the lock of a writer."""
LOCK = 0x73757370
"""Number of the lock of PostgreSQL under which the tables are made."""


class HistoryError(ValueError):
    """The store cannot be used: another file, another version, a server that does not answer."""


def database_url(place: str | Path) -> URL:
    """Return the URL of a store that is named by a file or a URL.

    Raises
    ------
    HistoryError
        If it is none, or of another database.
    """
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


def connect(url: URL) -> Engine:
    """Return the engine of a store; SQLite waits for other writers from the first statement on.

    Raises
    ------
    HistoryError
        If a driver or a folder is missing.
    """
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
        reads = connection.get_execution_options().get(READS)
        connection.exec_driver_sql("BEGIN" if reads else "BEGIN IMMEDIATE")

    return engine


def reading(engine: Engine) -> Engine:
    """Return the engine for transactions that only read: they see one state of the store.

    In SQLite they wait for no writer that has not yet come to the end of its transaction.
    """
    if engine.dialect.name == "sqlite":
        return engine.execution_options(**{READS: True})
    return engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)


def prepare(connection: Connection, name: str) -> None:
    """Make the tables where there are none.

    Raises
    ------
    HistoryError
        If those that are there are of another version, or not ours; it begins with the `name`.
    """
    if connection.dialect.name == "postgresql":  # two programs may be the first at once
        connection.execute(sql.select(sql.func.pg_advisory_xact_lock(LOCK)))
    there = set(sql.inspect(connection).get_table_names())
    if versions.name not in there:
        if there & set(metadata.tables):
            raise HistoryError(f"{name}: this is no store of suspnet, but has tables like it")
        metadata.create_all(connection)
        connection.execute(versions.insert().values(schema=SCHEMA))
        return
    version = connection.execute(sql.select(versions.c.schema)).scalar()
    if version != SCHEMA:
        raise HistoryError(
            f"{name}: a store of version {version}, this suspnet reads version {SCHEMA}; use "
            "the suspnet that wrote it, or begin a new store and evaluate the trips again"
        )


def upsert(connection: Connection, table: sql.Table, rows: Sequence[dict[str, Any]]) -> None:
    """Insert rows; one whose unique columns are there already takes its other values.

    Writers that hold several rows at once take them in the same order, so that none waits for
    another that waits for it.
    """
    if not rows:
        return
    key = _unique_columns(table)
    dialect = postgresql if connection.dialect.name == "postgresql" else sqlite
    statement = dialect.insert(table)
    others = {name: statement.excluded[name] for name in rows[0] if name not in key}
    if others:
        statement = statement.on_conflict_do_update(index_elements=key, set_=others)
    else:
        statement = statement.on_conflict_do_nothing(index_elements=key)
    connection.execute(statement, sorted(rows, key=lambda row: [row[name] for name in key]))


def _unique_columns(table: sql.Table) -> list[str]:
    """Return the columns that tell a row from the others: of its constraint, or of its key."""
    unique = [one for one in table.constraints if isinstance(one, sql.UniqueConstraint)]
    return [column.name for column in (unique[0] if unique else table.primary_key).columns]
