"""First passages: closed forms, and paths of small steps."""

import numpy as np
import pytest
from scipy.stats import kstest, norm

from suspnet.trains.maintenance.life import FUTURE, changing_passage_km, first_passage_km
from suspnet.trains.maintenance.noise import UNIT_KM

# reference


def inverse_gaussian_cdf(t, distance, rate, variance):
    """Return the probability that a limit is passed by `t`; the closed form (Chhikara, Folks)."""
    root = np.sqrt(variance * t)
    return norm.cdf((rate * t - distance) / root) + np.exp(
        2 * rate * distance / variance
    ) * norm.cdf(-(rate * t + distance) / root)


@pytest.mark.parametrize("rate", [-0.02, 0.001, 0.05, 0.5])
def test_first_passage_has_the_law_of_the_wiener_process(rate):
    n, distance, variance = 20_000, 0.2, 0.03**2
    rng = np.random.default_rng(4)
    km = first_passage_km(np.full(n, distance), np.full(n, rate), np.full(n, variance), rng)
    reached = np.exp(2 * rate * distance / variance) if rate < 0 else 1.0
    share = np.isfinite(km).mean()
    assert share == pytest.approx(reached, abs=4 * np.sqrt(reached * (1 - reached) / n) + 1e-12)
    if share > 0:
        sample = km[np.isfinite(km)] / UNIT_KM

        def cdf(t):
            return inverse_gaussian_cdf(t, distance, rate, variance) / reached

        assert kstest(sample, cdf).pvalue > 1e-3


def test_first_passage_without_diffusion_is_distance_over_rate():
    distance = np.array([0.2, 0.2, 0.0, -0.1, np.inf])
    rate = np.array([0.05, -0.05, 0.05, -0.05, 0.05])
    km = first_passage_km(distance, rate, np.zeros(5), np.random.default_rng(0))
    np.testing.assert_allclose(km, np.array([4, np.inf, 0, 0, np.inf]) * UNIT_KM)


def test_passage_of_a_changing_rate_is_that_of_small_steps():
    """Medians of 4,000 draws and of paths of 2,000 small steps; 4 standard errors are 7 %."""
    n, rate, spread, upper = 4_000, 0.04, 0.02, 0.3
    rng = np.random.default_rng(6)
    mean = np.broadcast_to(rate * FUTURE, (n, FUTURE.size))
    found = changing_passage_km(mean, -np.inf, upper, np.full(n, spread), rng)
    dt = 0.01
    rates = rate + spread * np.sqrt(dt) * np.cumsum(rng.normal(size=(1_000, 2_000)), axis=1)
    values = np.cumsum(rates, axis=1) * dt
    passed = values >= upper
    naive = np.where(passed.any(axis=1), passed.argmax(axis=1) * dt, np.inf) * UNIT_KM
    for q in (0.2, 0.5):
        known = np.quantile(naive, q, method="inverted_cdf")
        assert np.quantile(found, q, method="inverted_cdf") == pytest.approx(known, rel=0.07)
