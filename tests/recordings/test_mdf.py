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
IN_WORDS = {"ref_param_nr": 2, "lower_0": 0.0, "upper_0": 1.0, "text_0": b"on"}


LINEAR = {"a": 0.5, "b": -3.0}


def written(folder: Path, kind: str, number: int, settings, place=1, units=("g", "")) -> Path:
    """Write a file whose channel has a conversion."""
    from asammdf.blocks.v4_blocks import ChannelConversion

    with asammdf.MDF(version="4.10") as file:
        file.append(
            [asammdf.Signal(RAW.astype(kind), np.arange(10) / 100, name="a", unit=units[0])]
        )
        conversion = ChannelConversion(conversion_type=number, **settings)
        conversion.unit = units[1]
        file.groups[0].channels[place].conversion = conversion
        return file.save(folder / "new.mf4", overwrite=True)


@pytest.mark.parametrize("kind", ["u1", "i4", "f4", "f8"])
@pytest.mark.parametrize(("number", "settings"), [(0, {}), (1, LINEAR)], ids=["none", "linear"])
def test_linear_conversions_are_applied(tmp_path, number, settings, kind):
    path = written(tmp_path, kind, number, settings)
    found = np.concatenate([block[0] for block in open_columns(path, ["a"])])
    x = RAW.astype(np.float64)
    np.testing.assert_allclose(found, 0.5 * x - 3 if number else x, rtol=1e-12)
    if number:
        with asammdf.MDF(path) as file:  # an independent reading, by the package itself
            theirs = np.asarray(file.get("a").samples, np.float64)
        np.testing.assert_allclose(found, theirs, rtol=1e-6)


def test_files_before_mdf_4_are_refused(tmp_path):
    with asammdf.MDF(version="3.30") as file:
        file.append([asammdf.Signal(RAW, np.arange(10) / 100, name="a")])
        path = file.save(tmp_path / "new.mdf")
    with pytest.raises(TripError, match=r"new.mdf: is an MDF file of version 3.30; save it as MDF"):
        list(open_columns(path, ["a"]))


def test_times_are_converted_too(tmp_path):
    path = written(tmp_path, "f8", 1, {"a": 2.0, "b": 1.0}, place=0)
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
    ("number", "settings", "words"),
    [
        (2, {f"P{i}": 1.0 for i in range(1, 7)}, "rational"),
        (3, {"formula": "X"}, r"algebraic \(a formula\)"),
        (7, {"ref_param_nr": 2, "val_0": 1.0, "text_0": b"on"}, "value-to-text"),
        (8, IN_WORDS, "range-to-text"),
    ],
)
def test_other_conversions_are_refused_by_name(tmp_path, number, settings, words):
    path = written(tmp_path, "f8", number, settings)
    message = rf"column 'a' has a conversion .* not applied, {words}; export this channel as raw or"
    with pytest.raises(TripError, match=message):
        list(open_columns(path, ["a"]))
    times = np.concatenate([block[0] for block in open_columns(path, ["time"])])
    np.testing.assert_allclose(times, np.arange(10) / 100)


def appended(folder: Path, signals, **settings) -> Path:
    """Write a file with signals of one group, and settings of its first channel and its header."""
    with asammdf.MDF(version="4.10") as file:
        file.append(signals)
        for key, value in settings.items():
            setattr(file.groups[0].channels[1], key, value)
        return file.save(folder / "new.mf4", overwrite=True)


@pytest.mark.parametrize(
    ("n", "all_invalid", "kind"), [(BLOCK + 10, False, 0), (10, True, 0), (10, False, 6)]
)
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


def test_unit_may_be_that_of_the_conversion(tmp_path):
    path = written(tmp_path, "f8", 1, {"a": 2.0, "b": 1.0}, units=("", "mg"))
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
