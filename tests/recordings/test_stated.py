"""What files state about their data is used, or refused by name and the rest is read."""

import struct
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recording_files import needed
from scipy.io import savemat
from scipy.sparse import csc_array

from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_columns, open_file
from suspnet.trains.trips.file_contents import contents_of

N = 8
VALUES = np.arange(float(N))


def read(path: Path, *names: str | None) -> list[np.ndarray]:
    return [np.concatenate(parts) for parts in zip(*open_columns(path, names), strict=True)]


def unread(path: Path) -> dict[str, str]:
    with open_file(path) as file:
        return {column.name: column.unread for column in file.columns if column.unread}


# MAT


def element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def matlab_object(name: bytes, kind: bytes) -> bytes:
    """Return an object of MATLAB as files before version 7.3 hold it."""
    ids = [(6, struct.pack("<II", 13, 0)), (5, struct.pack("<ii", 1, 1)), (1, b"")]
    content = b"".join(element(*part) for part in [*ids, (6, struct.pack("<I", 7))])
    parts = [(6, struct.pack("<II", 17, 0)), (1, name), (1, b"MCOS"), (1, kind), (14, content)]
    return element(14, b"".join(element(*part) for part in parts))


def test_structs_and_cells_are_looked_into(tmp_path):
    path = tmp_path / "a.mat"
    cell, several = np.empty((1, 3), object), np.empty((1, 2), [("a", object)])
    cell[0, :] = [VALUES, "text", {"a": 2 * VALUES, "fs": 100.0}]
    several[0, 0], several[0, 1] = (VALUES,), (3 * VALUES,)
    flags = {"flag": VALUES > 3, "sparse": csc_array(np.eye(3)), "cube": np.zeros((4, 3, 2))}
    savemat(path, {"c": cell, "s": several} | flags)
    for name, factor in (("c[0]", 1), ("c[2].a", 2), ("s[1].a", 3)):
        np.testing.assert_array_equal(read(path, name)[0], factor * VALUES)
    with open_file(path) as file:
        assert file.column("c[2].a").rate_hz == 100.0
    assert unread(path) == {
        "flag": "holds logical, not numbers",
        "sparse": "holds sparse, not numbers",
        "cube": "is an array of 4 x 3 x 2; export it as columns",
    }


def test_scalars_at_the_top_of_matlab_files_state_rate_and_unit(tmp_path):
    path = tmp_path / "a.mat"
    said = {"rate_hz": 500.0, "unit": "g", "start": "2024-05-06 08:00:00", "mass_kg": 3.0}
    savemat(path, {"t": VALUES, "speed": VALUES, "axle_box": VALUES} | said)
    found = {one.name: one for one in contents_of(path).signals}
    assert {name: one.unit for name, one in found.items()} == {"speed": "", "axle_box": "g"}
    assert found["axle_box"].rate_hz == 500.0
    assert found["axle_box"].column.date == "2024-05-06 08:00:00"
    with open_file(path) as file:
        assert file.column("t").unit is None
    savemat(tmp_path / "b.mat", {"axle_box": VALUES, "fs": 500.0})
    np.testing.assert_array_equal(read(tmp_path / "b.mat", None)[0], VALUES)


def test_files_with_objects_of_matlab_or_of_version_7_3_are_refused(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"a": VALUES})
    with path.open("ab") as stream:
        stream.write(matlab_object(b"ts", b"timeseries"))
    with pytest.raises(TripError, match=r"a.mat: holds objects of MATLAB, as timeseries, whose"):
        read(path, "a")
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400))
    with pytest.raises(TripError, match=r"a.mat: is a MAT file of version 7.3; save it with -v7"):
        read(path, "a")
    savemat(path, {"flag": VALUES > 3})
    with pytest.raises(TripError, match=r"no column of numbers: 'flag' holds logical, not"):
        contents_of(path)


# TDMS


def tdms(path: Path, *segments, values=VALUES, group="g", channel="a") -> Path:
    nptdms = needed("nptdms")
    with nptdms.TdmsWriter(path) as writer:
        for start, properties in segments:
            said = {"wf_increment": 0.01, "unit_string": "g"} | properties
            if start is not None:
                said["wf_start_time"] = np.datetime64(f"2024-05-06T08:{start}")
            writer.write_segment([nptdms.ChannelObject(group, channel, values, properties=said)])
    return path


@pytest.mark.parametrize("second", ["15:30.08", "15:30.0804", "15:30", None])
def test_segments_of_tdms_that_follow_each_other_are_one_channel(tmp_path, second):
    path = tdms(tmp_path / "a.tdms", ("15:30", {}), (second, {}), (None, {}))
    with open_file(path) as file:
        assert file.column("g/a").start_ns == 1714983330 * 10**9
    np.testing.assert_array_equal(read(path, "g/a")[0], np.tile(VALUES, 3))


@pytest.mark.parametrize("late_ms", [2, -2, 0.001, -0.001])
def test_short_pauses_and_overlaps_between_segments_of_tdms_add_up(tmp_path, late_ms):
    starts_s = np.arange(30) * (N * 0.01 + late_ms / 1000)
    path = tdms(tmp_path / "a.tdms", *[(f"15:{30 + start_s:09.6f}", {}) for start_s in starts_s])
    assert bool(unread(path)) == (abs(late_ms) > 1)


@pytest.mark.parametrize(
    ("second", "properties", "message"),
    [
        (
            "15:30.04",
            {},
            "'g/a' has segments that do not follow each other: one lasts until .*0.08",
        ),
        ("25:30.08", {}, "segments that do not follow each other: .*starts at .*T08:25:30.08"),
        ("15:30.08", {"wf_increment": 0.02}, "has another 'wf_increment' in a later segment, 0.02"),
        ("15:30.08", {"unit_string": "m/s2"}, "another 'unit_string' in a later segment, m/s2 ins"),
    ],
)
def test_segments_of_tdms_that_contradict_are_refused(tmp_path, second, properties, message):
    path = tdms(tmp_path / "a.tdms", ("15:30", {}), (second, properties))
    with pytest.raises(TripError, match=message):
        read(path, "g/a")


def test_no_channel_of_tdms_is_lost_by_its_name(tmp_path):
    nptdms = needed("nptdms")
    names = [("a/b", "c"), ("a", "b/c"), ("a", "d")]
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(
            [nptdms.ChannelObject(*name, (i + 1) * VALUES) for i, name in enumerate(names)]
        )
    for i, name in enumerate(("/'a/b'/'c'", "/'a'/'b/c'", "a/d")):
        np.testing.assert_array_equal(read(tmp_path / "a.tdms", name)[0], (i + 1) * VALUES)


def test_start_of_1904_is_none(tmp_path):
    said = {"wf_start_time": np.datetime64("1904-01-01T00:00:00")}
    with open_file(tdms(tmp_path / "a.tdms", (None, said))) as file:
        assert file.column("g/a").start_ns is None


def test_unit_and_rate_of_parquet_are_those_of_the_column(tmp_path):
    field = pa.field("a", pa.float64(), metadata={"unit": "g", "rate_hz": "500"})
    pq.write_table(pa.table([VALUES], schema=pa.schema([field])), tmp_path / "a.parquet")
    with open_file(tmp_path / "a.parquet") as file:
        assert (file.column("a").unit, file.column("a").rate_hz) == ("g", 500.0)
