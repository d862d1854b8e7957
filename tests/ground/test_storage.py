"""Files appear whole or not at all, and damaged ones are noticed."""

import hashlib
import math
import os
import stat
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from suspnet.ground import storage
from suspnet.ground.storage import (
    DamagedFileError,
    content_hash,
    dump_arrays,
    locked,
    new_folder,
    read_arrays,
    read_json,
    write_atomically,
    write_json,
)

ARRAYS = {"inputs": np.arange(12.0).reshape(3, 4), "reasons": np.array([0, 5, 2])}


@pytest.fixture
def arrays_file(tmp_path):
    return write_atomically(tmp_path / "arrays.safetensors", dump_arrays(ARRAYS))


@pytest.fixture
def umask():
    """Set the umask, and restore it afterwards."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


# reference


def test_arrays_come_back_as_written(arrays_file):
    found = read_arrays(arrays_file)
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("content", ["text with \N{GREEK SMALL LETTER OMEGA}", b"\x00\xff"])
def test_text_and_bytes_are_written_in_new_folders(tmp_path, content):
    path = write_atomically(tmp_path / "a" / "b" / "file", content)
    expected = content.encode() if isinstance(content, str) else content
    assert path.read_bytes() == expected
    assert [p.name for p in path.parent.iterdir()] == ["file"]


# property


def test_json_round_trip_turns_what_is_not_finite_into_null(tmp_path):
    content = {
        "nan": math.nan,
        "list": [1, math.inf, (-math.inf, 2.5)],
        "numpy": {"nan": np.float64("nan"), "float": np.float32(0.5), "int": np.int64(3)},
        "text": "nan",
        "flag": True,
        "none": None,
        7: "key",
    }
    path = write_json(tmp_path / "metrics.json", content)
    assert read_json(path) == {
        "nan": None,
        "list": [1, None, [None, 2.5]],
        "numpy": {"nan": None, "float": 0.5, "int": 3},
        "text": "nan",
        "flag": True,
        "none": None,
        "7": "key",
    }
    assert "NaN" not in path.read_text()
    assert path.read_text().endswith("}\n")


@pytest.mark.skipif(os.name != "posix", reason="permissions are those of POSIX")
@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_permissions_follow_the_umask(tmp_path, umask, mask, mode):
    umask(mask)
    path = write_atomically(tmp_path / "file", "content")
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert umask(mask) == mask  # left as it was


def test_content_hash_ignores_the_order_of_keys_only():
    first = content_hash({"a": 1, "b": [1, 2]})
    assert first == content_hash({"b": [1, 2], "a": 1})
    assert first != content_hash({"a": 1, "b": [2, 1]})
    assert first != content_hash({"a": 1.5, "b": [1, 2]})
    assert len(first) == 64


def test_file_system_without_locks_will_do(tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "HAS_LOCKS", False)
    with locked(tmp_path) as is_ours:
        assert is_ours
        assert write_atomically(tmp_path / "file", "content").read_text() == "content"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_folders_made_at_the_same_time_are_different(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: new_folder(tmp_path / "runs" / "run"), range(40)))
    names = {"run", *(f"run_{number}" for number in range(2, 41))}
    assert {folder.name for folder in made} == names
    assert {folder.name for folder in (tmp_path / "runs").iterdir()} == names


def test_folder_is_locked_for_one_at_a_time(tmp_path):
    with locked(tmp_path, wait=False) as first:
        with locked(tmp_path, wait=False) as second:
            assert (first, second) == (True, False)
        with locked(tmp_path / "other", wait=False) as other:
            assert other
    with locked(tmp_path, wait=False) as again:
        assert again


# failure


@pytest.mark.parametrize("step", ["replace", "fsync"])
@pytest.mark.parametrize("before", [None, "old"])
def test_failed_write_leaves_nothing_new_behind(tmp_path, monkeypatch, step, before):
    path = tmp_path / "file"
    if before is not None:
        path.write_text(before)

    def fail(*args, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(storage.os, step, fail)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, "new")
    left = {p.name: p.read_text() for p in tmp_path.iterdir()}
    assert left == ({} if before is None else {"file": before})


def test_every_truncation_is_noticed(arrays_file):
    content = arrays_file.read_bytes()
    for length in range(0, len(content), 7):
        arrays_file.write_bytes(content[:length])
        with pytest.raises(DamagedFileError, match="damaged or not a safetensors file"):
            read_arrays(arrays_file)


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" + bytes(100), b"PK\x03\x04" * 20])
def test_foreign_files_are_noticed(tmp_path, content):
    path = tmp_path / "foreign.safetensors"
    path.write_bytes(content)
    with pytest.raises(DamagedFileError, match="damaged or not a safetensors file"):
        read_arrays(path)


def test_altered_value_is_noticed_by_the_hash(arrays_file):
    content = bytearray(arrays_file.read_bytes())
    sha256 = hashlib.sha256(content).hexdigest()
    assert read_arrays(arrays_file, sha256).keys() == ARRAYS.keys()
    content[-1] ^= 1
    arrays_file.write_bytes(content)
    with pytest.raises(DamagedFileError, match="do not match the hash"):
        read_arrays(arrays_file, sha256)


@pytest.mark.parametrize("content", [b"", b'{"a": ', b"\xff\xfe", b"not json"])
def test_damaged_json_is_noticed(tmp_path, content):
    path = tmp_path / "metrics.json"
    path.write_bytes(content)
    with pytest.raises(DamagedFileError, match="damaged or not JSON"):
        read_json(path)


@pytest.mark.parametrize("read", [read_json, read_arrays])
def test_missing_file_is_not_a_damaged_one(tmp_path, read):
    with pytest.raises(FileNotFoundError, match="absent"):
        read(tmp_path / "absent")
