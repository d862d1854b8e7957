"""What a recording of hours may declare is read, also where nearly all of it is zeros."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from suspnet.recordings import columns as bounds
from suspnet.recordings.columns import (
    FREE_SAMPLES,
    MOST_SAMPLES,
    SAMPLES_PER_BYTE,
    check_samples,
    memory_bytes,
    most_samples,
    step_s,
)
from suspnet.recordings.errors import TripError
from suspnet.recordings.formats import open_columns

RATE_HZ, MINUTES = 5000, 10


def write_hdf5(path, values):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file.create_dataset("a", data=values, compression="gzip", compression_opts=1)


def write_parquet(path, values):
    pq.write_table(pa.table({"a": values}), path, compression="zstd")


def write_mat(path, values):
    savemat(path, {"a": values}, do_compression=True)


PACKED = {".h5": write_hdf5, ".mat": write_mat, ".parquet": write_parquet}


def count(path):
    return sum(len(block[0]) for block in open_columns(path, ["a"]))


@pytest.mark.parametrize(
    "suffix", [".h5", *(pytest.param(s, marks=pytest.mark.slow) for s in (".mat", ".parquet"))]
)
def test_channel_of_nothing_but_zeros_is_read(tmp_path, suffix):
    n = RATE_HZ * 60 * MINUTES
    PACKED[suffix](tmp_path / f"data{suffix}", np.zeros(n))
    assert (tmp_path / f"data{suffix}").stat().st_size < n / 20
    assert count(tmp_path / f"data{suffix}") == n


@pytest.mark.slow
@pytest.mark.parametrize("suffix", PACKED)
def test_hours_with_a_few_minutes_of_signal_are_read(tmp_path, suffix):
    values = np.zeros(RATE_HZ * 3600 * 5, np.float32)
    signal = np.random.default_rng(0).standard_normal(RATE_HZ * 60 * MINUTES)
    values[: len(signal)] = signal
    assert len(values) > FREE_SAMPLES
    path = tmp_path / f"data{suffix}"
    PACKED[suffix](path, values)
    print(f"{suffix}: {len(values)} samples in {path.stat().st_size} bytes")
    assert count(path) == len(values)


@pytest.mark.parametrize("stored", [0, 1000, 10**6])
def test_bound_follows_what_is_stored(tmp_path, stored):
    (tmp_path / "data").write_bytes(np.random.default_rng(0).bytes(stored))
    os.truncate(tmp_path / "data", 10**10)  # a hole stores nothing
    assert most_samples(tmp_path / "data") - FREE_SAMPLES == pytest.approx(
        SAMPLES_PER_BYTE * stored, abs=SAMPLES_PER_BYTE * 2**16
    )
    check_samples(tmp_path / "data", FREE_SAMPLES)
    with pytest.raises(TripError, match=r"data declares 10000000000 samples in one column; at mo"):
        check_samples(tmp_path / "data", 10**10)


def test_no_file_may_declare_more_than_two_days(tmp_path, monkeypatch):
    (tmp_path / "data").write_bytes(b"x")
    monkeypatch.setattr(bounds, "stored_bytes", lambda _: 10**12)
    check_samples(tmp_path / "data", MOST_SAMPLES)
    with pytest.raises(TripError, match="at most 1728000000 are read"):
        check_samples(tmp_path / "data", MOST_SAMPLES + 1)


def test_a_file_that_streams_more_than_it_may_is_stopped(tmp_path, monkeypatch):
    (tmp_path / "data.csv").write_text("a\n" + "1\n" * 5000)
    monkeypatch.setattr(bounds, "FREE_SAMPLES", 100)
    monkeypatch.setattr(bounds, "SAMPLES_PER_BYTE", 0)
    with pytest.raises(TripError, match=r"data\.csv declares 5000 samples in one column"):
        list(open_columns(tmp_path / "data.csv", ["a"]))


def test_memory_and_time_grow_with_the_file():
    assert memory_bytes(0) == 1.25 * 2**30
    assert memory_bytes(10**9) > 16e9
    assert step_s(0) == 20.0
    assert step_s(10**8) == 120.0
    assert step_s(10**12) == 300.0
