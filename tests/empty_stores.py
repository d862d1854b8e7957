"""Places of stores that are not there yet: an SQLite file, or a schema of a PostgreSQL server."""

import os

import postgres_server
import pytest
import sqlalchemy

SERVER = "SUSPNET_TEST_POSTGRESQL"
"""Environment variable with the URL of a database in which the tests may make schemas.

Without it they start a server of their own, if PostgreSQL and its driver are installed.
"""
KINDS = ("sqlite", "postgresql")


def empty_store(kind, folder):
    """Return file or URL of a store that is not there yet; skip the test without a server."""
    if kind == "sqlite":
        return str(folder / "history.db")
    pytest.importorskip("psycopg")
    url = os.environ.get(SERVER) or postgres_server.url()
    if url is None:
        pytest.skip(f"no server: {SERVER}=postgresql://user:password@host/database")
    schema = f"suspnet_test_{os.environ.get('PYTEST_XDIST_WORKER', 'alone')}"
    engine = sqlalchemy.create_engine(url.replace("postgresql:", "postgresql+psycopg:", 1))
    with engine.begin() as connection:
        connection.exec_driver_sql(f"DROP SCHEMA IF EXISTS {schema} CASCADE")
        connection.exec_driver_sql(f"CREATE SCHEMA {schema}")
    engine.dispose()
    return f"{url}{'&' if '?' in url else '?'}options=-csearch_path%3D{schema}"
