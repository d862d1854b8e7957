"""The level of all signals along a trip: a known answer, what it leaves alone, short recordings."""

import numpy as np
import pytest
from scipy.signal import lfilter

from suspnet.trains.spectra.evened_level import log_levels

RATE_HZ, N_SAMPLES = 100.0, 60_000
TIMES = np.arange(N_SAMPLES) / RATE_HZ


def noise(seed=0):
    """Return three signals of different size and colour, one with a line."""
    white = np.random.default_rng(seed).standard_normal((3, N_SAMPLES))
    signals = np.stack([white[0], 0.1 * lfilter([1], [1, -0.9], white[1]), 5 * white[2]])
    signals[2] += np.cos(2 * np.pi * 3 * TIMES)
    return signals


def test_level_is_found():
    truth = 0.5 * np.sin(2 * np.pi * TIMES / 60)
    found = log_levels(np.exp(truth) * noise(), np.ones(N_SAMPLES, bool), RATE_HZ)
    assert np.sqrt(np.mean((found - truth) ** 2)) < 0.06
    assert found.mean() == pytest.approx(0, abs=1e-2)


def test_even_signals_have_an_even_level():
    found = log_levels(noise(1), np.ones(N_SAMPLES, bool), RATE_HZ)
    assert found.std() < 0.05


def test_size_of_all_and_what_is_not_usable_do_not_matter():
    signals, usable = noise(2), np.ones(N_SAMPLES, bool)
    usable[20_000:21_000] = False
    spoilt = signals.copy()
    spoilt[1, ~usable] = np.nan
    expected, found = (log_levels(one, usable, RATE_HZ) for one in (signals, 7 * spoilt))
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("n_samples", [300, 401])
def test_without_windows_the_level_is_even(n_samples):
    usable = np.zeros(n_samples, bool)
    assert not log_levels(noise()[:, :n_samples], usable, RATE_HZ).any()


def test_silence_has_a_level():
    assert np.isfinite(log_levels(0 * noise(), np.ones(N_SAMPLES, bool), RATE_HZ)).all()
