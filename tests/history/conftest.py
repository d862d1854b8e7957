"""Empty stores, of each database that there is."""

import pytest
import sqlalchemy
from empty_stores import KINDS, empty_store

from suspnet.trains.history import History
from suspnet.trains.history.database import database_url


@pytest.fixture(params=KINDS)
def place(request, tmp_path):
    """File or URL of a store that is not there yet."""
    return empty_store(request.param, tmp_path)


@pytest.fixture
def store(place):
    with History(place) as found:
        yield found


@pytest.fixture
def by_hand(place):
    """Return a function that executes a statement on the store, as somebody may with a client."""
    engine = sqlalchemy.create_engine(database_url(place))

    def execute(statement):
        with engine.begin() as connection:
            result = connection.execute(statement)
            return result.scalar() if result.returns_rows else None

    yield execute
    engine.dispose()
