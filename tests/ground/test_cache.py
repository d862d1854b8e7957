"""A cache that is damaged in any way is not used; one that cannot be written costs time only."""

import logging
import shutil

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from suspnet.ground import storage
from suspnet.ground.cache import Cache

ARRAYS = {"inputs": np.arange(12.0).reshape(4, 3), "outputs": np.arange(8.0).reshape(4, 2) + 1}
MADE_FROM = {"seed": 3, "settings": ["curves", {"snr_db": 34.0}]}
NOTES = {"trip": "trip_001", "k_p": [1.5, None]}


@pytest.fixture
def kept(tmp_path):
    """Return a cache that holds arrays made from one description and others from another."""
    found = Cache(tmp_path / "cache", "features")
    found.write(MADE_FROM, ARRAYS, NOTES)
    found.write(MADE_FROM | {"seed": 4}, {name: -array for name, array in ARRAYS.items()})
    return found


def header(path):
    with safe_open(path, "numpy") as file:
        return file.metadata()


def changed(path, change, **metadata):
    """Write a valid file with other arrays and the header as it was."""
    arrays = load_file(path)
    change(arrays)
    save_file(arrays, path, header(path) | metadata)


def flip(path, position):
    content = bytearray(path.read_bytes())
    content[position] ^= 16
    path.write_bytes(content)


def as_folder(path):
    path.unlink()
    path.mkdir()


DAMAGE = {
    "outputs reversed": lambda p, _: changed(p, lambda a: a.update(outputs=a["outputs"][::-1] + 0)),
    "other shape": lambda p, _: changed(p, lambda a: a.update(inputs=a["inputs"].reshape(3, 4))),
    "not a number": lambda p, _: changed(p, lambda a: a["inputs"].fill(np.nan)),
    "no header": lambda p, _: save_file(load_file(p), p),
    "header too deep": lambda p, _: changed(p, lambda _: None, suspnet="[" * 100_000),
    "header of another": lambda p, o: save_file(load_file(p), p, header(o)),
    "file of another": lambda p, o: shutil.copy(o, p),
    "bit of a value": lambda p, _: flip(p, -1),
    "truncated": lambda p, _: p.write_bytes(p.read_bytes()[:-8]),
    "foreign": lambda p, _: p.write_bytes(b"PK\x03\x04" * 50),
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
    assert Cache(kept.folder, "trips").read(MADE_FROM) is None
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

    kept = Cache(tmp_path / "cache", "features")
    monkeypatch.setattr(storage.os, "fsync", fail)
    for seed in range(3):
        kept.write(MADE_FROM | {"seed": seed}, ARRAYS)
    assert len(caplog.messages) == 1
    assert "cannot be written, which costs time only: no way" in caplog.text


def test_no_folder_keeps_nothing():
    Cache(None, "features").write(MADE_FROM, ARRAYS)
    assert Cache(None, "features").read(MADE_FROM) is None
