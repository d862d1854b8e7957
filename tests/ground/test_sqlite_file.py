"""Stores and journals that name somebody else's file leave it exactly as it was."""

import os
import sqlite3
import subprocess
import sys

import pytest
from cli_runner import typed

from suspnet.cli import history, serve
from suspnet.depot.live.journal import Journal, JournalError
from suspnet.trains.history import History, HistoryError

OPENED = {"store": (History, HistoryError), "journal": (Journal, JournalError)}
LIVE = """
import os, sqlite3, sys
one = sqlite3.connect(sys.argv[1], isolation_level=None)
one.execute("PRAGMA journal_mode = WAL")
one.execute("CREATE TABLE notes (words TEXT)")
one.execute("INSERT INTO notes VALUES ('mine')")
os._exit(0)  # as if killed: the write-ahead log stays
"""


def database(path, *statements):
    """Make an SQLite file by statements."""
    with sqlite3.connect(path, isolation_level=None) as connection:
        for one in statements:
            connection.execute(one)
    connection.close()


def tables(path):
    database(path, "CREATE TABLE notes (words TEXT)", "INSERT INTO notes VALUES ('mine')")


def own_tables(path):
    """Make tables that are named as some of this program's."""
    database(path, "CREATE TABLE format (name TEXT)", "CREATE TABLE trips (id INTEGER)")


def numbered(path):
    database(path, "PRAGMA application_id = 252006674", "PRAGMA user_version = 7")


def versioned(path):
    database(path, "PRAGMA user_version = 7")


def waiting(path):
    """Make a file in WAL mode whose tables are still in its log."""
    subprocess.run([sys.executable, "-c", LIVE, str(path)], check=True)


def text(path):
    path.write_text("Dear diary, " * 500)


def cut(path):
    tables(path)
    path.write_bytes(path.read_bytes()[:50])


def linked(path):
    tables(path.with_name("theirs.db"))
    path.symlink_to("theirs.db")


def dangling(path):
    path.symlink_to("nowhere.db")


def device(path):
    path.symlink_to("/dev/zero")


def fifo(path):
    os.mkfifo(path)


def folder(path):
    path.mkdir()


THEIRS = (tables, own_tables, numbered, versioned, waiting, text, cut, linked)
NO_FILE = (dangling, device, fifo, folder)


def listing(place):
    """Return everything that a change to a folder's files would change."""
    found = {}
    for one in sorted(place.rglob("*")):
        status = one.lstat()
        is_file = one.is_file() and not one.is_symlink()
        content = one.read_bytes() if is_file else b""
        found[one.name] = status.st_mode, status.st_ino, status.st_mtime_ns, content
    return found


@pytest.mark.parametrize("kind", OPENED)
@pytest.mark.parametrize("make", [*THEIRS, *NO_FILE])
@pytest.mark.timeout(60)
def test_files_of_others_are_refused_unchanged(make, kind, tmp_path):
    place = tmp_path / "place"
    place.mkdir()
    path = place / "theirs"
    make(path)
    before = listing(place)
    opened, error = OPENED[kind]
    with pytest.raises(error, match=r"theirs: .*(not a store|not a journal|is a |link)"):
        opened(path).close()
    assert listing(place) == before


@pytest.mark.parametrize("kind", OPENED)
def test_reason_of_a_refusal_is_named(kind, tmp_path):
    opened, error = OPENED[kind]
    text(tmp_path / "theirs")
    with pytest.raises(error, match="is not an SQLite database"):
        opened(tmp_path / "theirs")
    with pytest.raises(error, match="there is no folder"):
        opened(tmp_path / "none" / "theirs")


@pytest.mark.parametrize("make", [tables, waiting, fifo])
@pytest.mark.timeout(60)
def test_programs_refuse_files_of_others_unchanged(make, tmp_path):
    place = tmp_path / "place"
    place.mkdir()
    path = place / "theirs"
    make(path)
    before = listing(place)
    for program, arguments in ((history, [path, "list"]), (serve, [f"store={path}"])):
        ended = typed(program, *arguments, cwd=tmp_path)
        (line,) = ended.stderr.splitlines()
        assert "theirs: " in line
        assert ended.returncode == 1
    assert listing(place) == before


def test_stores_and_journals_are_not_taken_for_each_other(tmp_path):
    History(tmp_path / "store").close()
    Journal(tmp_path / "journal").close()
    before = listing(tmp_path)
    with pytest.raises(HistoryError, match="not a store"):
        History(tmp_path / "journal")
    with pytest.raises(JournalError, match="not a journal"):
        Journal(tmp_path / "store")
    assert listing(tmp_path) == before


# property


@pytest.mark.parametrize("kind", OPENED)
@pytest.mark.parametrize("make", [None, lambda path: path.touch(), lambda path: database(path)])
def test_new_and_empty_files_become_ours(make, kind, tmp_path):
    path = tmp_path / "new"
    if make:
        make(path)
    for _ in range(2):
        OPENED[kind][0](path).close()
    assert path.read_bytes()[:15] == b"SQLite format 3"


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
ACTS = {
    "view": (
        "ALTER TABLE suspensions RENAME TO theirs",
        f"CREATE VIEW suspensions AS {ENDLESS} SELECT i AS id, i AS number, i AS name FROM n",
    ),
    "trigger": ("CREATE TRIGGER t AFTER INSERT ON suspensions BEGIN DELETE FROM suspensions; END",),
    "virtual table": ("CREATE VIRTUAL TABLE notes USING fts5(words)",),
}


@pytest.mark.parametrize("kind", OPENED)
@pytest.mark.parametrize(("acts", "is_numbered"), [(act, act == "view") for act in ACTS])
@pytest.mark.timeout(60)
def test_files_that_act_when_they_are_read_are_refused_at_once(kind, acts, is_numbered, tmp_path):
    opened, error = OPENED[kind]
    path = tmp_path / "sent"
    opened(path).close()
    database(path, *ACTS[acts])
    if not is_numbered:
        database(path, "PRAGMA application_id = 0")
    before = path.read_bytes()
    with pytest.raises(error, match=r"sent: .*(not a store|not a journal|no journal)"):
        opened(path).close()
    assert path.read_bytes() == before
