"""Backup while others write, a lost disk, restore: the same store and the same pages."""

import os
import re
import sqlite3
import threading

import pytest
import served_fleet
from trip_records import trip

from suspnet.depot.web.app import create_app
from suspnet.trains.history import History, HistoryError
from suspnet.trains.history.backup import back_up, restore
from suspnet.trains.pages.board import Board, Refresher


def pages(path):
    """Return the pages of a store, without the times at which they were made."""
    board = Board(str(path), served_fleet.SETTINGS)
    board.refresh()
    client = create_app(Refresher(board, 3600.0)).test_client()
    names = list(board.view.keys)
    assert len(names) == 4
    got = [client.get(address) for address in ("/", "/plan", f"/suspension/{names[0]}")]
    assert {one.status_code for one in got} == {200}
    changing = r"\d\d:\d\d:\d\d|data-version=\"\w+\"|name=\"csrf_token\"[^>]*|of=[0-9a-f]{16}"
    return [re.sub(changing, "", one.text) for one in got]


@pytest.mark.usefixtures("trips_fitted_once")
def test_lost_disk_restored_gives_the_same_pages(tmp_path):
    path, copy = tmp_path / "fleet.db", tmp_path / "copy.db"
    served_fleet.fill(path)
    before = pages(path)
    assert back_up(str(path), copy) == copy.stat().st_size
    path.unlink()
    restore(copy, str(path))
    assert pages(path) == before
    assert sorted(os.listdir(tmp_path)) == ["copy.db", "fleet.db"]


def test_a_backup_while_a_writer_writes_is_one_state_of_the_store(tmp_path):
    path, ends = tmp_path / "fleet.db", threading.Event()
    first = trip(0, with_curves=False)
    with History(path) as store:
        store.write([first])

    def write():
        with History(path) as store:
            for i in range(1, 500):
                store.write([trip(2 * i + k, with_curves=False) for k in range(2)])
                if ends.is_set():
                    break

    writer = threading.Thread(target=write)
    writer.start()
    counts = []
    try:
        for i in range(5):
            back_up(str(path), tmp_path / f"{i}.db")
            with History(tmp_path / f"{i}.db") as store:
                store.check()
                counts.append(len(store.read(first.vehicle, first.place)))
    finally:
        ends.set()
        writer.join()
    assert counts == sorted(counts)
    assert counts[-1] > 1
    assert all(n % 2 == 1 for n in counts)  # pairs are written together


def test_nothing_is_replaced_that_is_not_an_earlier_backup(tmp_path):
    path, other = tmp_path / "fleet.db", tmp_path / "notes.txt"
    with History(path) as store:
        store.write([trip(0, with_curves=False)])
    other.write_text("mine")
    for replace in (False, True):
        with pytest.raises(HistoryError, match=r"notes\.txt"):
            back_up(str(path), other, replace=replace)
    assert other.read_text() == "mine"
    copy = tmp_path / "copy.db"
    path.chmod(0o640)
    back_up(str(path), copy)
    assert copy.stat().st_mode & 0o777 == 0o640  # as private as its store
    with pytest.raises(HistoryError, match="--replace"):
        back_up(str(path), copy)
    back_up(str(path), copy, replace=True)
    with pytest.raises(HistoryError, match="move this file away"):
        restore(copy, str(path))
    path.unlink()
    (tmp_path / "fleet.db-journal").write_bytes(b"of the lost store")
    with pytest.raises(HistoryError, match=r"fleet\.db-journal"):
        restore(copy, str(path))
    with pytest.raises(HistoryError, match="not a store"):
        restore(other, str(tmp_path / "new.db"))
    with pytest.raises(HistoryError, match="pg_dump"):
        back_up("postgresql://h/d", copy)
    assert not path.exists()


def test_a_store_is_never_replaced_by_its_own_backup(tmp_path):
    path, link = tmp_path / "fleet.db", tmp_path / "link.db"
    with History(path) as store:
        store.write([trip(0, with_curves=False)])
    link.symlink_to(path)
    before = path.stat().st_ino
    for copy in (path, link):
        with pytest.raises(HistoryError, match="the store itself"):
            back_up(str(path), copy, replace=True)
    assert path.stat().st_ino == before
    used = tmp_path / "used.db"
    back_up(str(path), used)
    (tmp_path / "used.db-journal").write_bytes(b"of a program that writes to it")
    with pytest.raises(HistoryError, match=r"used\.db-journal: a program writes"):
        back_up(str(path), used, replace=True)


def test_a_damaged_backup_or_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch):
    path, copy = tmp_path / "fleet.db", tmp_path / "copy.db"
    with History(path) as store:
        store.write([trip(i) for i in range(30)])
    back_up(str(path), copy)
    whole = bytearray(copy.read_bytes())
    whole[4096 * 3 : 4096 * 9] = b"\xff" * (4096 * 6)
    copy.write_bytes(whole)
    with pytest.raises(HistoryError, match=r"damaged|cannot be copied"):
        restore(copy, str(tmp_path / "new.db"))

    def full(*_):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr("suspnet.trains.history.backup.os.replace", full)
    with pytest.raises(HistoryError, match="disk is full"):
        back_up(str(path), tmp_path / "third.db")
    assert sorted(os.listdir(tmp_path)) == ["copy.db", "fleet.db"]
