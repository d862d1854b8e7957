"""Conversions of MDF files: those that are arithmetic give what they say, others are refused."""

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from recording_files import needed

from suspnet.trains.recordings.columns import BLOCK
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_columns, open_file

asammdf = needed("asammdf")
RAW = np.array([0, 1, 2, 3, 5, 8, 13, 21, 200, 255])
TABLE = {"raw_0": 1.0, "phys_0": 10.0, "raw_1": 2.0, "phys_1": 30.0, "raw_2": 8.0, "phys_2": -5.0}
RANGES = {
    **{"lower_0": 0.0, "upper_0": 2.0, "phys_0": 7.0},
    **{"lower_1": 5.0, "upper_1": 8.0, "phys_1": 9.0, "default": -1.0},
}
IN_WORDS = {"ref_param_nr": 2, "lower_0": 0.0, "upper_0": 1.0, "text_0": b"on"}


def nearest(x):
    return np.array([[10.0, 30.0, -5.0][np.argmin(np.abs(one - np.array([1, 2, 8])))] for one in x])


def in_ranges(x, ends):
    inside = [(x >= a) & ((x <= b) if ends else (x < b)) for a, b in ((0, 2), (5, 8))]
    return np.select(inside, [7.0, 9.0], -1.0)


P = {"P1": 1.0, "P2": 2.0, "P3": 3.0, "P4": 0.0, "P5": 0.5, "P6": 4.0}
KINDS = {  # numbers of MDF 4 and MDF 3, settings, and what each conversion means
    "none": ({"4": 0, "3": 65535}, {}, lambda x: x),
    "linear": ({"4": 1, "3": 0}, {"a": 0.5, "b": -3.0}, lambda x: 0.5 * x - 3),
    "rational": ({"4": 2, "3": 9}, P, lambda x: (x**2 + 2 * x + 3) / (0.5 * x + 4)),
    "interpolated": (
        {"4": 4, "3": 1},
        TABLE | {"val_param_nr": 6, "ref_param_nr": 3},
        lambda x: np.interp(x, [1, 2, 8], [10, 30, -5]),
    ),
    "table": ({"4": 5, "3": 2}, TABLE | {"val_param_nr": 6, "ref_param_nr": 3}, nearest),
    "ranges": ({"4": 6}, RANGES | {"val_param_nr": 7}, in_ranges),
}


def written(
    folder: Path, version: str, kind: str, number: int, settings, place=1, units=("g", "")
) -> Path:
    """Write a file whose channel has a conversion."""
    if version < "4":
        from asammdf.blocks.v2_v3_blocks import ChannelConversion
    else:
        from asammdf.blocks.v4_blocks import ChannelConversion
    with asammdf.MDF(version=version) as file:
        file.append(
            [asammdf.Signal(RAW.astype(kind), np.arange(10) / 100, name="a", unit=units[0])]
        )
        conversion = ChannelConversion(conversion_type=number, **settings)
        conversion.unit = units[1]
        file.groups[0].channels[place].conversion = conversion
        path = file.save(folder / f"new.{'mf4' if version >= '4' else 'mdf'}", overwrite=True)
    return path


@pytest.mark.every_value
@pytest.mark.parametrize("kind", ["u1", "i4", "f4", "f8"])
@pytest.mark.parametrize(
    ("version", "name"),
    [(v, name) for v in ("4.10", "3.30") for name, kind in KINDS.items() if v[0] in kind[0]],
)
def test_arithmetic_conversions_are_applied(tmp_path, version, name, kind):
    numbers, settings, formula = KINDS[name]
    path = written(tmp_path, version, kind, numbers[version[0]], settings)
    found = np.concatenate([block[0] for block in open_columns(path, ["a"])])
    x = RAW.astype(np.float64)
    expected = formula(x, kind[0] != "f") if name == "ranges" else formula(x)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    if name not in ("ranges", "none"):
        with asammdf.MDF(path) as file:  # an independent reading, by the package itself
            theirs = np.asarray(file.get("a").samples, np.float64)
        np.testing.assert_allclose(found, theirs, rtol=1e-6)


@pytest.mark.parametrize("version", ["4.10", "3.30"])
def test_times_are_converted_too(tmp_path, version):
    number = {"4": 1, "3": 0}[version[0]]
    path = written(tmp_path, version, "f8", number, {"a": 2.0, "b": 1.0}, place=0)
    found = np.concatenate([block[0] for block in open_columns(path, ["time", "a"])])
    np.testing.assert_allclose(found, 2 * np.arange(10) / 100 + 1)


def test_virtual_channels_count_the_records(tmp_path):
    with asammdf.MDF(version="4.10") as file:
        at = np.arange(10.0) / 100
        file.append([asammdf.Signal(RAW.astype("f8"), at, name="a")])
        file.groups[0].channels[0].channel_type = 3
        path = file.save(tmp_path / "new.mf4", overwrite=True)
    times = np.concatenate([block[0] for block in open_columns(path, ["time", "a"])])
    np.testing.assert_allclose(times, np.arange(10.0))


@pytest.mark.parametrize(
    ("version", "number", "settings", "words"),
    [
        ("4.10", 3, {"formula": "X"}, r"algebraic \(a formula\)"),
        ("4.10", 7, {"ref_param_nr": 2, "val_0": 1.0, "text_0": b"on"}, "value-to-text"),
        ("4.10", 8, IN_WORDS, "range-to-text"),
        ("3.30", 10, {"formula": "X1"}, r"algebraic \(a formula\)"),
        ("3.30", 6, P, "polynomial"),
        ("3.30", 7, P | {"P7": 0.0}, "exponential"),
        ("3.30", 8, P | {"P7": 0.0}, "logarithmic"),
    ],
)
def test_other_conversions_are_refused_by_name(tmp_path, version, number, settings, words):
    path = written(tmp_path, version, "f8", number, settings)
    message = rf"column 'a' has a conversion .* not applied, {words}; export this channel as raw or"
    with pytest.raises(TripError, match=message):
        list(open_columns(path, ["a"]))
    times = np.concatenate([block[0] for block in open_columns(path, ["time"])])
    np.testing.assert_allclose(times, np.arange(10) / 100)


def appended(folder: Path, signals, version="4.10", **settings) -> Path:
    """Write a file with signals of one group, and settings of its first channel and its header."""
    with asammdf.MDF(version=version) as file:
        file.append(signals)
        for key, value in settings.items():
            setattr(file.groups[0].channels[1], key, value)
        return file.save(folder / f"new.{'mf4' if version >= '4' else 'mdf'}", overwrite=True)


@pytest.mark.parametrize("n", [10, BLOCK + 10])
@pytest.mark.parametrize(("all_invalid", "kind"), [(False, 0), (True, 0), (False, 6)])
def test_invalid_samples_are_missing_at_their_times(tmp_path, n, all_invalid, kind):
    values, at = np.arange(float(n)), np.arange(n) / 100
    invalid = np.isin(values, [3, 4, n - 2]) | all_invalid
    a = asammdf.Signal(values, at, name="a", unit="g", invalidation_bits=invalid)
    path = appended(tmp_path, [a, asammdf.Signal(values, at, name="b")], channel_type=kind)
    for name, expected in (("a", np.where(invalid, np.nan, values)), ("b", values)):
        blocks = zip(*open_columns(path, ["time", name]), strict=True)
        times, found = map(np.concatenate, blocks)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_allclose(times, at)


@pytest.mark.parametrize(("kind", "word"), [(2, "angle"), (3, "distance"), (4, ""), (1, "")])
def test_masters_that_are_no_times_are_not_taken_as_seconds(tmp_path, kind, word):
    at = asammdf.Signal(np.arange(10.0), np.arange(10) / 100, name="a", unit="g")
    at.master_metadata = ("along", kind)
    path = appended(tmp_path, [at])
    with open_file(path) as file:
        assert file.column("a").time == ("along" if kind == 1 else None)
        if word:
            message = rf"'a' is sampled along {word} \('along'\), not in time; export it over time"
            with pytest.raises(TripError, match=message):
                list(open_columns(path, ["a"]))
        assert next(open_columns(path, ["along"]))[0][1] == 0.01


@pytest.mark.parametrize("version", ["4.10", "3.30"])
def test_unit_may_be_that_of_the_conversion(tmp_path, version):
    number = {"4": 1, "3": 0}[version[0]]
    path = written(tmp_path, version, "f8", number, {"a": 2.0, "b": 1.0}, units=("", "mg"))
    with open_file(path) as file:
        assert [column.unit for column in file.columns] == ["s", "mg"]


def test_start_of_a_logger_without_a_zone_is_local(tmp_path):
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(np.arange(9.0), np.arange(9.0), name="a")])
        file.start_time = datetime(2024, 5, 6, 8, 15, 30)
        path = file.save(tmp_path / "new.mf4", overwrite=True)
    with open_file(path) as file:
        assert file.column("a").start_ns == 1714983330 * 10**9
        assert file.column("a").is_local
