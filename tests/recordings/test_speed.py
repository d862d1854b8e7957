"""Speeds: missing and wrong ones are found and reported."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import bare_manifest

from suspnet.trains.recordings.manifest_sources import SpeedSource
from suspnet.trains.recordings.speed import (
    find_stuck,
    find_wrong_speeds,
    read_speed,
    speed_at,
    speed_track,
)

AT = np.arange(0, 100, 0.01)


def speed_and_faults(speeds, seconds=None, at=AT) -> tuple[np.ndarray, list[str]]:
    """Return the speed at some times and the faults in words."""
    speeds = np.asarray(speeds, dtype=float)
    seconds = np.arange(len(speeds)) * 1.0 if seconds is None else np.asarray(seconds, dtype=float)
    track = speed_track(seconds, speeds, 0.0, None)
    speed, faults = speed_at(None, track, 0.0, at)
    return speed, [str(fault) for fault in faults]


def test_sound_speeds_have_no_faults():
    braking = np.concatenate([np.full(20, 30.0), np.arange(30.0, 0, -1.0), np.zeros(20),
                              np.arange(0, 31.0)])  # fmt: skip
    speed, faults = speed_and_faults(braking)
    assert faults == []
    np.testing.assert_array_equal(speed, np.interp(AT, np.arange(len(braking)), braking))


@pytest.mark.parametrize(
    ("zeros", "words"),
    [
        (slice(0, 30), "speed: zero of 30 samples (30 s), first at 0.000 s, not usable"),
        (slice(40, 41), "speed: zero of 1 sample (1 s), first at 40.000 s, not usable"),
        (slice(40, 70), "speed: zero of 30 samples (30 s), first at 40.000 s, not usable"),
        (slice(95, 110), "speed: zero of 5 samples (5 s), first at 95.000 s, not usable"),
    ],
)
def test_zeros_of_a_lost_receiver_are_no_stop(zeros, words):
    speeds = np.full(110, 50.0)
    speeds[zeros] = 0.0
    speed, faults = speed_and_faults(speeds)
    assert faults == [words]
    assert np.isnan(speed[(AT > zeros.start) & (AT < zeros.stop - 1)]).all()
    known = np.isfinite(speed)
    assert (speed[known] == 50.0).all()
    assert known[(AT < zeros.start - 1) | (AT > zeros.stop + 1)].all()


def test_empty_cells_and_jumps_are_speed_and_faults():
    speeds = np.full(110, 50.0)
    speeds[[10, 11]], speeds[30:33], speeds[60] = np.nan, 90.0, -1.0
    speed, faults = speed_and_faults(speeds)
    assert faults == [
        "speed: gap of 3 samples (3 s), first at 10.000 s, not usable",
        "speed: jump of 3 samples (3 s), first at 30.000 s, not usable",
    ]
    assert (speed[np.isfinite(speed)] == 50.0).all()


SLOWING = np.concatenate([np.full(60, 50.0), np.arange(50.0, 20.0, -0.5), np.full(60, 20.0)])
"""Speeds of a train that brakes at 0.5 m/s2 from the 60th second on for a minute, [m/s]."""
EACH_S = np.arange(180.0)


@pytest.mark.representatives(3)
@pytest.mark.parametrize("resolution", [1e-9, 0.01, 1 / 3.6, 5 / 3.6])
@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
def test_receiver_that_repeats_its_speed_while_the_train_brakes_is_stuck(noise, resolution):
    for seed in range(20):
        speeds = SLOWING + noise * np.random.default_rng(seed).standard_normal(len(SLOWING))
        speeds = resolution * np.round(speeds / resolution)
        assert speed_and_faults(speeds, at=EACH_S)[1] == []
        speeds[70:110] = speeds[69] - max(resolution, 0.1)  # until the train is at 25 m/s
        speed, faults = speed_and_faults(speeds, at=EACH_S)
        assert faults == ["speed: stuck of 39 samples (39 s), first at 71.000 s, not usable"]
        np.testing.assert_array_equal(np.isnan(speed), (EACH_S > 70) & (EACH_S < 110))


def test_receiver_that_is_stuck_to_the_end_is_seen_where_it_scatters():
    speeds = SLOWING + 0.05 * np.random.default_rng(0).standard_normal(len(SLOWING))
    speeds[150:] = speeds[150]
    words = "speed: stuck of 29 samples (29 s), first at 151.000 s, not usable"
    assert speed_and_faults(speeds, at=EACH_S)[1] == [words]


def test_kept_speed_and_emergency_brake_are_no_fault():
    assert speed_and_faults(np.full(180, 50.0), at=EACH_S)[1] == []
    braking = np.concatenate([np.full(60, 50.0), np.arange(50.0, 0.0, -2.4), np.zeros(60)])
    for resolution in (0.01, 0.1, 1 / 3.6):
        assert speed_and_faults(resolution * np.round(braking / resolution))[1] == []
    seconds = np.delete(np.arange(len(braking)) * 1.0, slice(50, 70))  # rows are missing
    assert not any(
        "stuck" in fault for fault in speed_and_faults(braking[seconds.astype(int)], seconds)[1]
    )


def test_missing_rows_are_speed_and_faults():
    seconds = np.delete(np.arange(110.0), [*range(10, 13), *range(50, 70)])
    speed, faults = speed_and_faults(np.full(len(seconds), 50.0), seconds)
    assert faults == [
        "speed: gap of 3 samples (3 s), first at 9.000 s, repaired",
        "speed: gap of 20 samples (20 s), first at 49.000 s, not usable",
    ]
    np.testing.assert_array_equal(np.isnan(speed), (AT > 49.001) & (AT < 70.001))


@given(st.lists(st.floats(-10, 200) | st.just(np.nan) | st.just(0.0), min_size=1, max_size=60))
def test_wrong_speeds_are_known_ones(speeds):
    speeds = np.array(speeds)
    zero, jump = find_wrong_speeds(np.arange(len(speeds)) * 1.0, speeds)
    assert not (zero & jump).any()
    assert np.isfinite(speeds[zero | jump]).all()
    assert (speeds[zero] < 0.5).all()
    speeds[zero | jump] = np.nan
    assert np.isfinite(speeds[find_stuck(np.arange(len(speeds)) * 1.0, speeds)]).all()


@pytest.mark.parametrize(("rate_hz", "n"), [(1000.0, 20), (20.0, 1000)])
def test_fast_speeds_are_averaged(tmp_path, rate_hz, n):
    speeds = 3 * np.arange(1000) / rate_hz
    pq.write_table(pa.table({"v": speeds}), tmp_path / "v.parquet")
    source = SpeedSource("v.parquet", "m/s", rate_hz=rate_hz)
    track = read_speed(replace(bare_manifest(tmp_path), speed=source))
    assert len(track.speeds) == n
    np.testing.assert_allclose(track.speeds, 3 * track.seconds)
