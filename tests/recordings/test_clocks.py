"""Absolute times: found in numbers, stamps and headers, aligned, and refused where ambiguous."""

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from recording_files import bare_manifest, opened, write_mdf, write_tdms

from suspnet.trains.recordings.clocks import Times, Zero, offsets_s
from suspnet.trains.recordings.columns import Column
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.manifest_sources import FileSource, SensorSource
from suspnet.trains.recordings.recording import Recording, load_recording

RATE_HZ = 250.0
BEGIN = np.datetime64("2015-08-03T06:00:00", "ns")  # in UTC
EPOCH_S = BEGIN.astype(np.int64) / 1e9
LATE_S = {"axle_box": 0.0, "bogie": 1.7523, "body": 3.25, "speed": -2.0}


def motion(times_s: np.ndarray) -> np.ndarray:
    """Return a sum of sinusoids [m/s2] by the time since BEGIN."""
    frequencies_hz = np.array([0.5, 1.3, 4.0, 7.7, 12.0])
    return np.cos(2 * np.pi * times_s[:, None] * frequencies_hz + np.arange(5) ** 2).sum(axis=1)


def elapsed(name: str) -> np.ndarray:
    rate_hz = 1.0 if name == "speed" else RATE_HZ
    return LATE_S[name] + np.arange(round(70 * rate_hz)) / rate_hz


def stamped(name: str, zone: str | None, shift_h: float = 0.0):
    steps = np.round(1e9 * elapsed(name)).astype(np.int64) + round(3600e9 * shift_h)
    return pa.array(BEGIN + steps.astype("timedelta64[ns]"), pa.timestamp("ns", zone))


WAYS = {
    "seconds": lambda name: EPOCH_S + elapsed(name),
    "milliseconds": lambda name: 1e3 * EPOCH_S + 1e3 * elapsed(name),
    "microseconds": lambda name: np.round(1e6 * EPOCH_S + 1e6 * elapsed(name)).astype(np.int64),
    "nanoseconds": lambda name: (
        np.round(1e9 * elapsed(name)).astype(np.int64) + BEGIN.astype(np.int64)
    ),
    "utc": lambda name: stamped(name, "UTC"),
    "zoned": lambda name: stamped(name, "Europe/Berlin"),
}


def write(folder: Path, times: dict, stated: dict | None = None, **changes) -> Path:
    """Write a trip whose times are given by source; None takes the time column away."""
    sources = {}
    for name in (*CHANNELS, "speed"):
        values = np.full(70, 30.0) if name == "speed" else motion(elapsed(name))
        columns = {"a": values} | ({} if times[name] is None else {"t": times[name]})
        pq.write_table(pa.table(columns), folder / f"{name}.parquet", use_dictionary=False)
        sources[name] = {"file": f"{name}.parquet", "column": "a"}
        sources[name]["unit"] = "m/s" if name == "speed" else "m/s2"
        timing = {"time": "t"} if times[name] is not None else {"rate_hz": len(values) / 70}
        sources[name] |= timing | (stated or {}).get(name, {})
    speed = sources.pop("speed")
    content = {"format": "suspnet-trip-1", "vehicle": "am96", "suspension": "car 7"}
    content |= {"mileage_km": 1.0, "speed": speed, "channels": sources} | changes
    (folder / "trip.yaml").write_text(yaml.safe_dump(content))
    return folder / "trip.yaml"


def load(path: Path) -> Recording:
    return load_recording(read_manifest(path))


def assert_aligned(recording: Recording, first_s: float = 0.0) -> None:
    """Check that all channels show the motion, whose clock began at `first_s` of the trip's."""
    at = recording.start_s + np.arange(len(recording.usable)) / recording.rate_hz - first_s
    assert at[0] > 3.25
    for signal in recording.signals:
        np.testing.assert_allclose(signal, motion(at), atol=3e-4)


# --- reference -----------------------------------------------------------------------------------


@pytest.mark.representatives(3)
@pytest.mark.parametrize("ways", [*([way] * 4 for way in WAYS), list(WAYS)[:4], list(WAYS)[2:]])
def test_dated_sources_are_aligned(tmp_path, ways):
    times = {name: WAYS[way](name) for name, way in zip(LATE_S, ways, strict=True)}
    assert_aligned(load(write(tmp_path, times)), 2.0)  # the speed's clock is the first


def test_start_dates_what_has_no_date(tmp_path):
    times = {name: stamped(name, "UTC") for name in LATE_S} | {"axle_box": None}
    for start in ("2015-08-03T08:00:00+02:00", "2015-08-03T06:00:00Z"):
        assert_aligned(load(write(tmp_path, times, start=start)))
    path = write(tmp_path, times, {"axle_box": {"start_s": 60.0}}, start="2015-08-03T05:59:00Z")
    assert_aligned(load(path), 60.0)


def test_local_times_are_aligned_by_their_zone(tmp_path):
    times = {name: stamped(name, "UTC") for name in LATE_S}
    times |= {"bogie": stamped("bogie", None, 2.0), "body": stamped("body", None, -3.5)}
    stated = {"bogie": {"time_zone": "Europe/Berlin"}, "body": {"time_zone": "-03:30"}}
    assert_aligned(load(write(tmp_path, times, stated)), 2.0)
    assert_aligned(load(write(tmp_path, {name: stamped(name, None) for name in LATE_S})), 2.0)


def test_the_only_column_of_time_stamps_needs_no_name(tmp_path):
    path = write(tmp_path, {name: stamped(name, "UTC") for name in LATE_S})
    content = yaml.safe_load(path.read_text())
    for source in (content["speed"], *content["channels"].values()):
        source.pop("time")
        source.pop("column")
    path.write_text(yaml.safe_dump(content))
    assert_aligned(load(path), 2.0)


@pytest.mark.parametrize(("write_one", "suffix"), [(write_tdms, ".tdms"), (write_mdf, ".mf4")])
def test_headers_date_channels(tmp_path, write_one, suffix):
    path = write(tmp_path, {name: stamped(name, "UTC") for name in LATE_S})
    content = yaml.safe_load(path.read_text())
    start = datetime(2015, 8, 3, 6, tzinfo=UTC) + timedelta(seconds=LATE_S["bogie"])
    start = start.replace(tzinfo=None) if suffix == ".tdms" else start
    values = motion(elapsed("bogie"))
    write_one(tmp_path / f"b{suffix}", {"a": values}, rate_hz=RATE_HZ, start=start, unit="m/s2")
    content["channels"]["bogie"] = {"file": f"b{suffix}"}
    path.write_text(yaml.safe_dump(content))
    assert_aligned(load(path), 2.0)


def test_equal_headers_begin_with_the_trip():
    manifest = bare_manifest(Path())
    stated = Zero(10**18 + 7, is_stated=True)
    assert offsets_s(manifest, {"a": stated, "b": stated, "c": Zero()}) == dict.fromkeys("abc", 0.0)
    assert offsets_s(manifest, {"a": Zero(), "b": Zero()}) == dict.fromkeys("ab", 0.0)
    late = Zero(10**18 + 10**9, is_stated=True)
    assert offsets_s(manifest, {"a": Zero(10**18), "b": late}) == {"a": 0.0, "b": 1.0}


@pytest.mark.parametrize(
    ("source", "unit", "size"),
    [({"time_unit": "ms"}, None, 1e-3), ({}, "ms", 1e-3), ({"time_unit": "us"}, "µs", 1e-6),
     ({}, None, 1.0), ({"time_unit": "s"}, "V", 1.0), ({}, "minutes", 60.0)],
)  # fmt: skip
def test_numbers_are_in_their_unit(source, unit, size):
    times = Times("here", FileSource("f", time="t", **source), Column("t", unit), None)
    np.testing.assert_allclose(
        times.seconds(np.array([5.0, 7.0, np.nan])), [5 * size, 7 * size, np.nan]
    )
    assert times.zero.ns is None


@pytest.mark.parametrize(("zone", "ahead_s"), [(None, 0), ("+02:00", 7200)])
def test_local_start_of_a_header_takes_the_zone_of_the_manifest(zone, ahead_s):
    source, column = FileSource("f", time="t", time_zone=zone), Column("t", "s", is_local=True)
    times = Times("here", source, column, 1714983330 * 10**9)
    np.testing.assert_array_equal(times.seconds(np.array([0.5, 1.5])), [0.5, 1.5])
    assert (times.zero.ns, times.zero.is_zoned) == ((1714983330 - ahead_s) * 10**9, bool(zone))


# --- failure -------------------------------------------------------------------------------------


@pytest.mark.representatives(5)
@pytest.mark.parametrize(
    ("times", "stated", "changes", "message"),
    [
        ({"body": None}, {}, {}, "axle_box, bogie, speed have absolute times, body have not; give"),
        ({"body": "local"}, {}, {}, "the times of body name no time zone, others do; give their"),
        ({"body": None}, {}, {"start": "2015-08-03T06:00:00"}, "are in UTC; write the time zone"),
        ({}, {"body": {"time_zone": "UTC"}}, {}, "its time stamps name a zone; leave out"),
        ({"body": "numbers"}, {"body": {"time_zone": "UTC"}}, {}, "`time_zone` is for time stamps"),
        ({"body": None}, {"body": {"time_zone": "UTC"}}, {}, "are for a column of `time`"),
        ({"body": "autumn"}, {"body": {"time_zone": "Europe/Berlin"}}, {}, "is not one instant in"),
        ({"body": "empty"}, {}, {}, "its times are empty"),
        ({"body": "years"}, {}, {}, r"only 0\.0 s are common to all channels"),
    ],
)  # fmt: skip
def test_clocks_that_cannot_be_aligned_are_refused(tmp_path, times, stated, changes, message):
    kinds = {
        None: lambda: None,
        "local": lambda: stamped("body", None),
        "numbers": lambda: EPOCH_S + elapsed("body"),
        "autumn": lambda: stamped("body", None, 24 * 83 - 3.5),  # 25 October, 02:30
        "empty": lambda: pa.array([None] * len(elapsed("body")), pa.timestamp("ns", "UTC")),
        "years": lambda: stamped("body", "UTC", 1e5),
    }
    given = {name: stamped(name, "UTC") for name in LATE_S}
    given |= {name: kinds[kind]() for name, kind in times.items()}
    with pytest.raises(TripError, match=message) as caught:
        load(write(tmp_path, given, stated, **changes))
    assert "\n" not in str(caught.value)


def test_units_of_time_that_differ_are_refused():
    times = Times("here", FileSource("f", time="t", time_unit="s"), Column("t", "ms"), None)
    with pytest.raises(TripError, match="here: `time_unit` says 's', its file says 'ms'"):
        times.seconds(np.arange(3.0))


# jumps of the times


def written(folder: Path, times) -> Path:
    path = folder / "data.csv"
    path.write_text("t,a\n" + "".join(f"{t},{i}\n" for i, t in enumerate(times)))
    return path


N = 20_000
SECONDS = 0.005 * np.arange(N)
COUNTS = 5000 * np.arange(N)
NIGHT = np.datetime64("2026-08-03T23:59:30", "ms") + COUNTS // 1000
SPRING = np.datetime64("2026-03-29T01:59:30", "ms") + COUNTS // 1000
SPRING[6000:] += 3_600_000
AUTUMN = np.datetime64("2026-10-25T02:59:30", "ms") + COUNTS // 1000
AUTUMN[6000:] -= 3_600_000


@pytest.mark.parametrize(
    ("times", "unit", "reason"),
    [
        ([str(t)[11:] for t in NIGHT], None, "a day"),
        (np.round((86370 + SECONDS) % 86400, 3), None, "a day"),
        ([f"{t // 60 % 60:02.0f}:{t % 60:06.3f}" for t in 3570 + SECONDS], None, "an hour"),
        ((2**32 - 10**6 + COUNTS) % 2**32, "us", r"2\^32"),
        (np.round((2**32 - 10**6 + COUNTS) % 2**32 / 1e6, 6), None, r"2\^32 us"),
        (COUNTS // 1000 % 2**16, "ms", r"2\^16"),
        (SPRING, None, "an hour"),
        (AUTUMN, None, "an hour"),
    ],
)
def test_times_continue_where_a_clock_starts_again(tmp_path, times, unit, reason):
    path = written(tmp_path, times)
    with opened(path, SensorSource(path.name, "g", "a", time="t", time_unit=unit)) as source:
        np.testing.assert_array_equal(np.concatenate(list(source.even())), np.arange(N))
        assert source.known_rate_hz == pytest.approx(200)
        assert re.search(rf"times jump by {reason} and continue \(1\)$", source.words)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (np.where(SECONDS < 45, SECONDS, SECONDS - 0.8), "the clock steps back by 0.795 s; divide"),
        (np.where(SECONDS < 45, SECONDS, SECONDS - 45), "the clock steps back by 44.995 s; divide"),
        ([""] * N, "its times are empty"),
    ],
)
def test_clocks_that_step_back_are_refused(tmp_path, times, message):
    path = written(tmp_path, times)
    source = SensorSource(path.name, "g", "a", time="t")
    with opened(path, source) as one, pytest.raises(TripError, match=message):
        list(one.even())


def test_rows_without_a_time_are_left_out(tmp_path):
    path = written(tmp_path, ["0.25", *SECONDS[1:50], "ERR", *SECONDS[51:]])
    path.write_text(path.read_text().replace("0.25,0\n", "0,0\n"))
    with opened(path, SensorSource(path.name, "g", "a", time="t")) as source:
        values = np.concatenate(list(source.even()))
        assert "rows without a time are left out (1)" in source.words
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(values)), [50])
    assert len(values) == N


def test_times_without_their_unit_are_refused(tmp_path):
    times = {name: np.round(1e3 * elapsed(name)) for name in LATE_S}
    path = write(tmp_path, times, {"speed": {"time_unit": "ms"}})
    with pytest.raises(TripError, match="if its times are not in seconds, give `time_unit`"):
        load(path)


def test_times_of_day_are_aligned_with_each_other_and_by_the_start(tmp_path):
    day_ns = np.datetime64("1900-01-01T08:00:00", "ns")
    of_day = {
        name: day_ns + np.round(1e9 * elapsed(name)).astype("timedelta64[ns]") for name in LATE_S
    }
    assert_aligned(load(write(tmp_path, of_day)), 8 * 3600.0)
    mixed = of_day | {"body": stamped("body", None, 2.0)}
    assert_aligned(load(write(tmp_path, mixed, start="2015-08-03T08:00:01")), -1.0)
    with pytest.raises(TripError, match="its times have no date: leave out `time_zone`"):
        load(write(tmp_path, of_day, {"body": {"time_zone": "UTC"}}))
