"""Empty stores: an SQLite file, and a PostgreSQL server where one may be used."""

import os

import pytest
import sqlalchemy

from suspnet.history import History

SERVER = "SUSPNET_TEST_POSTGRESQL"
"""Environment variable with the URL of a database in which the tests may make schemas."""


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request, tmp_path):
    """File or URL of a store that is not there yet."""
    if request.param == "sqlite":
        return str(tmp_path / "history.db")
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


@pytest.fixture
def store(place):
    with History(place) as found:
        yield found
