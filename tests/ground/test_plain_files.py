"""What is no plain file, or far too large, is refused at once wherever a path is read."""

import json
import os
import socket
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from suspnet.estimation.checkpoint import SCHEMA_VERSION, load_model
from suspnet.estimation.fitted import ModelFileError
from suspnet.ground import storage
from suspnet.ground.storage import (
    DamagedFileError,
    NotPlainError,
    content_hash,
    open_plain,
    read_arrays,
    read_json,
    read_plain,
    stored_bytes,
)
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest_files import read_manifest

SECONDS = 5.0


def pipe(path: Path) -> None:
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


def connection(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def hole(path: Path) -> None:
    path.write_bytes(b"")
    os.truncate(path, 2**40)


OTHERS = [pipe, endless, folder, connection, hole]


@pytest.fixture(autouse=True)
def quick():
    """Fail if a test takes long, even if it waits where no exception gets through."""
    start = time.monotonic()
    yield
    assert time.monotonic() - start < SECONDS


@pytest.mark.parametrize("make", OTHERS)
@pytest.mark.parametrize("read", [read_json, read_arrays, read_plain])
def test_what_is_no_plain_file_is_refused_at_once(tmp_path, make, read):
    make(tmp_path / "file")
    with pytest.raises((DamagedFileError, NotPlainError), match=r"file is (a|of) .*") as caught:
        read(tmp_path / "file")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("make", [pipe, hole])
def test_model_whose_arrays_are_no_plain_file_is_refused_at_once(tmp_path, make):
    content = {"schema_version": SCHEMA_VERSION, "model": "msvr", "arrays_sha256": "0"}
    content["description_sha256"] = content_hash(content)
    (tmp_path / "model.json").write_text(json.dumps(content))
    make(tmp_path / "model.safetensors")
    with pytest.raises(ModelFileError, match=r"model\.safetensors is (a|of) .*train again"):
        load_model(tmp_path)


def test_pipe_that_takes_the_place_of_a_checked_file_is_refused(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "file")
    plain = os.stat(__file__)  # what the first look sees
    monkeypatch.setattr(storage.os, "stat", lambda _: plain)
    with pytest.raises(NotPlainError, match="a named pipe"):
        open_plain(tmp_path / "file")


def test_json_nested_deeply_or_with_a_huge_number_is_damaged(tmp_path):
    n_nested = 10**6
    (tmp_path / "file").write_text("[" * n_nested)
    with pytest.raises(DamagedFileError, match="nested too deeply"):
        read_json(tmp_path / "file")
    (tmp_path / "file").write_text("9" * n_nested)
    with pytest.raises(DamagedFileError, match="file is damaged or not JSON"):
        read_json(tmp_path / "file")


@pytest.mark.parametrize("size", [0, 2**40, 2**64 - 1])
def test_header_of_arrays_longer_than_the_file_is_damaged(tmp_path, size):
    (tmp_path / "file").write_bytes(struct.pack("<Q", size) + b"{}")
    with pytest.raises(DamagedFileError, match="file is damaged or not a safetensors file"):
        read_arrays(tmp_path / "file")


@pytest.mark.parametrize("shape", [[10**12], [2**31, 2**31], [2**64]])
def test_arrays_that_the_file_does_not_hold_are_damaged(tmp_path, shape):
    header = json.dumps({"a": {"dtype": "F64", "shape": shape, "data_offsets": [0, 0]}}).encode()
    (tmp_path / "file").write_bytes(struct.pack("<Q", len(header)) + header)
    try:
        assert sum(array.size for array in read_arrays(tmp_path / "file").values()) == 0
    except DamagedFileError as error:
        assert "is damaged or not a safetensors file" in str(error)  # noqa: PT017


@pytest.mark.parametrize("key", ["mileage_km", "channels", "<<"])
def test_aliases_of_aliases_are_refused_before_they_are_written_out(tmp_path, key):
    laughs = ["a0: &a0 [ha]", *(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]" for i in range(1, 15))]
    (tmp_path / "trip.yaml").write_text("\n".join([*laughs, f"{key}: *a14"]))
    with pytest.raises(TripError, match="has more than 262144 values") as caught:
        read_manifest(tmp_path / "trip.yaml")
    assert len(str(caught.value)) < 500


def test_bytes_of_holes_are_not_stored(tmp_path):
    for name, before in (("start", 0), ("middle", 2**20)):
        path = tmp_path / name
        path.write_bytes(b"")
        os.truncate(path, before)
        with path.open("ab") as stream:
            stream.write(np.random.default_rng(0).bytes(2**16))
        os.truncate(path, 2**30)
        with open_plain(path) as stream:
            stream.read(10)
            assert 2**16 <= stored_bytes(stream) < 2**19
            assert stream.tell() == 10
