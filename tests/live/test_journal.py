import sqlite3

import pytest

from suspnet.depot.live.journal import Journal, JournalError


def filled(path):
    """Return a journal with two frames of A before its state, and two after it; one of B."""
    journal = Journal(path)
    journal.add("A", b"1")
    journal.add("B", b"22")
    journal.write()
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
        journal.write()
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
    frames = [str(k).encode() for k in range(775)]
    with Journal(tmp_path / "journal") as journal:
        for one in frames:
            journal.add("A", one)
        journal.write()
        assert list(journal.frames("A")) == frames


def test_journal_stays_small_where_states_are_saved(tmp_path):
    path = tmp_path / "journal"
    with Journal(path) as journal:
        for k in range(60):
            journal.add("A", bytes(50_000))
            if k % 10 == 9:
                journal.save("A", bytes(10_000))
            journal.write()
    assert path.stat().st_size < 1.5e6


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


def test_batch_that_a_full_disk_refused_can_be_written_again(tmp_path, monkeypatch):
    opened, connect = [], sqlite3.connect
    monkeypatch.setattr(
        sqlite3, "connect", lambda *a, **b: opened.append(connect(*a, **b)) or opened[-1]
    )
    with filled(tmp_path / "journal") as journal:
        run = opened[-1].execute
        (pages,) = run("PRAGMA page_count").fetchone()
        run(f"PRAGMA max_page_count = {pages}")
        journal.add("B", bytes(10**6))
        with pytest.raises(JournalError, match="cannot be written"):
            journal.write()
        run("PRAGMA max_page_count = 100000")
        journal.write()
        assert content(journal)["A"] == WHOLE["A"]
        assert content(journal)["B"] == (None, [b"22", bytes(10**6)])
