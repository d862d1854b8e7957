"""The small fleet on disk and the model that reads it, for all tests of trips."""

import pytest
from trip_fixtures import model_at, small_fleet


@pytest.fixture(scope="module")
def manifests(tmp_path_factory):
    return small_fleet(tmp_path_factory)


@pytest.fixture(scope="module")
def model():
    return model_at()
