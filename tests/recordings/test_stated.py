"""What files state about their data is used, or refused by name and the rest is read."""

import struct
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recording_files import hdf5_file, needed, opened, write_uff, write_wav
from scipy.io import savemat
from scipy.sparse import csc_array

from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_columns, open_file
from suspnet.trains.recordings.manifest_sources import SensorSource
from suspnet.trains.trips.file_contents import contents_of

N = 8
VALUES = np.arange(float(N))


def read(path: Path, *names: str | None) -> list[np.ndarray]:
    return [np.concatenate(parts) for parts in zip(*open_columns(path, names), strict=True)]


def unread(path: Path) -> dict[str, str]:
    with open_file(path) as file:
        return {column.name: column.unread for column in file.columns if column.unread}


# HDF5


def hdf5(path: Path, **attributes):
    """Return an HDF5 file that is open for writing, with integers as `a`."""
    file = needed("h5py").File(path, "w")
    file["a"] = np.arange(N, dtype="i2")
    file["a"].attrs.update(attributes)
    return file


CALIBRATED = [  # stored numbers, their attributes, and the samples
    (VALUES, {"scale_factor": [0.5], "add_offset": -1.0}, 0.5 * VALUES - 1),
    (VALUES, {"_FillValue": 3.0, "scale_factor": 3.0}, [0, 3, 6, np.nan, 12, 15, 18, 21]),
    (VALUES, {"missing_value": [0, 7]}, [np.nan, 1, 2, 3, 4, 5, 6, np.nan]),
    (VALUES, {"valid_range": [1, 6]}, [np.nan, 1, 2, 3, 4, 5, 6, np.nan]),
    (VALUES, {"valid_min": 1, "valid_max": 6.0}, [np.nan, 1, 2, 3, 4, 5, 6, np.nan]),
    (np.float32([1, -9999.9]), {"_FillValue": -9999.9}, [1, np.nan]),
    (np.int8([1, -1]), {"_Unsigned": "true", "_FillValue": np.int8(-1)}, [1, np.nan]),
    (np.uint8([1, 241]), {"_FillValue": -9999}, [1, 241]),
]


@pytest.mark.parametrize(("stored", "attributes", "expected"), CALIBRATED)
def test_scale_and_missing_samples_of_hdf5_are_applied(tmp_path, stored, attributes, expected):
    with hdf5(tmp_path / "a.h5") as file:
        file["b"] = stored
        file["b"].attrs.update(attributes)
    np.testing.assert_array_equal(read(tmp_path / "a.h5", "b")[0], expected)


@pytest.mark.parametrize("name", ["Gain", "Scale_Factor"])
def test_attributes_of_hdf5_without_a_convention_are_named(tmp_path, name):
    hdf5(tmp_path / "a.h5", **{name: 10.0, "unit": "g"}).close()
    words = f"a.h5: attributes that are not applied: 'a.{name}'"
    assert contents_of(tmp_path / "a.h5").read_as == words


@pytest.mark.parametrize("scale", [np.nan, 0, [1, 2]])
def test_scales_that_cannot_be_are_refused_by_name(tmp_path, scale):
    with hdf5(tmp_path / "a.h5") as file:
        file["b"] = np.ones((N, 3))
        file["b"].attrs["scale_factor"] = scale
    assert unread(tmp_path / "a.h5")["b"].startswith("cannot be read (its scale_factor is [")


def test_foreign_objects_of_hdf5_are_named_and_the_rest_is_read(tmp_path):
    h5py = needed("h5py")
    path = tmp_path / "a.h5"
    with hdf5(path) as file:
        space = h5py.h5s.create_simple((N,))
        h5py.h5d.create(file.id, b"moments", h5py.h5t.UNIX_D32LE.copy(), space)
        file.create_dataset("filled", (N,), "i2", fillvalue=-99)[:4] = VALUES[:4]
        file["empty"] = h5py.Empty("f8")
        file["complex"], file["cube"] = 1j * VALUES, np.zeros((4, 3, 2))
        file["scaled"] = VALUES
        file["scaled"].attrs["scale_factor"] = "a half"
        kinds = [("t", "f8"), ("a", "f4"), ("pair", "f8", 2), ("name", "S3"), ("in", [("x", "f8")])]
        file["table"] = np.zeros(N, kinds)
        file["table"].attrs["unit"] = "g"  # of which field?
    reasons = unread(path)
    starts = {
        "moments": "cannot be read (No NumPy equivalent",
        "empty": "is without samples: its space is null",
        "cube": "is an array of 4 x 3 x 2; export it as columns",
        "scaled": "cannot be read (could not convert string",
        "complex": "holds complex128, not real numbers",
        "table.in": "",
    }
    assert set(reasons) == set(starts)
    assert all(reasons[name].startswith(start) for name, start in starts.items())
    assert "a.h5: not read: 'complex' holds complex128" in contents_of(path).read_as
    with open_file(path) as file:
        fields = [column.name for column in file.columns if column.name.startswith("table")]
        assert fields == ["table.in", "table.t", "table.a", "table.pair[0]", "table.pair[1]"]
        assert file.column("table.a").unit is None
    np.testing.assert_array_equal(read(path, "filled")[0], [*VALUES[:4], *[np.nan] * 4])
    np.testing.assert_array_equal(read(path, "table.pair[1]")[0], 0 * VALUES)


@pytest.mark.parametrize(
    ("unit", "start_ns"),
    [("milliseconds since 2024-05-06 08:15:30 UTC", 1714983330 * 10**9), ("s", None)],
)
def test_times_of_netcdf_are_those_of_their_data_sets(tmp_path, unit, start_ns):
    with hdf5(tmp_path / "a.h5", units="g") as file:
        file["x"] = 4 * VALUES
        file["x"].attrs["units"] = unit
        file["x"].make_scale("x")
        file["a"].dims[0].attach_scale(file["x"])
    with open_file(tmp_path / "a.h5") as file:
        assert (file.column("a").unit, file.column("a").time) == ("g", "x")
        assert file.column("x").unit == unit.split(" since ")[0]
        assert file.column("x").start_ns == start_ns
    with opened(tmp_path / "a.h5", SensorSource("a.h5", column="a")) as source:
        next(source.blocks())
        assert source.zero.ns == start_ns


def test_mat_files_of_version_7_3_are_hdf5(tmp_path):
    h5py = needed("h5py")
    path = tmp_path / "a.mat"
    with hdf5_file(path) as file:
        file["trip/box"], file["trip/fs"] = VALUES[None], np.array([[500.0]])
        file["trip/unit"] = np.array([[ord(c)] for c in "m/s2"], dtype=np.uint16)
        file["trip/unit"].attrs.update(MATLAB_class=np.bytes_("char"), MATLAB_int_decode=2)
        file["#refs#/x"], file["#refs#/g/y"] = VALUES[None], 2 * VALUES[None]
        file["c"] = np.array([[file["#refs#/x"].ref], [file["#refs#/g"].ref]], h5py.ref_dtype)
        file["ts"] = np.arange(6, dtype="u4")
        file["ts"].attrs.update(MATLAB_class=np.bytes_("timeseries"), MATLAB_object_decode=3)
    with open_file(path) as file:
        assert {column.name for column in file.columns} == {"trip/box", "c[0]", "c[1]/y", "ts"}
        column = file.column("trip/box")
        assert (column.unit, column.rate_hz) == ("m/s2", 500.0)
    assert unread(path)["ts"].startswith("is an object of MATLAB (timeseries), whose content only")
    np.testing.assert_array_equal(read(path, "trip/box", "c[1]/y"), [VALUES, 2 * VALUES])


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


def test_files_with_objects_of_matlab_are_refused(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"a": VALUES})
    with path.open("ab") as stream:
        stream.write(matlab_object(b"ts", b"timeseries"))
    with pytest.raises(TripError, match=r"a.mat: holds objects of MATLAB, as timeseries, whose"):
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


def test_unit_and_rate_of_parquet_are_those_of_the_column(tmp_path):
    field = pa.field("a", pa.float64(), metadata={"unit": "g", "rate_hz": "500"})
    pq.write_table(pa.table([VALUES], schema=pa.schema([field])), tmp_path / "a.parquet")
    with open_file(tmp_path / "a.parquet") as file:
        assert (file.column("a").unit, file.column("a").rate_hz) == ("g", 500.0)


# universal files


@pytest.mark.parametrize(
    ("said", "unit", "rate_hz", "time_unit"),
    [
        ({}, None, 4.0, None),
        ({"abscissa_axis_units_lab": "ms"}, None, 4000.0, None),
        ({"abscissa_min": 2.5, "abscissa_axis_units_lab": "ms"}, None, None, "ms"),
        ({"units_code": 5}, "mm/s2", 4.0, None),
        ({"abscissa_axis_units_lab": "km"}, None, None, None),
    ],
)
def test_axes_of_universal_files_are_as_stated(tmp_path, said, unit, rate_hz, time_unit):
    path = tmp_path / "a.uff"
    write_uff(path, {"a": VALUES}, rate_hz=4.0, **said)
    with open_file(path) as file:
        column = file.column("a")
        assert (column.unit, column.rate_hz) == (unit, rate_hz)
        if time_unit:
            assert file.column(column.time).unit == time_unit
            np.testing.assert_allclose(read(path, column.time)[0], 2.5 + VALUES / 4)


@pytest.mark.parametrize(
    ("kind", "n_declared", "abscissa", "refusal"),
    [
        (4, 5, 17, ""),
        (4, 9, 17, "column 'a' declares 9 points and holds 8: it is cut off"),
        (6, 4, 17, "'a' holds complex128, not real numbers"),
        (4, N, 18, "'a' is a function of something else than time; export"),
    ],
)
def test_records_of_universal_files(tmp_path, kind, n_declared, abscissa, refusal):
    path = tmp_path / "a.uff"
    write_uff(path, {"a": VALUES}, abscissa_spec_data_type=abscissa)
    form = b"%10d%10d%10d"  # kind of numbers, number of points, even spacing
    path.write_bytes(path.read_bytes().replace(form % (4, N, 1), form % (kind, n_declared, 1)))
    with pytest.raises(TripError, match=refusal) if refusal else nullcontext():
        np.testing.assert_array_equal(read(path, "a")[0], VALUES[:n_declared])


def test_wav_files_of_24_bits_and_of_a_wrong_length(tmp_path):
    path = tmp_path / "a.wav"
    write_wav(path, {"a": VALUES}, date="2024-05-0608:15:30")
    with open_file(path) as file:
        assert file.column("channel_1").date == "2024-05-06 08:15:30"
    head = b"WAVEfmt " + struct.pack("<IHHIIHH", 16, 1, 1, 1000, 3000, 3, 24)
    for n_bytes in (6, 600):
        content = head + b"data" + struct.pack("<I", n_bytes) + bytes.fromhex("0000400000e0")
        path.write_bytes(b"RIFF" + struct.pack("<I", len(content)) + content)
        if n_bytes == 6:
            np.testing.assert_array_equal(read(path, None)[0], [0.5, -0.25])
        else:
            with pytest.raises(TripError, match=r"a\.wav is damaged, cut off or not a \.wav file"):
                read(path, None)
