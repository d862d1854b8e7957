"""Empty stores, of each database that there is."""

import pytest
from empty_stores import KINDS, empty_store

from suspnet.history import History


@pytest.fixture(params=KINDS)
def place(request, tmp_path):
    """File or URL of a store that is not there yet."""
    return empty_store(request.param, tmp_path)


@pytest.fixture
def store(place):
    with History(place) as found:
        yield found
