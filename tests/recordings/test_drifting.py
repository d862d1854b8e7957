"""Clocks that drift apart: drift and jumps come back, and good clocks have none."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from suspnet.trains.recordings.cleaning import Fault
from suspnet.trains.recordings.clock_drift import clock_faults, compared_pairs, find_drift
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_sources import SensorSource

RATE_HZ, SECONDS = 100.0, 600.0
AT = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ


@cache
def track(seed: int = 0) -> np.ndarray:
    """Return band-limited noise, sampled finely enough for linear interpolation, at 1600 Hz."""
    rng = np.random.default_rng(seed)
    return lfilter([0.01], [1, -0.99], rng.standard_normal(round(1700 * SECONDS)))


def sensor(times_s, noise: float = 0.05, smoothing: float = 0.9, seed: int = 1) -> np.ndarray:
    """Return what a sensor shows whose samples are taken at these times."""
    fine = lfilter([1 - smoothing], [1, -smoothing], track())
    values = np.interp(times_s, np.arange(len(fine)) / 1600, fine)
    rng = np.random.default_rng(seed)
    return values + noise * values.std() * rng.standard_normal(len(values))


def drift_of(second, usable=None, speed=None):
    usable = np.ones(len(AT), dtype=bool) if usable is None else usable
    speed = np.full(len(AT), 50.0) if speed is None else speed
    return find_drift(sensor(AT, smoothing=0.0, seed=2), second, usable, speed, RATE_HZ)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("ppm", [0.0, 5.0, -30.0, 100.0, -1000.0])
def test_drift_comes_back(ppm):
    drift = drift_of(sensor(AT * (1 - 1e-6 * ppm)))
    assert not drift.is_jump
    assert 1e6 * drift.size == pytest.approx(ppm, abs=1.0 + 2e-3 * abs(ppm))
    assert 0 < 1e6 * drift.deviation < 1.0
    assert drift.seconds == SECONDS - 20


@pytest.mark.representatives(2)
@pytest.mark.parametrize("lost_s", [0.005, -0.02, 0.5, -3.0])
def test_jump_comes_back(lost_s):
    drift = drift_of(sensor(AT + lost_s * (AT > 250) + 3.0 * (lost_s < 0)))
    assert drift.is_jump
    assert drift.size == pytest.approx(-lost_s, abs=5e-4)
    assert drift.jump_at_s == pytest.approx(250, abs=20)


@pytest.mark.parametrize("n_alike", [3, 7])
def test_few_windows_that_agree_are_no_jump(n_alike):
    """Windows at both ends have a common signal, the others have nothing in common."""
    n, window = round(280 * RATE_HZ), round(20 * RATE_HZ)
    early, late = sensor(AT)[:n], sensor(AT + 2.4)[:n]
    second = np.random.default_rng(3).standard_normal(n) * early.std()
    second[: n_alike * window] = early[: n_alike * window]
    second[-n_alike * window :] = late[-n_alike * window :]
    first, usable, speed = sensor(AT, smoothing=0.0, seed=2)[:n], np.ones(n, bool), np.full(n, 50.0)
    drift = find_drift(first, second, usable, speed, RATE_HZ)
    if n_alike == 3:
        assert drift is None
    else:
        assert drift.is_jump
        assert drift.size == pytest.approx(-2.4, abs=5e-4)


def test_other_motion_at_another_speed_or_at_a_stop_is_no_loss():
    """As left and right move otherwise at another speed, and not at all at a stop."""
    other = sensor(AT).std() * np.random.default_rng(5).standard_normal(len(AT))
    later = np.where(AT < 300, sensor(AT), other)
    for low in (30.0, 0.0):
        speed = np.where(AT < 300, 50.0, low)
        drift = drift_of(later, speed=speed)
        assert drift is None or abs(drift.size) < 6 * drift.deviation


def test_little_in_common_throughout_is_no_loss():
    """As of axle boxes left and right: now and then a window is clear."""
    own = np.random.default_rng(6).standard_normal(len(AT))
    for share in (1.0, 1.5, 2.0, 2.5):
        drift = drift_of(sensor(AT) + share * sensor(AT).std() * own)
        assert drift is None or np.isfinite(drift.size)


def test_speed_explains_delays():
    speed = np.where(AT < 300, 50.0, 30.0)
    later = sensor(AT - np.where(AT < 300, 0.0, 0.03))
    drift = drift_of(later, speed=speed)
    assert not drift.is_jump
    assert abs(drift.size) < 6 * drift.deviation
    assert drift_of(later).is_jump


def test_signals_with_nothing_in_common_show_no_drift():
    assert drift_of(np.random.default_rng(0).standard_normal(len(AT))) is None
    assert drift_of(np.zeros(len(AT))) is None
    assert drift_of(sensor(AT), usable=AT % 20 > 1) is None
    assert find_drift(*[AT[:9000]] * 2, *[np.ones(9000, dtype=bool)] * 2, RATE_HZ) is None


def manifest(**rates) -> TripManifest:
    channels = {name: SensorSource("f", "g", name, rates.get(name)) for name in CHANNELS}
    return TripManifest(
        path=Path("trip.yaml"),
        name="trip",
        vehicle="",
        suspension="",
        mileage_km=0.0,
        speed=1.0,
        channels=channels,
    )


def faults(seconds, **rates) -> tuple[Fault, ...]:
    values = dict(zip(CHANNELS, (sensor(at, seed=i) for i, at in enumerate(seconds)), strict=True))
    usable = np.ones(len(AT), dtype=bool)
    return clock_faults(manifest(**rates), values, usable, np.full(len(AT), 50.0), RATE_HZ)


def test_drift_is_reported_with_the_rate_that_would_be_right():
    (fault,) = faults([AT, AT, AT * (1 - 2e-5)], body=2000.0)
    assert str(fault).startswith("body: clock runs +20")
    assert "ppm against that of bogie, 11.6 ms along the trip; with `rate_hz` 2000.04" in str(fault)
    assert not fault.repaired
    assert faults([AT, AT, AT]) == ()


def test_clocks_far_apart_are_refused():
    message = r"trip\.yaml: channel 'bogie': clock runs -\S+ ppm against that of axle_box, 5[78]"
    with pytest.raises(TripError, match=message):
        faults([AT, AT * (1 + 1e-4), AT * (1 + 1e-4)])
    with pytest.raises(TripError, match=r"jumps by .* were samples lost or added"):
        faults([AT, AT, AT + 0.1 * (AT > 200)])


def test_sensors_of_the_other_axle_are_compared_with_the_first_one():
    names = ["axle_box left", "axle_box right", "axle_box axle2", "bogie", "bogie axle2"]
    assert compared_pairs(names) == [
        ("axle_box left", "bogie"),
        ("axle_box left", "axle_box right"),
        ("axle_box left", "axle_box axle2"),
        ("axle_box left", "bogie axle2"),
    ]
