"""Units and rates by the file and by the manifest: taken, agreed, or refused."""

import sys
from pathlib import Path

import numpy as np
import pytest
from recording_files import WRITERS, needed, opened
from scipy.io import savemat, wavfile

from suspnet.trains.recordings.columns import size_of, unit_in_name
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import READERS, open_columns, open_file
from suspnet.trains.recordings.hdf5_files import open_hdf5
from suspnet.trains.recordings.logger_files import open_mdf, open_tdms
from suspnet.trains.recordings.manifest_sources import SensorSource, SpeedSource
from suspnet.trains.recordings.record_files import open_uff

STATING = (".h5", ".tdms", ".mf4", ".uff")
"""Formats in which unit and rate may stand."""


def written(tmp_path, suffix, **said) -> Path:
    path = tmp_path / f"data{suffix}"
    WRITERS[suffix](path, {"a": np.arange(9.0)}, **said)
    return path


@pytest.mark.parametrize("suffix", STATING)
@pytest.mark.parametrize(("unit", "size"), [("g", 9.80665), ("m/s^2", 1.0), ("mg", 9.80665e-3)])
def test_unit_and_rate_are_those_of_the_file(tmp_path, suffix, unit, size):
    path = written(tmp_path, suffix, unit=unit, rate_hz=250.0)
    with opened(path, SensorSource(path.name, sign=-1, range=2.0)) as source:
        assert source.size == pytest.approx(-size)
        assert source.full_scale == pytest.approx(2 * size)
        assert source.rate_hz == (None if suffix == ".mf4" else pytest.approx(250.0))
        parts = [np.concatenate(part) for part in zip(*source.blocks(), strict=True)]
        np.testing.assert_array_equal(parts[-1], np.arange(9.0))
        if suffix == ".mf4":
            np.testing.assert_allclose(parts[0], np.arange(9) / 250)


def refuses(path, source, message):
    """Check that a source is refused with a message."""
    with pytest.raises(TripError, match=message), opened(path, source):
        pass


@pytest.mark.parametrize("suffix", STATING)
def test_contradictions_and_unknown_units_are_refused(tmp_path, suffix):
    path = written(tmp_path, suffix, unit="g", rate_hz=250.0)
    refuses(path, SensorSource(path.name, "m/s2"), "here: `unit` says 'm/s2', its file says 'g'")
    with opened(path, SensorSource(path.name, "g", rate_hz=250.001)) as source:
        assert source.size == 9.80665
        assert source.rate_hz == 250.001
    if suffix != ".mf4":  # its times are checked as they are read
        other = SensorSource(path.name, "g", rate_hz=251.0)
        refuses(path, other, "here: `rate_hz` says 251 Hz, its file says 250 Hz")
    path.unlink()
    path = written(tmp_path, suffix, unit="V", rate_hz=250.0)
    with opened(path, SensorSource(path.name, "g")) as source:
        assert source.words.endswith("is taken in g, its file says 'V'")
    refuses(
        path,
        SensorSource(path.name),
        r"`unit` is missing, and the file says 'V', which is not known",
    )


def test_missing_unit_and_rate_are_named(tmp_path):
    path = written(tmp_path, ".csv")
    refuses(
        path,
        SensorSource(path.name, rate_hz=9.0),
        "`unit` is missing, and the file does not say it",
    )
    refuses(
        path, SensorSource(path.name, "g"), r"needs `rate_hz` or `time` .*: data.csv does not say"
    )


def test_speed_has_units_of_its_own(tmp_path):
    path = written(tmp_path, ".tdms", unit="knots", rate_hz=1.0)
    with opened(path, SpeedSource(path.name)) as source:
        assert source.size == pytest.approx(0.514444, rel=1e-5)
    refuses(path, SensorSource(path.name), "says 'knots'")


@pytest.mark.parametrize(
    ("dtype", "level", "full"), [("int16", 0, 2**15), ("int32", 0, 2**31), ("uint8", 128, 2**7)]
)
def test_integers_of_wav_files_are_fractions_of_range(tmp_path, dtype, level, full):
    path = tmp_path / "data.wav"
    values = (level + full * np.array([[0.5, 0], [-0.25, 0]])).astype(dtype)
    wavfile.write(path, 1000, values)
    with opened(path, SensorSource(path.name, "g", "channel_1", range=4.0)) as source:
        (block,) = source.blocks()
        np.testing.assert_allclose(source.size * block[0], 9.80665 * np.array([2.0, -1.0]))
        assert source.full_scale == pytest.approx(4 * 9.80665)
        assert source.rate_hz == 1000.0
    without = SensorSource("data.wav", "g", "channel_1")
    refuses(path, without, "'channel_1' holds integers, which are fractions of full scale")
    with opened(
        path, SensorSource(path.name, "g", "channel_1", rate_hz=1000.4, range=1.0)
    ) as source:
        assert source.rate_hz == 1000.4  # a WAV file holds whole numbers


def test_structs_and_matrices_have_columns(tmp_path):
    path = tmp_path / "data.mat"
    box = {"data": np.arange(4.0), "fs": 500.0, "units": "m/s^2"}
    savemat(path, {"trip": {"box": box, "name": "x"}, "m": np.arange(8.0).reshape(4, 2), "n": 3.0})
    with open_file(path) as file:
        names = [column.name for column in file.columns]
        assert names == ["m[0]", "m[1]", "n", "trip.box.data"]
        column = file.column("trip.box.data")
        assert (column.unit, column.rate_hz) == ("m/s^2", 500.0)
    np.testing.assert_array_equal(next(open_columns(path, ["m[1]"]))[0], [1, 3, 5, 7])
    with pytest.raises(TripError, match=r"no column 'm' .*it has \['m\[0\]', 'm\[1\]', 'n', "):
        next(open_columns(path, ["m"]))


@pytest.mark.parametrize(
    ("suffix", "reader", "module", "extra"),
    [
        (".mf4", open_mdf, "asammdf", "mdf"),
        (".tdms", open_tdms, "nptdms", "tdms"),
        (".uff", open_uff, "pyuff", "uff"),
        (".h5", open_hdf5, "h5py", "hdf5"),
    ],
)
def test_missing_extra_is_named(tmp_path, monkeypatch, suffix, reader, module, extra):
    monkeypatch.setitem(READERS, suffix, reader)  # not in another process
    monkeypatch.setitem(sys.modules, module, None)
    path = tmp_path / f"data{suffix}"
    path.write_bytes(b"MDF     ")
    refuses(path, SensorSource(path.name), rf'needs {module}; run: pip install -e ".\[{extra}\]"')


def test_channels_of_two_groups_are_not_mixed(tmp_path):
    asammdf = needed("asammdf")
    path = tmp_path / "data.mf4"
    with asammdf.MDF() as file:
        for n in (3, 4):
            at = np.arange(n) * 1.0
            file.append([asammdf.Signal(at, at, name="a"), asammdf.Signal(at, at, name=f"b{n}")])
        file.save(path)
    with open_file(path) as file:
        names = [column.name for column in file.columns]
        assert names == ["group_0/time", "group_0/a", "b3", "group_1/time", "group_1/a", "b4"]
        assert file.column("b4").time == "group_1/time"
    assert len(next(open_columns(path, ["group_1/time", "b4"]))[0]) == 4
    with pytest.raises(TripError, match="are not of one channel group"):
        next(open_columns(path, ["b3", "b4"]))


@pytest.mark.parametrize(
    ("kind", "text", "size"),
    [
        ("acceleration", "m/s²", 1.0),
        ("acceleration", "[m·s⁻²]", 1.0),
        ("acceleration", "mm/s2", 1e-3),
        ("acceleration", "V", None),
        ("acceleration", "", None),
        ("acceleration", None, None),
        ("speed", "km/h", 1 / 3.6),
        ("speed", "Knots", 1852 / 3600),
        ("time", "µs", 1e-6),
    ],
)
def test_spellings_of_units(kind, text, size):
    assert size_of(kind, text) == (None if size is None else pytest.approx(size))


def test_unit_in_a_name():
    names = ["a [g]", "a (m/s²) ", "a [7]", "a", "time [ms]"]
    assert [unit_in_name(name) for name in names] == ["g", "m/s²", "", "", "ms"]
