"""CUSUM of pre-whitened trips against plain loops and against run lengths of the R package spc."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from suspnet.trains.maintenance.cusum import (
    ALLOWANCE,
    CLIP,
    DELAY,
    LEAST_SPREAD,
    MAX_CORRELATION,
    N_REFERENCE,
    cusum,
    residuals,
    threshold,
)

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
simulated = pytest.importorskip("thresholds", reason="needs benchmarks")
RUN_LENGTHS = [
    (4, 0, 167.6837888),
    (4, 0.5, 26.63020309),
    (4, 1, 8.38313187),
    (4, 2, 3.342770129),
    (5, 0, 465.443506),
    (5, 0.5, 37.99614319),
    (5, 1, 10.37596992),
    (5, 2, 4.008871061),
    (8, 1, 16.37195986),
    (10, 1, 20.37177766),
]
"""Threshold, mean and run length: xcusum.arl(0.5, h, mu, sided="two") of R's spc 0.6.7."""


def histories(n_trips=60, n_series=3, n_covariates=2, seed=0):
    random = np.random.default_rng(seed)
    covariates = random.standard_normal((n_trips, n_series, n_covariates))
    noise = simulated.autoregressive(random.standard_normal((n_trips, n_series)), 0.4)
    return 5 + noise + covariates @ np.array([2.0, -1.0, 0.5])[:n_covariates], covariates


def least_squares(x, y):
    b = np.linalg.lstsq(x, y, rcond=None)[0]
    return b, y - x @ b


def naive_phi(r, j):
    """Return the posterior mean of the correlation of the j residuals `r`."""
    lagged = sum(r[i] * r[i - 1] for i in range(1, len(r))) / sum(one**2 for one in r)
    total = weighted = 0.0
    for phi in np.linspace(0, MAX_CORRELATION, 13):
        weight = stats.norm.pdf(lagged, phi - (1 + 3 * phi) / j, math.sqrt((1 - phi**2) / j))
        total, weighted = total + weight, weighted + weight * phi
    return weighted / total


def naive_residual(y, covariates, t, left_out, n_reference=N_REFERENCE):
    """Return z before and after it is made normal, deviation, leverage and phi of trip `t`."""
    n_old = max(n_reference, t - DELAY)
    x = np.column_stack([np.ones(len(y)), covariates])
    old_x, old_y = x[:n_old].copy(), y[:n_old].copy()
    gone = [one for one in left_out if one < n_old]
    old_x[gone], old_y[gone] = 0, 0
    j = n_old - len(gone)
    phi = naive_phi(least_squares(old_x, old_y)[1], j)
    white_x, white_y = old_x[1:] - phi * old_x[:-1], old_y[1:] - phi * old_y[:-1]
    b, e = least_squares(white_x, white_y)
    nu = j - 1 - x.shape[1]
    step = x[t] - phi * x[t - 1]
    leverage = step @ np.linalg.inv(white_x.T @ white_x) @ step
    spread = math.sqrt(max(sum(e**2), j * LEAST_SPREAD**2) / nu)
    z = (y[t] - phi * y[t - 1] - step @ b) / (spread * math.sqrt(1 + leverage))
    normal = z * (1 - 1 / (4 * nu)) / math.sqrt(1 + z**2 / (2 * nu))
    return z, normal, y[t] - x[t] @ b, leverage, phi


def naive_residuals(y, covariates, n_reference=N_REFERENCE):
    rows, left_out = [], []
    for t in range(n_reference, len(y)):
        z, *row = naive_residual(y, covariates, t, left_out, n_reference)
        rows.append(row)
        if abs(z) > CLIP:
            left_out.append(t)
    return np.array(rows).T, left_out


# reference


@pytest.mark.parametrize("n_covariates", [0, 1, 3])
def test_residuals_are_those_of_plain_loops(n_covariates):
    values, covariates = histories(n_covariates=n_covariates)
    values[[25, 40, 41], 0] += [30, -9, 200]
    found = residuals(values, covariates, N_REFERENCE)
    left_out = []
    for i in range(values.shape[1]):
        centred = values[:, i] - values[:N_REFERENCE, i].mean()
        expected, gone = naive_residuals(centred, covariates[:, i])
        for name, one in zip(
            ("standard", "deviations", "leverage", "correlation"), expected, strict=True
        ):
            np.testing.assert_allclose(getattr(found, name)[:, i], one, rtol=1e-6, atol=1e-9)
        left_out.append(gone)
    assert {25, 41} <= set(left_out[0])
    assert not left_out[1]
    t = np.arange(N_REFERENCE, len(values))
    np.testing.assert_array_equal(found.n_reference, np.maximum(N_REFERENCE, t - DELAY))


def test_healthy_residuals_are_about_standard_normal():
    random = np.random.default_rng(1)
    values = simulated.autoregressive(random.standard_normal((40, 3000)), 0.3)
    z = residuals(values, np.empty((40, 3000, 0)), N_REFERENCE).standard
    assert np.abs(z.mean(axis=1)).max() < 0.1
    assert 0.95 < z.std() < 1.05
    assert abs((z[1:] * z[:-1]).mean()) < 0.1


def test_cusum_is_its_recursion():
    z = 3 * np.random.default_rng(2).standard_normal((80, 2, 3))
    expected = np.zeros((2, *z.shape))
    for i, sign in enumerate((1, -1)):
        sums = np.zeros(z.shape[1:])
        for t, one in enumerate(z):
            sums = np.maximum(0, sums + sign * np.clip(one, -CLIP, CLIP) - ALLOWANCE)
            expected[i, t] = sums
    assert np.abs(z).max() > CLIP
    np.testing.assert_allclose(cusum(z), expected, atol=1e-12)


def test_autoregressive_has_unit_variance_and_its_correlation():
    mixing = simulated.autoregressive(np.eye(12), 0.4)
    lags = np.abs(np.subtract.outer(np.arange(12), np.arange(12)))
    np.testing.assert_allclose(mixing @ mixing.T, 0.4**lags, atol=1e-12)


@pytest.mark.parametrize(("limit", "mean", "expected"), RUN_LENGTHS)
def test_run_lengths_are_those_of_spc(limit, mean, expected):
    """CLIP changes nothing: a normal trip is beyond it once in 1e4 even at mean 2."""
    n_series = 400 if mean == 0 else 4000
    n_trips = int(12 * expected) + 20
    z = np.random.default_rng(4).standard_normal((n_trips, n_series)) + mean
    beyond = (cusum(z) > limit).any(axis=0)
    lengths = np.where(beyond.any(axis=0), beyond.argmax(axis=0) + 1, n_trips)
    assert abs(lengths.mean() - expected) < 4 * lengths.std() / math.sqrt(n_series)


def test_rate_is_first_alarms_over_trips_monitored():
    peaks = np.maximum.accumulate(np.random.default_rng(5).gamma(2.0, 2.0, (200, 40)), axis=0)
    rates = []
    for horizon in simulated.HORIZONS:
        alarms = trips = 0
        for history in peaks[:horizon].T:
            for peak in history:
                trips += 1
                if peak > 12:
                    alarms += 1
                    break
        rates.append(alarms / trips)
    assert 0 < max(rates) < 1
    assert simulated.false_alarm_rate(peaks, 12) == pytest.approx(max(rates), rel=1e-12)


def test_threshold_keeps_the_rate_on_other_histories():
    random = np.random.default_rng(6)
    values = simulated.autoregressive(random.standard_normal((N_REFERENCE + 200, 1000)), 0.5)
    z = residuals(values, np.empty((*values.shape, 0)), N_REFERENCE).standard
    peaks = np.maximum.accumulate(cusum(z).max(axis=0), axis=0)
    rate = 2e-3
    first = (peaks <= threshold(rate)).sum(axis=0)
    for horizon in simulated.HORIZONS:
        allowed = stats.poisson.ppf(0.999, rate * np.minimum(first + 1, horizon).sum())
        assert (first < horizon).sum() <= allowed


# limit


def test_identical_trips_deviate_by_nothing_and_no_trips_leave_nothing():
    for level in (1.0, 1.1, 1e6):
        found = residuals(np.full((60, 1), level), np.empty((60, 1, 0)), N_REFERENCE)
        assert np.abs(found.standard).max() < 1e-2
    found = residuals(np.ones((20, 2)), np.empty((20, 2, 0)), N_REFERENCE)
    assert found.standard.shape == (0, 2)
    assert cusum(found.standard).shape == (2, 0, 2)


@pytest.mark.parametrize(("rate", "expected"), [(1.25e-5, 23.07), (3e-6, 25.93), (1.6e-6, 27.37)])
def test_thresholds_of_rare_alarms_are_those_of_more_histories(rate, expected):
    """Expected ones are of 64,000 histories, which show these rates; 8,000 are extrapolated."""
    assert -0.3 < threshold(rate) - expected < 3


# property


def test_residuals_know_neither_level_nor_scale_nor_units_of_covariates():
    values, covariates = histories()
    expected = residuals(values, covariates, N_REFERENCE)
    turned = covariates @ np.array([[2.0, 1.0], [-1.0, 3.0]]) + np.array([1.0, -2.0])
    found = residuals(3e-2 * values + 7, turned, N_REFERENCE)
    np.testing.assert_allclose(found.standard, expected.standard, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(found.leverage, expected.leverage, rtol=1e-6)
    np.testing.assert_allclose(found.correlation, expected.correlation, rtol=1e-6)
    np.testing.assert_allclose(found.deviations, 3e-2 * expected.deviations, rtol=1e-5, atol=1e-9)


def test_an_outlier_never_widens_the_reference():
    values, covariates = histories(n_trips=120)
    spoilt = values.copy()
    spoilt[30] += 1e4
    far = np.arange(60, 100)
    expected = residuals(values, covariates, N_REFERENCE).standard[far]
    found = residuals(spoilt, covariates, N_REFERENCE).standard[far]
    np.testing.assert_allclose(found, expected, atol=0.5)


# failure


@pytest.mark.parametrize(
    ("n_reference", "covariates", "message"),
    [
        (7, np.empty((30, 1, 0)), "`n_reference` must be"),
        (9, np.random.default_rng(7).standard_normal((30, 1, 6)), "`n_reference` must be"),
        (N_REFERENCE, np.ones((30, 1, 1)), "must not determine each other"),
    ],
)
def test_references_that_are_too_short_or_dependent_are_refused(n_reference, covariates, message):
    with pytest.raises(ValueError, match=message):
        residuals(np.ones((30, 1)), covariates, n_reference)


@pytest.mark.parametrize("rate", [0.0, 1.0, np.nan])
def test_bad_rates_are_refused(rate):
    with pytest.raises(ValueError, match="`rate` must be"):
        threshold(rate)
