"""A store and its board for the tests of the pages, whose templates are compiled once."""

import time

import pytest
from flask.templating import Environment
from served_fleet import SETTINGS, fill

from suspnet.trains.pages.board import Board


@pytest.fixture(scope="package", autouse=True)
def _templates_compiled_once():
    compiled, compile_ = {}, Environment.compile

    def once(self, source, name=None, filename=None, raw=False, defer_init=False):
        key = source, name, filename, raw, defer_init
        if key not in compiled:
            compiled[key] = compile_(self, *key)
        return compiled[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Environment, "compile", once)
        yield


@pytest.fixture(scope="package")
def filled(tmp_path_factory):
    """A store, to which no test writes, and a board that has read it."""
    path = fill(tmp_path_factory.mktemp("web") / "fleet.db")
    board = Board(str(path), SETTINGS)
    board.refresh()
    return path, board


@pytest.fixture
def own_store(filled, tmp_path):
    """A copy of the store for one test."""
    path = tmp_path / "fleet.db"
    path.write_bytes(filled[0].read_bytes())
    return path


@pytest.fixture(scope="session")
def wait_for():
    """Return a function that waits until something is so."""

    def wait(is_so, seconds=60):
        end = time.monotonic() + seconds
        while not is_so():
            assert time.monotonic() < end, "it did not come"
            time.sleep(0.02)

    return wait
