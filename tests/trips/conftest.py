"""The small fleet on disk and the model that reads it, for all tests of trips."""

import pytest
from trip_fixtures import model_at, recalled_trip, small_fleet

from suspnet.trains.jobs import fleet
from suspnet.trains.pages import output


@pytest.fixture(scope="module")
def manifests():
    return small_fleet()


@pytest.fixture(scope="module")
def model():
    return model_at()


@pytest.fixture
def no_figures(monkeypatch):
    """Draw no figures and write no page."""
    write = output.write_pages
    monkeypatch.setattr(fleet, "write_pages", lambda *to, draw: write(*to, draw=False))
    monkeypatch.setattr(output, "write_report", lambda *_: None)


@pytest.fixture
def recalled(monkeypatch):
    """Read each trip of the small fleet once, where it does not matter how it is read."""
    monkeypatch.setattr(fleet, "evaluate_trip", recalled_trip)
