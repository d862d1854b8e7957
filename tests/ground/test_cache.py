"""A cache that is damaged in any way is not used; one that cannot be written costs time only."""

import logging
import shutil

import numpy as np
import pytest

from suspnet.ground import storage
from suspnet.ground.cache import Cache

ARRAYS = {"inputs": np.arange(12.0).reshape(4, 3), "outputs": np.arange(8.0).reshape(4, 2) + 1}
MADE_FROM = {"seed": 3, "settings": ["curves", {"snr_db": 34.0}]}
NOTES = {"trip": "trip_001", "k_p": [1.5, None]}


@pytest.fixture
def kept(tmp_path):
    """Return a cache that holds arrays made from one description and others from another."""
    found = Cache(tmp_path / "cache")
    found.write(MADE_FROM, ARRAYS, NOTES)
    found.write(MADE_FROM | {"seed": 4}, {name: -array for name, array in ARRAYS.items()}, {})
    return found


def flip(path, position):
    content = bytearray(path.read_bytes())
    content[position] ^= 16
    path.write_bytes(content)


def joined(path, other):
    """Return the checksum and arrays of a file with the notes of another."""
    checksum, _, arrays = path.read_bytes().split(b"\n", 2)
    return b"\n".join([checksum, other.read_bytes().split(b"\n", 2)[1], arrays])


def as_folder(path):
    path.unlink()
    path.mkdir()


DAMAGE = {
    "other value": lambda p, _: flip(p, p.stat().st_size - 3),
    "bit of a value": lambda p, _: flip(p, -1),
    "bit of the notes": lambda p, _: flip(p, 70),
    "no checksum": lambda p, _: p.write_bytes(p.read_bytes().partition(b"\n")[2]),
    "notes of another": lambda p, o: p.write_bytes(joined(p, o)),
    "file of another": lambda p, o: shutil.copy(o, p),
    "truncated": lambda p, _: p.write_bytes(p.read_bytes()[:-8]),
    "foreign": lambda p, _: p.write_bytes(b"PK\x03\x04" * 50),
    "too deep": lambda p, _: p.write_bytes(b"[" * 100_000),
    "empty": lambda p, _: p.write_bytes(b""),
    "folder": lambda p, _: as_folder(p),
}
"""What may become of a file, given that file and another of the same cache."""


def test_arrays_and_notes_come_back_as_written(kept):
    arrays, notes = kept.read(MADE_FROM)
    assert notes == NOTES
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)


def test_what_was_made_from_something_else_is_not_there(kept, caplog):
    assert kept.read(MADE_FROM | {"seed": 5}) is None
    assert caplog.text == ""


@pytest.mark.parametrize("kind", DAMAGE)
def test_no_damaged_file_is_used_and_one_line_says_so(kept, caplog, kind):
    path, other = kept.path(MADE_FROM), kept.path(MADE_FROM | {"seed": 4})
    DAMAGE[kind](path, other)
    with caplog.at_level(logging.WARNING):
        assert kept.read(MADE_FROM) is None
    assert len(caplog.messages) == 1
    assert "\n" not in caplog.messages[0]
    if kind != "folder":
        assert "ignoring a damaged cache file" in caplog.text
        kept.write(MADE_FROM, ARRAYS, NOTES)
        assert kept.read(MADE_FROM) is not None


@pytest.mark.parametrize("number", [28, 30, 13])  # full, read-only, not permitted
def test_folder_that_cannot_be_written_costs_one_warning(tmp_path, monkeypatch, caplog, number):
    def fail(*args, **options):
        raise OSError(number, "no way")

    kept = Cache(tmp_path / "cache")
    monkeypatch.setattr(storage.os, "fsync", fail)
    for seed in range(3):
        kept.write(MADE_FROM | {"seed": seed}, ARRAYS, NOTES)
    assert len(caplog.messages) == 1
    assert "cannot be written, which costs time only: no way" in caplog.text
