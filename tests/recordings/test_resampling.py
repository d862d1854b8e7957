"""The two stages against exact sinusoids: gain, phase, aliases, and who touches bad samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from suspnet.trains.recordings.sensor import Decimator, Growing, interpolate, support

RATE_HZ = 100.0


def resample(values, bad, input_hz, times_s, block=10_000):
    """Resample a signal whose first sample is at time 0."""
    blocks = ((values[i : i + block], bad[i : i + block]) for i in range(0, len(values), block))
    first, found = Decimator(input_hz, RATE_HZ), Growing()
    for values_of, bad_of in blocks:
        found.append(*first.push(values_of, bad_of))
    positions = (times_s * input_hz - first.first) / first.factor
    oversampling = input_hz / first.factor / RATE_HZ
    return interpolate(found.values, found.touched, positions, oversampling)


RATES = [
    *(123.4, 799.0, 1999.7),
    *(
        pytest.param(rate_hz, marks=pytest.mark.slow)
        for rate_hz in (100.0, 800.0, 2000.0, 2048.0, 5000.0, 5120.0, 51_200.0)
    ),
]
FAST_RATES = RATES[1:3] + RATES[4:]
TIMES_S = 0.3 + np.arange(500) / RATE_HZ


def tone(frequency_hz, rate_hz) -> np.ndarray:
    return np.exp(2j * np.pi * frequency_hz * np.arange(int(5.7 * rate_hz)) / rate_hz)


def through(values, rate_hz, times_s=TIMES_S):
    bad = np.zeros(len(values), dtype=bool)
    real, imaginary = (
        resample(part, bad, rate_hz, times_s)[0] for part in (values.real, values.imag)
    )
    return real + 1j * imaginary


@pytest.mark.parametrize("rate_hz", RATES)
def test_pass_band_has_gain_one_and_no_delay(rate_hz):
    for frequency_hz in (0.0, 0.5, 7.7, 20.0, 25.0):
        for delay_s in (0.0, 0.00123):
            times_s = TIMES_S + delay_s
            got = through(tone(frequency_hz, rate_hz), rate_hz, times_s)
            exact = np.exp(2j * np.pi * frequency_hz * times_s)
            assert np.abs(got - exact).max() < 5e-5


@pytest.mark.parametrize("rate_hz", FAST_RATES)
def test_what_would_fall_into_the_pass_band_is_80_db_down(rate_hz):
    for alias_hz in (-25.0, -3.0, 3.0, 25.0):
        for multiple in range(1, int(rate_hz / 2 / RATE_HZ) + 1):
            frequency_hz = multiple * RATE_HZ + alias_hz
            if multiple < 12 and frequency_hz <= rate_hz / 2:
                assert np.abs(through(tone(frequency_hz, rate_hz), rate_hz)).max() < 1e-4


def test_nyquist_band_of_fast_signals_is_80_db_down():
    for frequency_hz in np.random.default_rng(0).uniform(75, 2500, 20):
        assert np.abs(through(tone(frequency_hz, 5000.0), 5000.0)).max() < 1e-4


@settings(max_examples=12)
@given(
    st.sampled_from([123.4, 400.0, 1999.7, 5000.0]),
    st.sets(st.integers(0, 2000), max_size=3),
    st.sampled_from([1, 13, 500, 4000]),
)
def test_blocks_change_nothing_and_bad_samples_touch_their_neighbours(rate_hz, bad_at, block):
    rng = np.random.default_rng(0)
    n = int(max(0.6 * rate_hz, 100))
    values = rng.standard_normal(n)
    bad = np.zeros(n, dtype=bool)
    bad[[i for i in bad_at if i < n]] = True
    times_s = 0.15 + np.arange(int((n / rate_hz - 0.3) * RATE_HZ)) / RATE_HZ
    whole, touched = resample(values, bad, rate_hz, times_s, block=n)
    parts, touched_parts = resample(values, bad, rate_hz, times_s, block=block)
    np.testing.assert_allclose(parts, whole, atol=1e-14)
    np.testing.assert_array_equal(touched_parts, touched)
    other, _ = resample(np.where(bad, 1e3, values), bad, rate_hz, times_s)
    np.testing.assert_array_equal(other[~touched], parts[~touched])
    reach_s = np.abs(times_s[:, None] - np.flatnonzero(bad) / rate_hz).min(axis=1, initial=np.inf)
    assert touched[reach_s < 0.05].all()
    assert not touched[reach_s > 0.12].any()


def test_too_short_a_signal_gives_nothing():
    values, touched = Decimator(5000.0, RATE_HZ).push(np.ones(10), np.zeros(10, dtype=bool))
    assert len(values) == len(touched) == 0


def test_second_stage_reaches_less_than_a_tenth_of_a_second():
    for oversampling in (1.0, 4.0, 8.0):
        assert 0.05 < support(oversampling) / (oversampling * RATE_HZ) < 0.1
