import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from suspnet.live.journal import READ_AT_ONCE, Journal, JournalError


def filled(path):
    """Return a journal with two frames of A before its state, and two after it; one of B."""
    journal = Journal(path)
    journal.add("A", b"1")
    journal.add("B", b"22")
    journal.write(journal.batch())
    journal.add("A", b"3")
    journal.save("A", b"state")
    journal.add("A", b"4")
    journal.add("A", b"55")
    return journal


def content(journal):
    names = journal.suspensions()
    return {name: (journal.state(name), list(journal.frames(name))) for name in names}


WHOLE = {"A": (b"state", [b"4", b"55"]), "B": (None, [b"22"])}


def test_state_takes_the_place_of_the_frames_before_it(tmp_path):
    with filled(tmp_path / "journal") as journal:
        journal.write(journal.batch())
        assert content(journal) == WHOLE
        assert journal.n_bytes == {"A": 3, "B": 2}
    with Journal(tmp_path / "journal") as journal:
        assert content(journal) == WHOLE
        assert journal.n_bytes == {"A": 3, "B": 2}


def test_what_was_not_written_is_not_there(tmp_path):
    filled(tmp_path / "journal").close()
    with Journal(tmp_path / "journal") as journal:
        assert content(journal) == {"A": (None, [b"1"]), "B": (None, [b"22"])}


def test_frames_come_back_in_their_order(tmp_path):
    frames = [str(k).encode() for k in range(3 * READ_AT_ONCE + 7)]
    with Journal(tmp_path / "journal") as journal:
        for one in frames:
            journal.add("A", one)
        journal.write(journal.batch())
        assert list(journal.frames("A")) == frames


def test_batches_can_be_written_while_more_is_added(tmp_path):
    frames = [str(k).encode() for k in range(100)]
    with Journal(tmp_path / "journal") as journal, ThreadPoolExecutor(1) as writer:
        written = []
        for k, one in enumerate(frames):
            journal.add("A", one)
            if k == 50:
                journal.save("A", b"state")
            written.append(writer.submit(journal.write, journal.batch()))
        for one in written:
            one.result()
        assert content(journal) == {"A": (b"state", frames[51:])}
        assert not journal.batch()


def test_close_waits_for_the_batch_that_is_being_written(tmp_path, monkeypatch):
    is_begun, is_closing, write = threading.Event(), threading.Event(), Journal._write

    def write_late(self, batch):
        is_begun.set()
        assert is_closing.wait(60)
        time.sleep(0.05)
        write(self, batch)

    monkeypatch.setattr(Journal, "_write", write_late)
    journal = Journal(tmp_path / "journal")
    journal.add("A", b"1")
    with ThreadPoolExecutor(1) as writer:
        written = writer.submit(journal.write, journal.batch())
        assert is_begun.wait(60)
        is_closing.set()
        journal.close()
        written.result()
    with Journal(tmp_path / "journal") as journal:
        assert content(journal) == {"A": (None, [b"1"])}


def test_journal_stays_small_where_states_are_saved(tmp_path):
    path = tmp_path / "journal"
    with Journal(path) as journal:
        for k in range(200):
            journal.add("A", bytes(50_000))
            if k % 10 == 9:
                journal.save("A", bytes(10_000))
            journal.write(journal.batch())
    assert path.stat().st_size < 2e6


# failure


def test_journal_is_of_one_process(tmp_path, monkeypatch):
    connect = sqlite3.connect
    soon = {"timeout": 0.05}  # instead of a second
    monkeypatch.setattr(sqlite3, "connect", lambda *path, **given: connect(*path, **given | soon))
    with (
        Journal(tmp_path / "journal"),
        pytest.raises(JournalError, match="another monitor has it open"),
    ):
        Journal(tmp_path / "journal")


def test_file_that_is_none_is_refused(tmp_path):
    path = tmp_path / "journal"
    path.write_bytes(b"something else" * 1000)
    with pytest.raises(JournalError, match="is not an SQLite database"):
        Journal(path)


def test_database_of_others_is_refused(tmp_path):
    path = tmp_path / "journal"
    with sqlite3.connect(path) as other:
        other.execute("CREATE TABLE trips (id INTEGER)")
    other.close()
    with pytest.raises(JournalError, match="not a journal"):
        Journal(path)


def test_folder_that_is_missing_is_told(tmp_path):
    with pytest.raises(JournalError, match="there is no folder"):
        Journal(tmp_path / "none" / "journal")


def test_batch_that_a_full_disk_refused_can_be_written_again(tmp_path):
    with filled(tmp_path / "journal") as journal:
        (pages,) = journal._connection.execute("PRAGMA page_count").fetchone()
        journal._connection.execute(f"PRAGMA max_page_count = {pages}")
        journal.add("B", bytes(10**6))
        batch = journal.batch()
        with pytest.raises(JournalError, match="cannot be written"):
            journal.write(batch)
        journal._connection.execute("PRAGMA max_page_count = 100000")
        journal.write(batch)
        assert content(journal)["A"] == WHOLE["A"]
        assert content(journal)["B"] == (None, [b"22", bytes(10**6)])
