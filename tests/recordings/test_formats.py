"""Columns come out of every format as they went in, and damaged files are named."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from recording_files import WRITERS
from scipy.io import savemat

from suspnet.trains.recordings import columns as columns_module
from suspnet.trains.recordings import formats
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import CSV_SUFFIXES, open_columns


def read(path: Path, *columns: str | None) -> list[np.ndarray]:
    blocks = list(open_columns(path, columns))
    assert all(column.dtype == np.float64 for block in blocks for column in block)
    assert all(1 <= len(block[0]) <= formats.BLOCK for block in blocks)
    return [np.concatenate(parts) for parts in zip(*blocks, strict=True)]


def named(suffix: str, name: str, place: int = 0) -> str:
    """Return how a file names the column that was written as `name`, the nth of the file."""
    if suffix == ".wav":
        return f"channel_{place + 1}"
    return f"g/{name}" if suffix == ".tdms" else name


def test_every_format_is_tested():
    assert set(WRITERS) == set(formats.READERS)


@pytest.mark.every_value
@pytest.mark.parametrize("kind", ["float64", "float32", "int16", "uint8", "int64"])
@pytest.mark.parametrize("suffix", WRITERS)
def test_columns_are_read_in_the_order_asked_for(tmp_path, monkeypatch, suffix, kind):
    monkeypatch.setattr(columns_module, "BLOCK", 4)
    a, t = np.arange(11).astype(kind), np.arange(11) * 0.5
    path = tmp_path / f"data{suffix.upper()}"
    WRITERS[suffix](path, {"t": t, "a": a, "other": t})
    got_a, got_t = read(path, named(suffix, "a", 1), named(suffix, "t"))
    np.testing.assert_array_equal(got_a, a.astype(np.float64))
    np.testing.assert_array_equal(got_t, t)


@pytest.mark.parametrize("suffix", WRITERS)
def test_column_may_be_left_out_if_it_is_the_only_one(tmp_path, suffix):
    path = tmp_path / f"data{suffix}"
    WRITERS[suffix](path, {"t": np.arange(9.0), "a": -np.arange(9.0)})
    np.testing.assert_array_equal(read(path, named(suffix, "t"), None)[1], -np.arange(9.0))
    with pytest.raises(
        TripError, match=r"say which `column` to read; there are \['.*[ta1]', '.*[ta2]'\]"
    ):
        read(path, None)


@pytest.mark.parametrize("suffix", WRITERS)
def test_missing_column_is_named(tmp_path, suffix):
    path = tmp_path / f"data{suffix}"
    WRITERS[suffix](path, {"t": np.arange(9.0), "a": np.arange(9.0)})
    with pytest.raises(
        TripError, match=r"data.* has no column 'b' .*it has \[.*'.*[ta1]', '.*[ta2]'\]"
    ):
        read(path, "b")


@settings(max_examples=8)
@given(hnp.arrays(np.float32, st.integers(1, 40), elements=st.floats(width=32)), st.integers(1, 9))
def test_parquet_keeps_every_value(tmp_path_factory, values, rows):
    path = tmp_path_factory.mktemp("parquet") / "data.parquet"
    pq.write_table(pa.table({"a": values}), path, row_group_size=rows)
    np.testing.assert_array_equal(read(path, "a")[0], values.astype(np.float64))


@pytest.mark.parametrize("kind", [pa.float32(), pa.int16()])
def test_nulls_become_nan(tmp_path, kind):
    path = tmp_path / "data.parquet"
    pq.write_table(pa.table({"a": pa.array([1, None, 3], kind)}), path)
    np.testing.assert_array_equal(read(path, "a")[0], [1.0, np.nan, 3.0])
    path = tmp_path / "data.csv"
    path.write_text("a,b\n1,2\n,2\nNaN,2\n4,2\n")
    np.testing.assert_array_equal(read(path, "a")[0], [1.0, np.nan, np.nan, 4.0])


@pytest.mark.parametrize("values", [["1", "x"], [True, False], [[1.0], [2.0]]])
def test_parquet_column_must_be_numeric(tmp_path, values):
    pq.write_table(pa.table({"a": values}), tmp_path / "data.parquet")
    with pytest.raises(TripError, match=r"data\.parquet: column 'a' holds .*, not numbers"):
        read(tmp_path / "data.parquet", "a")


def test_mat_columns_must_be_real_vectors_of_one_length(tmp_path):
    path = tmp_path / "data.mat"
    savemat(path, {"z": np.ones(4) * 1j, "m": np.ones((2, 2)), "s": "text", "a": [1.0, 2], "t": 1})
    with pytest.raises(TripError, match=r"column 'z' holds complex128, not real numbers"):
        read(path, "z")
    with pytest.raises(TripError, match=r"no column 'm' of numbers; it has \['z', 'm\[0\]', "):
        read(path, "m")
    with pytest.raises(TripError, match=r"columns \['t', 'a'\] have different lengths \[1, 2\]"):
        read(path, "t", "a")


def test_repeated_column_is_refused(tmp_path):
    (tmp_path / "data.csv").write_text("a,a\n1,2\n")
    with pytest.raises(TripError, match=r"has no column 'a' of numbers; it has \['a.1', 'a.2'\]"):
        read(tmp_path / "data.csv", "a")
    pq.write_table(pa.Table.from_arrays([[1.0], [2.0]], ["a", "a"]), tmp_path / "data.parquet")
    with pytest.raises(TripError, match=r"has 2 columns 'a'; rename them"):
        read(tmp_path / "data.parquet", "a")


@pytest.mark.parametrize("suffix", WRITERS)
def test_columns_without_samples_are_refused(tmp_path, suffix):
    path = tmp_path / f"data{suffix}"
    WRITERS[suffix](path, {"a": np.empty(0)})
    with pytest.raises(TripError, match=rf"data\{suffix}.*(empty|has no column|cut off)"):
        read(path, named(suffix, "a"))


@pytest.mark.every_value
@pytest.mark.parametrize(
    "content",
    [b"", b"\x00" * 300, b"not what it seems\n" * 30, b"TDSm" * 9, b"cos\nsystem\n(S'true'\ntR."],
)
@pytest.mark.parametrize("suffix", WRITERS)
def test_foreign_files_are_refused(tmp_path, suffix, content):
    path = tmp_path / f"data{suffix}"
    path.write_bytes(content)
    with pytest.raises(TripError, match=rf"data\{suffix}"):
        read(path, named(suffix, "a"))


@pytest.mark.every_value
@pytest.mark.parametrize("suffix", [suffix for suffix in WRITERS if suffix not in CSV_SUFFIXES])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.9])
def test_truncated_files_are_refused(tmp_path, suffix, kept):
    path = tmp_path / f"data{suffix}"
    WRITERS[suffix](path, {"a": np.random.default_rng(0).standard_normal(3000)})
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(TripError, match=rf"data\{suffix}"):
        read(path, named(suffix, "a"))


def test_missing_and_unknown_files_are_refused(tmp_path):
    with pytest.raises(TripError, match=r"gone\.csv: there is no such file"):
        read(tmp_path / "gone.csv", "a")
    with pytest.raises(
        TripError, match=r"files of type '\.xls' cannot be read; give \['\.asc', '\.csv'"
    ):
        read(tmp_path / "data.xls", "a")
