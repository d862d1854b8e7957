"""When a trip was recorded: by headers and times of every format, and what cannot be right."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recording_files import WRITERS, opened
from scipy.io import savemat
from trip_fixtures import changed, signal, small_fleet

from suspnet.trains.recordings import dates
from suspnet.trains.recordings.clocks import Zero, first_moment
from suspnet.trains.recordings.dates import date_in_lines, date_problem, read_date
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.manifest_sources import SensorSource
from suspnet.trains.recordings.recording import load_recording

START = datetime(2024, 5, 6, 8, 15, 30)
FIRST_S = 1714983330
"""Start in seconds since 1970 in UTC."""
N = 2000


def columns():
    rng = np.random.default_rng(0)
    return {name: rng.normal(size=N) for name in ("axle_box", "bogie")}


def write(kind, folder):
    """Write a file that states when it was recorded, in one of many ways."""
    path = folder / f"trip.{kind.partition(' ')[0]}"
    stamps = np.datetime64(START, "ns") + np.arange(N) * np.timedelta64(4, "ms")
    times = {
        "parquet stamps": stamps,
        "parquet utc": pa.array(stamps).cast(pa.timestamp("ns", "UTC")),
        "parquet numbers": FIRST_S + np.arange(N) * 0.004,
        "csv stamps": np.datetime_as_string(stamps, "ms"),
    }
    about = {
        "csv header": {"above": ["Logger;7\n", "Startzeit: 06.05.2024 08:15:30\n"]},
        "csv two lines": {"above": ["Date: 2024-05-06\n", "Time: 08:15:30\n"]},
        "tdms waveform": {"start": np.datetime64(START)},
        "mf4 header": {"start": START.replace(tzinfo=UTC)},
    }
    if kind == "mat struct":
        savemat(path, {"log": {"fs": 250.0, "start_time": START.isoformat()} | columns()})
    elif path.suffix == ".parquet":
        pq.write_table(pa.table({"time": times[kind]} | columns()), path)
    else:
        content = columns() if kind in about else {"time": times[kind]} | columns()
        WRITERS[path.suffix](path, content, rate_hz=250.0, **about.get(kind, {}))
    return path


ZONED = ("parquet utc", "parquet numbers", "tdms waveform", "mf4 header")
LOCAL = (*("parquet stamps", "csv stamps", "csv header", "csv two lines", "mat struct"),)


@pytest.mark.parametrize("kind", [*ZONED, *LOCAL])
def test_start_of_a_source_is_that_of_its_file(kind, tmp_path):
    path = write(kind, tmp_path)
    columns = {".tdms": "g/bogie", ".mat": "log.bogie"}
    stated = {} if path.suffix in (".tdms", ".mf4") else {"rate_hz": 250.0}
    if kind in ("parquet stamps", "parquet utc", "parquet numbers", "csv stamps"):
        stated = {"time": "time"}
    column = columns.get(path.suffix, "bogie")
    with opened(path, SensorSource(path.name, "g", column, **stated)) as source:
        next(source.blocks())
        assert source.zero.moment == START.replace(tzinfo=UTC if kind in ZONED else None)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2015-08-03", datetime(2015, 8, 3)),
        ("2015-08-03 08:00:05,25", datetime(2015, 8, 3, 8, 0, 5, 250000)),
        ("3.8.2015, 08:00", datetime(2015, 8, 3, 8)),
        ("23-Jul-98 14:33:11", datetime(1998, 7, 23, 14, 33, 11)),
        ("2015/08/03 7:05", datetime(2015, 8, 3, 7, 5)),
        ("03/08/2015", None),
        ("3.8.2015 25:00", None),
        ("NONE", None),
        ("", None),
    ],
)
def test_dates_of_headers_are_read(text, expected):
    assert read_date(text) == expected


def test_lines_without_a_date_have_none():
    lines = ["Rate: 250", "Start channel: 3", "Datum: gestern", "Time: 08:15:00"]
    assert date_in_lines([*lines, "Date: " + "1" * 400]) is None


# trips whose manifest has no start


@pytest.fixture(scope="module")
def trip():
    return small_fleet()[0]


def stamped(trip, folder, start):
    """Write a copy of a trip whose axle box, bogie and body have time stamps, and no `start`."""
    signals, channels = {}, {}
    for name, rate_hz in zip(("axle_box", "bogie", "body"), (400, 250, 250), strict=True):
        values = signal(trip, name)
        step = np.timedelta64(10**9 // rate_hz, "ns")
        times = np.datetime64(start, "ns") + np.arange(len(values)) * step
        signals[name] = {"time": times, "a": values}
        channels[name] = {"time": "time", "column": "a", "rate_hz": None}
    return changed(trip, folder, "stamped", signals, channels, start=None, speed=70.0)


def test_trip_has_the_start_of_its_manifest_or_else_of_its_time_stamps(trip, tmp_path):
    assert load_recording(read_manifest(trip)).started is None
    assert load_recording(read_manifest(stamped(trip, tmp_path, START))).started == START


# what cannot be right


@pytest.mark.parametrize("start", [datetime(1970, 1, 1), datetime(2199, 1, 1)])
def test_date_of_files_that_cannot_be_right_is_left_out_with_a_note(trip, tmp_path, start):
    recording = load_recording(read_manifest(stamped(trip, tmp_path, start)))
    assert recording.started is None
    assert f"the date by its files, {start.isoformat(' ')}, is left out" in recording.words


def test_today_is_the_clock_of_this_computer(monkeypatch):
    monkeypatch.setattr(dates, "now", lambda: datetime(2020, 1, 10, tzinfo=UTC))
    assert date_problem(datetime(2020, 1, 12)) == ""
    assert "in the future of this computer's clock (2020-01-10)" in date_problem(
        datetime(2020, 1, 13)
    )
    assert date_problem(datetime(1990, 1, 1)) == ""
    assert date_problem(datetime(2020, 1, 12, 1, tzinfo=UTC) - timedelta(hours=2)) == ""


def test_exact_times_come_before_dates_and_known_zones_before_others():
    exact, coarse = Zero(10**9 * FIRST_S), Zero(date=datetime(2001, 1, 1))
    local = Zero(10**9 * (FIRST_S - 100), is_zoned=False)
    assert first_moment([coarse, exact, local])[0] == START.replace(tzinfo=UTC)
    assert first_moment([coarse, local])[0] == START - timedelta(seconds=100)
    assert first_moment([coarse])[0] == datetime(2001, 1, 1)
    assert first_moment([Zero()]) == (None, "")
