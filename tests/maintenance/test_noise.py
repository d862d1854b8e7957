"""Noise of a history: covariance of blocks, its estimate, and trips that lie far off."""

import numpy as np
import pytest
from drifting_series import history
from scipy.linalg import block_diag

from suspnet.trains.maintenance.noise import (
    MAX_BLOCKS,
    average,
    clip_outliers,
    estimate_noise,
    noise_covariance,
    robust_spread,
)

# reference


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("n_trips", [7, 40, 97])
def test_covariance_of_blocks_is_that_of_averaged_trips(rho, n_trips):
    t, values, sigma = history(n_trips)
    blocks = average(t, values, sigma)
    assert blocks.t.size == min(n_trips, MAX_BLOCKS)
    assert blocks.size.sum() == n_trips
    mean = block_diag(*(np.full((1, size), 1 / size) for size in blocks.size))
    trips = np.arange(n_trips)
    naive = sigma[0] ** 2 * mean @ rho ** np.abs(trips[:, None] - trips) @ mean.T
    found = noise_covariance(blocks, np.array([1.0]), np.array([rho]))[0]
    assert naive.max() > 0
    np.testing.assert_allclose(found, naive, rtol=1e-6, atol=1e-6 * naive.max())


# property


@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_noise_is_found_whatever_the_half_widths_say(rho):
    spreads, correlations = [], []
    for seed in range(20):
        t, values, sigma = history(300, seed, rho=rho)
        noise = estimate_noise(t, np.log(values), 3 * sigma, np.zeros(1))
        spreads.append(3 * np.sqrt(noise.variance[0]))
        correlations.append(noise.correlation[0])
    # 20 histories of 300 trips: standard errors are 0.01 of each, plus the grid
    assert np.mean(spreads) == pytest.approx(1, abs=0.12)
    assert np.mean(correlations) == pytest.approx(rho, abs=0.12)


def test_spread_of_a_straight_line_is_that_of_its_noise():
    rng = np.random.default_rng(2)
    line = np.linspace(0, 1, 5_000) + 0.01 * rng.normal(size=5_000)
    assert robust_spread(np.diff(line, 2), 6) == pytest.approx(0.01, rel=0.05)


def test_only_outlying_trips_are_tamed():
    _, values, _ = history(100, rate=-0.2)
    np.testing.assert_array_equal(clip_outliers(values), values)
    odd = values.copy()
    odd[[0, 50, 99]] *= [2, 0.4, 1.5]
    tamed = clip_outliers(odd)
    np.testing.assert_allclose(tamed, values, rtol=0.1)
    kept = ~np.isin(np.arange(100), [0, 50, 99])
    np.testing.assert_array_equal(tamed[kept], values[kept])
