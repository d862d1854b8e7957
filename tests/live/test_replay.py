"""Recorded trips as frames: what files hold, at the times when it was recorded."""

from collections import Counter
from datetime import UTC, datetime, timedelta
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from live_frames import frame
from trip_fixtures import changed, signal, write_trips

from suspnet.depot.live import replay as replay_module
from suspnet.depot.live.replay import Replay, paced, trip_clock, trip_frames
from suspnet.trains.recordings.frames import end_ns
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import load_recording
from suspnet.trains.recordings.running import Running

SENSORS = ("axle_box", "bogie", "body")
BEGIN = datetime(2026, 3, 1, 6, tzinfo=UTC)


@pytest.fixture(scope="module")
def trips(tmp_path_factory):
    """Return the manifests of two trips of one suspension."""
    return write_trips(tmp_path_factory.mktemp("trips") / "one", 2, minutes=1.2)


def by_sensor(frames):
    found = {}
    for one in frames:
        found.setdefault(one.sensor, []).append(one)
    return found


def frames_of(path, **options):
    manifest = read_manifest(path)
    return list(trip_frames(manifest, *trip_clock(manifest), Counter(), **options))


def test_frames_hold_the_samples_of_the_files_at_their_times(trips):
    replay = Replay(trips[0].parent)
    found = by_sensor(replay.frames())
    assert (replay.n_suspensions, replay.n_trips, replay.problems) == (1, 2, [])
    assert set(found) == {*SENSORS, "speed", "mileage"}
    for name in (*SENSORS, "speed"):
        assert [one.sequence for one in found[name]] == list(range(len(found[name])))
        assert {one.unit for one in found[name]} == {"m/s" if name == "speed" else "m/s2"}
        for path in trips:
            manifest = read_manifest(path)
            zero_ns = round(manifest.start.timestamp() * 1e9)
            mine = [f for f in found[name] if 0 <= f.time_ns - zero_ns < 100 * 10**9]
            samples = np.concatenate([one.samples for one in mine])
            np.testing.assert_array_equal(samples, signal(path, name))
            assert mine[0].time_ns == zero_ns
            assert all(later.time_ns == end_ns(one) for one, later in pairwise(mine))
            assert all(one.samples.dtype == np.float32 for one in mine if name != "speed")


def test_mileage_and_temperature_come_once_at_the_begin_of_a_trip(trips, tmp_path):
    path = changed(trips[1], tmp_path, temperature_c=-7.5)
    frames = frames_of(path)
    first = frames[0].time_ns
    assert first == min(one.time_ns for one in frames)
    slow = [(f.sensor, f.unit, f.samples.tolist(), f.time_ns) for f in frames[:2]]
    assert slow == [("mileage", "km", [2000.0], first), ("temperature", "degC", [-7.5], first)]
    assert not {"mileage", "temperature"} & {one.sensor for one in frames[2:]}


def test_stream_of_a_replay_is_the_batch(trips):
    manifest = read_manifest(trips[0])
    zero_ns, _ = trip_clock(manifest)
    running = Running(manifest, zero_ns)
    for one in Replay(trips[0].parent, frame_s=0.73).frames():
        if one.sensor != "mileage" and 0 <= one.time_ns - zero_ns < 3600 * 10**9:
            running.add(one)
    running.flush()
    found, expected = running.recording(), load_recording(manifest)
    np.testing.assert_allclose(found.signals, expected.signals, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.usable, expected.usable)
    np.testing.assert_allclose(found.speed_m_per_s, expected.speed_m_per_s, rtol=1e-12)


def test_missing_samples_are_gaps_in_time(trips, tmp_path):
    values = signal(trips[0], "body").copy()
    values[100:350], values[1000], values[1002:1004] = np.nan, np.inf, 3.4e38
    path = changed(trips[0], tmp_path, signals={"body": values})
    found = by_sensor(frames_of(path))["body"]
    zero_ns = found[0].time_ns
    at = [round((one.time_ns - zero_ns) * 250 / 1e9) for one in found]
    filled = np.full(len(values), np.nan)
    for start, one in zip(at, found, strict=True):
        filled[start : start + len(one.samples)] = one.samples
    expected = np.where(np.abs(values) < 1e30, values, np.nan)
    np.testing.assert_array_equal(filled, expected)
    assert [one.sequence for one in found] == list(range(len(found)))


def test_unit_and_sign_are_left_as_they_are(trips, tmp_path):
    channels = {"bogie": {"unit": "g", "sign": -1}, "body": {"unit": None}}
    values = signal(trips[0], "body")
    path = changed(trips[0], tmp_path, channels=channels)
    with pytest.raises(Exception, match="`unit` is missing"):
        frames_of(path)
    file = tmp_path / "body.parquet"
    field = pa.field("acceleration", pa.float64(), metadata={"unit": "mm/s2"})
    pq.write_table(pa.table([pa.array(1e3 * values.astype("f8"))], pa.schema([field])), file)
    content = yaml.safe_load(path.read_text())
    content["channels"]["body"]["file"] = str(file)
    path.write_text(yaml.safe_dump(content))
    found = by_sensor(frames_of(path))
    assert {one.unit for one in found["bogie"]} == {"g"}
    np.testing.assert_array_equal(found["bogie"][0].samples, signal(trips[0], "bogie")[:250])
    assert {one.unit for one in found["body"]} == {"m/s2"}
    np.testing.assert_allclose(found["body"][0].samples, values[:250], rtol=1e-12)


def write_csv(folder, stamps, values, zone=""):
    """Write a trip whose sensors share one CSV file with time stamps; return its manifest."""
    lines = ["time,w,p,s"]
    lines += [f"{t.isoformat()}{zone},{v},{v},{v}" for t, v in zip(stamps, values, strict=True)]
    (folder / "trip.csv").write_text("\n".join(lines) + "\n")
    source = {"file": "trip.csv", "time": "time", "rate_hz": 100, "unit": "m/s2"}
    content = {
        "format": "suspnet-trip-1",
        "vehicle": "train",
        "suspension": "front",
        "mileage_km": 10,
        "speed": 70,
        "channels": {n: source | {"column": c} for n, c in zip(SENSORS, "wps", strict=True)},
    }
    path = folder / "trip.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_times_of_files_are_those_of_frames_and_missing_rows_are_gaps(tmp_path):
    stamps = [datetime(2026, 3, 1, 7) + timedelta(milliseconds=10 * k) for k in range(1000)]
    values = (np.arange(1000) / 7).round(4)
    kept = np.r_[0:450, 700:1000]
    path = write_csv(tmp_path, [stamps[k] for k in kept], values[kept])
    assert trip_clock(read_manifest(path))[0] == round(BEGIN.timestamp() + 3600) * 10**9
    found = by_sensor(Replay(tmp_path, zone="+01:00").frames())
    assert set(found) == {*SENSORS, "mileage"}  # the speed is a number of the manifest
    begin_ns = round(BEGIN.timestamp()) * 10**9
    for one in found["body"]:
        at = (one.time_ns - begin_ns) * 100 // 10**9
        np.testing.assert_array_equal(one.samples, values[at : at + len(one.samples)])
        assert one.samples.dtype == np.float64
    assert sum(len(one.samples) for one in found["body"]) == len(kept)
    zoned = write_csv(tmp_path, stamps, values, zone="+01:00")
    assert trip_clock(read_manifest(zoned))[0] == begin_ns
    assert path == zoned


def test_trip_without_a_date_needs_a_start(trips, tmp_path):
    for k in (0, 1):
        changed(trips[k], tmp_path, f"trip_{k}", start=None)
    replay = Replay(tmp_path)
    assert list(replay.frames()) == []
    assert len(replay.problems) == 2
    assert "write `start` into the manifest" in replay.problems[0]


@pytest.fixture
def fleet(trips, tmp_path):
    """Return a folder with a folder for each of two suspensions, with trips at the same times."""
    for car in ("1", "2"):
        (tmp_path / f"car_{car}").mkdir()
        for path in trips:
            changed(path, tmp_path / f"car_{car}", path.stem, car=car)
    return tmp_path


def test_suspensions_are_merged_by_time(fleet):
    replay = Replay(fleet)
    frames = list(replay.frames())
    assert (replay.n_suspensions, replay.n_trips) == (2, 4)
    assert {one.suspension for one in frames} == {"car 1, simulated", "car 2, simulated"}
    fast = [one for one in frames if one.sensor in SENSORS]
    assert all(end_ns(later) >= end_ns(one) for one, later in pairwise(fast))
    for name in SENSORS:
        mine = [f for f in fast if (f.suspension, f.sensor) == ("car 2, simulated", name)]
        assert [one.sequence for one in mine] == list(range(len(mine)))


def test_faulty_trips_are_told_and_left_out(fleet, caplog):
    broken = fleet / "car_1" / "trip_001.yaml"
    broken.write_text("nonsense: 1\n")
    body = yaml.safe_load((fleet / "car_2" / "trip_002.yaml").read_text())["channels"]["body"]
    changed(fleet / "car_2" / "trip_002.yaml", fleet / "car_2", "trip_002", mileage_km=5)
    (fleet / "car_2" / "damaged.parquet").write_bytes(b"PAR1 nothing")
    content = yaml.safe_load((fleet / "car_2" / "trip_002.yaml").read_text())
    content["channels"]["body"] = body | {"file": "damaged.parquet"}
    (fleet / "car_2" / "trip_002.yaml").write_text(yaml.safe_dump(content))
    replay = Replay(fleet)
    mileages = by_sensor(replay.frames())["mileage"]
    assert len(mileages) == 2
    assert len(replay.problems) == 2
    assert "trip_001.yaml" in replay.problems[0]
    assert "damaged.parquet is damaged" in replay.problems[1]
    assert [record.getMessage() for record in caplog.records] == replay.problems


def test_trips_that_overlap_are_told(trips, tmp_path):
    start = read_manifest(trips[0]).start
    for k, path in enumerate(trips):
        changed(path, tmp_path, path.stem, start=start + timedelta(seconds=30 * k))
    replay = Replay(tmp_path)
    for _ in replay.frames():
        pass
    (problem,) = replay.problems
    assert problem.endswith("trip_002.yaml: starts before the end of the trip before it")


def test_suspensions_of_one_name_are_a_mistake(trips, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        changed(trips[0], tmp_path / name)
    with pytest.raises(ValueError, match="distinguish them by `train` and `car`"):
        Replay(tmp_path)


class Clock:
    """A clock that only sleeping moves on."""

    def __init__(self, monkeypatch):
        self.now_s, self.slept = 100.0, []
        monkeypatch.setattr(replay_module.time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(replay_module.time, "sleep", self.sleep)

    def sleep(self, seconds):
        self.slept.append(round(seconds, 6))
        self.now_s += seconds


def test_pace_is_that_of_the_recording_times_a_factor(monkeypatch):
    clock = Clock(monkeypatch)
    several = [frame(k) for k in (0, 1, 2, 10, 11, 12, 13, 10_000, 10_001, 10_000, 10_002)]
    for k, one in enumerate(paced(several, 4.0)):
        assert one is several[k]
        if k == 3:
            clock.now_s += 0.6  # the other side was slow
    assert clock.slept[:4] == [0.0, 0.25, 0.25, 2.0]
    # a long pause counts as a minute
    assert clock.slept[4:] == [0.0, 0.0, 0.15, 15.0, 0.25, 0.0, 0.25]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: Replay(folder, frame_s=0), "`frame_s` must be"),
        (lambda folder: Replay(folder, zone="Moon"), "the time zone 'Moon' is not known"),
        (lambda folder: Replay(folder / "x"), "there is no folder"),
        (lambda folder: Replay(folder, times=0), "`times` must be"),
    ],
)
def test_settings_out_of_range_are_refused(tmp_path, make, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        make(tmp_path)
