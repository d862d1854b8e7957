"""Pages of a store that is locked, damaged, replaced or gone: at once, in words, and back again."""

import os
import re
import sqlite3
import threading
import time
from contextlib import closing, contextmanager

import numpy as np
import pytest
from cli_runner import typed
from served_fleet import FAILED, HEALTHY, SETTINGS, name_of, trips

from suspnet.cli import serve
from suspnet.depot.web import service
from suspnet.depot.web.app import create_app
from suspnet.trains.history import History
from suspnet.trains.pages import board
from suspnet.trains.pages.board import Board, Refresher

BASE = {"base_url": "http://127.0.0.1:8050"}


@pytest.fixture(scope="module")
def good(filled, tmp_path_factory):
    """The bytes of a store without a journal."""
    path = tmp_path_factory.mktemp("good") / "fleet.db"
    path.write_bytes(filled[0].read_bytes())
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    return path.read_bytes()


@pytest.fixture
def path(good, tmp_path):
    found = tmp_path / "fleet.db"
    found.write_bytes(good)
    return found


@pytest.fixture
def waits_little(monkeypatch):
    """Wait for a lock a tenth as long as programs do, which are seconds at most."""
    assert board.LOOK_S == serve.LOOK_S <= 1
    assert service.READ_S <= service.WRITE_S <= 2
    monkeypatch.setattr(board, "LOOK_S", board.LOOK_S / 10)
    monkeypatch.setattr(serve, "LOOK_S", serve.LOOK_S / 10)
    monkeypatch.setattr(service, "WRITE_S", service.WRITE_S / 10)
    monkeypatch.setattr(service, "READ_S", service.READ_S / 10)


@contextmanager
def looked(path):
    """Give the pages of a store and a function that looks at it; no thread runs."""
    refresher = Refresher(Board(str(path), SETTINGS), 3600.0)
    refresher.look()
    client = create_app(refresher).test_client()
    client.testing = False
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threading.Thread, "is_alive", lambda thread: True)  # as if it ran
        yield client, refresher.look, refresher.board


@contextmanager
def locked(path):
    """Lock a store as a program does that hangs while it writes."""
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("BEGIN EXCLUSIVE")
    try:
        yield
    finally:
        connection.close()


def asked(client, address, seconds, method="get", **options):
    """Return an answer that comes within some time."""
    begin = time.monotonic()
    answer = getattr(client, method)(address, **BASE, **options)
    assert time.monotonic() - begin < seconds
    return answer


def cut(content):
    return content[: len(content) // 2]


def overwritten(content):
    half = len(content) // 2
    return content[:half] + b"\xa5" * 40_000 + content[half + 40_000 :]


DAMAGE = {"cut": cut, "overwritten": overwritten, "empty": lambda _: b""}
DAMAGES = ["cut", *(pytest.param(name, marks=pytest.mark.slow) for name in list(DAMAGE)[1:])]
"""Of a store that is shown; all of them are refused by default where a program starts."""


def test_locked_store_holds_no_page_up_and_is_shown_again(path, waits_little):
    with looked(path) as (client, look, board):
        address = f"/suspension/{name_of(board.view, FAILED)}"
        token = re.search(r'csrf_token" value="([^"]+)', client.get(address, **BASE).text)[1]
        form = {"csrf_token": token, "parameter": "k_s", "cause": "limit", "severity": "act"}
        with locked(path):
            begin = time.monotonic()
            look()
            assert time.monotonic() - begin < 4
            page = asked(client, "/", 2).text
            assert "another program holds the store locked" in page
            assert re.search(r"This page shows the state of \d\d:\d\d:\d\d", page)
            assert "4 suspensions" in page
            assert "responses are not shown" in asked(client, address, 4).text
            sent = asked(client, f"{address}/acknowledge", 6, "post", data=form | {"by": "Kim"})
            assert sent.status_code == 503
            assert "Nothing was saved" in sent.text
            asked(client, f"{address}/trend.svg", 2)
            assert asked(client, f"{address}/responses.svg", 4).status_code == 503
        look()
        assert "locked" not in client.get("/", **BASE).text
        assert "trip_029" in client.get(address, **BASE).text


def test_bad_row_is_shown_on_the_pages(path):
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE trips SET start = 'yesterday' WHERE id = 1")
        connection.execute("UPDATE trips SET coherence_p = '<b>good' WHERE id = 2")
    connection.close()
    with looked(path) as (client, _, board):
        page = client.get("/", **BASE).text
        assert "1 row of the store could not be read and is left out" in page
        assert "trips, row id=1 of am96: train 12, car 3" in page
        assert "&#39;yesterday&#39;" in page
        page = client.get(f"/suspension/{name_of(board.view, FAILED)}", **BASE).text
        assert "2 rows of the store could not be read and are left out" in page
        assert "&lt;b&gt;good" in page
        other = client.get(f"/suspension/{name_of(board.view, HEALTHY)}", **BASE).text
        assert "could not be read" not in other


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_store_leaves_the_last_view_and_a_good_one_is_read(path, good, damage):
    with looked(path) as (client, look, board):
        address = f"/suspension/{name_of(board.view, FAILED)}"
        path.write_bytes(DAMAGE[damage](good))
        look()
        page = client.get("/", **BASE)
        assert page.status_code == 200
        assert "4 suspensions" in page.text
        for one in (address, f"{address}/responses.svg", "/plan", "/state"):
            assert client.get(one, **BASE).status_code in (200, 503)
        path.write_bytes(good)
        look()
        assert board.view.trouble == ""
        assert "The store cannot be read" not in client.get("/", **BASE).text
        assert "trip_029" in client.get(address, **BASE).text


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_store_that_was_never_read_is_one_page(path, good, damage):
    path.write_bytes(DAMAGE[damage](good))
    with looked(path) as (client, look, _):
        page = client.get("/", **BASE)
        assert page.status_code == 503
        assert "fleet.db: " in page.text
        assert "Traceback" not in page.text
        path.write_bytes(good)
        look()
        assert "4 suspensions" in client.get("/", **BASE).text


@pytest.mark.parametrize("damage", ["cut", "overwritten"])
def test_damaged_store_is_refused_at_the_start_in_one_line(path, good, damage, tmp_path):
    path.write_bytes(DAMAGE[damage](good))
    ended = typed(serve, f"store={path}", cwd=tmp_path)
    (line,) = ended.stderr.splitlines()
    assert ended.returncode == 1
    assert "fleet.db: " in line
    assert "put a copy in its place" in line or "header is damaged" in line


def test_other_store_in_the_place_of_the_first_is_read(path, tmp_path):
    with looked(path) as (client, look, board):
        other = tmp_path / "other.db"
        with History(other) as store:
            for seed, place in enumerate((FAILED, HEALTHY)):  # the same revisions
                store.write(trips(place, 30 + seed, n_trips=10))
        os.replace(other, path)
        look()
        assert {len(one.series.trip) for one in board.view.states} == {10}
        path.unlink()
        path.mkdir()
        look()
        assert "this is a folder" in client.get("/", **BASE).text
        path.rmdir()
        look()
        assert "there is no such store" in client.get("/", **BASE).text


def corrupted(good, seed):
    """Return a store with bytes, runs of bytes or values changed at random."""
    rng = np.random.default_rng(seed)
    content = bytearray(good)
    for _ in range(int(rng.integers(1, 60))):
        begin = int(rng.integers(0, len(content)))
        length = int(rng.choice([1, 1, 4, 100, 4096]))
        part = rng.integers(0, 256, length).astype(np.uint8).tobytes()
        content[begin : begin + length] = part[: len(content) - begin]
    if rng.random() < 0.2:
        del content[int(rng.integers(0, len(content))) :]
    return bytes(content)


VALUES = (
    *("NULL", "0", "-1", "1e300", "9e999", "-9e999", "9223372036854775807", "'x'", "''"),
    *("x'00ff'", "CAST(x'fffe' AS TEXT)", "'2199-01-01'", "'0001-01-01T00:00:00+23:00'"),
    *("'<script>'", "char(0)", "'1970-01-01T00:00Z'", "zeroblob(100000)", "'notice'"),
)


def altered(path, seed):
    """Change values of random rows and columns of a store."""
    rng = np.random.default_rng(seed)
    with sqlite3.connect(path) as connection:
        run = connection.execute
        names = [name for (name,) in run("SELECT name FROM sqlite_master WHERE type = 'table'")]
        for _ in range(int(rng.integers(1, 12))):
            table = str(rng.choice(names))
            columns = [row[1] for row in run(f"PRAGMA table_info({table})")]
            column, value = str(rng.choice(columns)), str(rng.choice(VALUES))
            rows = "1" if rng.random() < 0.2 else "rowid = 1 + abs(random()) % 40"
            try:
                run(f'UPDATE OR REPLACE {table} SET "{column}" = {value} WHERE {rows}')
            except sqlite3.Error:
                continue
    connection.close()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of absurd numbers
@pytest.mark.parametrize("kind", ["values", pytest.param("bytes", marks=pytest.mark.slow)])
def test_corrupted_store_gives_no_error_of_the_program(path, good, kind):
    """The store is corrupted while it is shown; all pages of it are asked for."""
    with looked(path) as (client, look, board):
        if kind == "bytes":
            path.write_bytes(corrupted(good, 0))
        else:
            altered(path, 0)
        look()
        addresses = ["/", "/plan", "/plan/calendar.svg", "/state"]
        for name in board.view.keys:
            addresses += [f"/suspension/{name}", f"/state?of={name}"]
        for name in list(board.view.keys)[:1]:  # figures take longest
            addresses += [f"/suspension/{name}/{end}.svg" for end in ("trend", "responses")]
        for address in addresses:
            answer = asked(client, address, 20)
            assert answer.status_code in (200, 404, 503), (address, answer.text)
            assert "Traceback" not in answer.text
        assert "could not be computed" not in client.get("/", **BASE).text
