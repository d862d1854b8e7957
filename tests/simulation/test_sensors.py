"""What a simulated accelerometer records, against what its data sheet says."""

import math

import numpy as np
import pytest

from suspnet.trains.recordings.manifest_sources import ACCELERATION_UNITS
from suspnet.trains.simulation.signals import Sensor

RATE_HZ = 100.0


def signal(n=100_000, seed=0):
    return np.random.default_rng(seed).standard_normal(n)


def rng(seed=1):
    return np.random.default_rng(seed)


# reference


@pytest.mark.parametrize("snr_db", [20.0, 34.0, 54.0])
def test_noise_has_its_level_in_db(snr_db):
    clean = 3.0 * signal()
    noise = Sensor(RATE_HZ, snr_db=snr_db).record(clean, rng()) - clean
    ratio = 20 * math.log10(np.sqrt(np.mean(clean**2)) / np.sqrt(np.mean(noise**2)))
    # 100,000 draws: 0.22 % or 0.02 dB
    assert ratio == pytest.approx(snr_db, abs=0.08)
    assert abs(noise.mean()) < 5 * noise.std() / math.sqrt(len(noise))
    # white: no correlation between neighbours
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 5 / math.sqrt(len(noise))
    if snr_db == 34.0:  # section III-E
        assert noise.std() / clean.std() == pytest.approx(0.02, rel=0.01)


def test_precision_is_noise_relative_to_the_range():
    clean = signal()
    sensor = Sensor(RATE_HZ, snr_db=None, range_g=2.0, precision=0.001)
    noise = sensor.record(clean, rng()) - clean
    # Table VII: 0.1 % of 2 g
    assert noise.std() == pytest.approx(0.001 * 2 * 9.80665, rel=0.01)
    both = Sensor(RATE_HZ, snr_db=40.0, range_g=2.0, precision=0.001)
    together = (both.record(clean, rng()) - clean).std()
    expected = math.hypot(0.01 * np.sqrt(np.mean(clean**2)), 0.001 * 2 * 9.80665)
    assert together == pytest.approx(expected, rel=0.01)


def test_signal_is_cut_off_at_the_range():
    clean = 10.0 * signal()
    sensor = Sensor(RATE_HZ, snr_db=None, range_g=1.0)
    limit = ACCELERATION_UNITS["g"]
    assert sensor.range_m_per_s2 == pytest.approx(9.80665)
    recorded = sensor.record(clean, rng())
    assert np.abs(recorded).max() == limit
    np.testing.assert_array_equal(recorded, np.clip(clean, -limit, limit))
    assert 0.3 < np.mean(np.abs(recorded) == limit) < 0.35  # P(|x| > 0.98) = 0.327


@pytest.mark.parametrize(("late_s", "n_samples"), [(0.5, 50), (-0.25, -25), (0.0, 0)])
def test_clock_is_late_by_its_offset(late_s, n_samples):
    clean = signal(1000)
    recorded = Sensor(RATE_HZ, snr_db=None, clock_offset_s=late_s).record(clean, rng())
    inside = slice(100, 900)  # what happened at the other end is not known
    np.testing.assert_array_equal(recorded[inside], np.roll(clean, n_samples)[inside])
    if n_samples > 0:
        np.testing.assert_array_equal(recorded[150:900], clean[100:850])


def test_a_delay_of_part_of_a_sample_moves_a_wave_by_it():
    times = np.arange(1000) / RATE_HZ
    for late_s in (0.0004, 0.0123, -0.0176):
        recorded = Sensor(RATE_HZ, snr_db=None, clock_offset_s=late_s).record(
            np.sin(2 * math.pi * 3.0 * times), rng()
        )
        expected = np.sin(2 * math.pi * 3.0 * (times - late_s))
        # cubic splines on 33 samples a wave
        np.testing.assert_allclose(recorded[50:-50], expected[50:-50], atol=2e-5)


def test_gain_multiplies_the_signal_and_leaves_the_noise_at_its_level():
    clean = signal()
    np.testing.assert_array_equal(
        Sensor(RATE_HZ, snr_db=None, gain=1.02).record(clean, rng()), 1.02 * clean
    )
    plain = Sensor(RATE_HZ).record(clean, rng())
    loud = Sensor(RATE_HZ, gain=3.0).record(clean, rng())
    np.testing.assert_allclose(loud, 3 * plain, rtol=1e-9, atol=1e-12)


# failure


def test_precision_without_a_range_is_rejected():
    with pytest.raises(ValueError, match="`precision` is relative to `range_g`"):
        Sensor(RATE_HZ, precision=0.001)
