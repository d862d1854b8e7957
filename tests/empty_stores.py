"""Places of stores that are not there yet: an SQLite file, or a PostgreSQL server where one is."""

import os

import pytest
import sqlalchemy

SERVER = "SUSPNET_TEST_POSTGRESQL"
"""Environment variable with the URL of a database in which the tests may make schemas."""
KINDS = ("sqlite", "postgresql")


def empty_store(kind, folder):
    """Return file or URL of a store that is not there yet; skip the test without a server."""
    if kind == "sqlite":
        return str(folder / "history.db")
    url = os.environ.get(SERVER)
    if url is None:
        pytest.skip(f"no server: {SERVER}=postgresql://user:password@host/database")
    pytest.importorskip("psycopg")
    schema = f"suspnet_test_{os.environ.get('PYTEST_XDIST_WORKER', 'alone')}"
    engine = sqlalchemy.create_engine(url.replace("postgresql:", "postgresql+psycopg:", 1))
    with engine.begin() as connection:
        connection.exec_driver_sql(f"DROP SCHEMA IF EXISTS {schema} CASCADE")
        connection.exec_driver_sql(f"CREATE SCHEMA {schema}")
    engine.dispose()
    return f"{url}{'&' if '?' in url else '?'}options=-csearch_path%3D{schema}"
