"""What a recording of hours may declare is read, also where nearly all of it is zeros."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from suspnet.trains.recordings import columns
from suspnet.trains.recordings.columns import FREE_SAMPLES, MOST_SAMPLES, SAMPLES_PER_BYTE
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_columns

RATE_HZ, MINUTES = 5000, 10


PACKED = {
    ".mat": lambda path, values: savemat(path, {"a": values}, do_compression=True),
    ".parquet": lambda path, values: pq.write_table(
        pa.table({"a": values}), path, compression="zstd"
    ),
}


def count(path):
    return sum(len(block[0]) for block in open_columns(path, ["a"]))


@pytest.mark.parametrize("suffix", [".mat", pytest.param(".parquet", marks=pytest.mark.slow)])
def test_channel_of_nothing_but_zeros_is_read(tmp_path, suffix):
    path, n = tmp_path / f"data{suffix}", RATE_HZ * 60 * MINUTES
    PACKED[suffix](path, np.zeros(n))
    assert path.stat().st_size < n / 20
    assert count(path) == n


@pytest.mark.slow
@pytest.mark.parametrize("suffix", PACKED)
def test_hours_with_a_few_minutes_of_signal_are_read(tmp_path, suffix):
    values = np.zeros(RATE_HZ * 3600 * 5, np.float32)
    signal = np.random.default_rng(0).standard_normal(RATE_HZ * 60 * MINUTES)
    values[: len(signal)] = signal
    assert len(values) > FREE_SAMPLES
    path = tmp_path / f"data{suffix}"
    PACKED[suffix](path, values)
    assert count(path) == len(values)


@pytest.mark.parametrize("stored", [0, 10**6])
def test_bound_follows_the_stored_bytes(tmp_path, stored):
    path = tmp_path / "data"
    path.write_bytes(np.random.default_rng(0).bytes(stored))
    os.truncate(path, 10**10)  # a hole stores nothing
    columns.check_samples(path, FREE_SAMPLES + SAMPLES_PER_BYTE * stored)
    with pytest.raises(TripError, match=r"data declares 10000000000 samples"):
        columns.check_samples(path, 10**10)
    with pytest.raises(TripError, match="at most"):
        columns.check_samples(path, FREE_SAMPLES + SAMPLES_PER_BYTE * (stored + 2**16 + 1))


def test_no_file_may_declare_more_than_two_days(tmp_path, monkeypatch):
    (tmp_path / "data").write_bytes(b"x")
    monkeypatch.setattr(columns, "stored_bytes", lambda _: 10**12)
    columns.check_samples(tmp_path / "data", MOST_SAMPLES)
    with pytest.raises(TripError, match="at most 1728000000"):
        columns.check_samples(tmp_path / "data", MOST_SAMPLES + 1)


def test_a_file_that_streams_more_than_it_may_is_stopped(tmp_path, monkeypatch):
    (tmp_path / "data.csv").write_text("a\n" + "1\n" * 5000)
    monkeypatch.setattr(columns, "FREE_SAMPLES", 100)
    monkeypatch.setattr(columns, "SAMPLES_PER_BYTE", 0)
    with pytest.raises(TripError, match=r"data\.csv declares 5000 samples"):
        count(tmp_path / "data.csv")


def test_memory_and_time_grow_with_the_file():
    assert (columns.memory_bytes(0), columns.memory_bytes(10**9) > 16e9) == (1.25 * 2**30, True)
    assert [columns.step_s(n) for n in (0, 10**8, 10**12)] == [20.0, 120.0, 300.0]
