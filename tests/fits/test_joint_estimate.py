"""Several trips as one estimate: naive formula, one trip, draws of known errors, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from test_bogie_fit import VEHICLE

from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter
from suspnet.ground.parameters import BOGIE_PARTS
from suspnet.trains.fits.bogie_fit import beyond_noise
from suspnet.trains.fits.joint_estimate import joint_estimate
from suspnet.trains.fits.worn_parts import least_losses

LEVEL = 0.9
Z = norm.ppf((1 + LEVEL) / 2)


def bogie(misfit=1.0, seed=0):
    """Return a bogie whose healthy trips scatter, their noise correlated."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((12, 12)) + 2 * np.eye(12)
    noise = tuple(map(tuple, 1e-5 * root @ root.T))
    scatter = HealthyScatter((2e-3, 1e-2, 1e-3, 3e-3), (1e-3, 5e-3, 0.0, 1e-3), 6, noise)
    return CommissionedBogie(VEHICLE, None, np.ones(6), misfit, True, scatter)


def half_widths(of, logs):
    """Return the half widths of the intervals of trips with the noise of the healthy ones."""
    widths = []
    for log in logs:
        beyond = beyond_noise(of, np.append(log, 0.0), LEVEL)[0][:-1, :-1]
        widths.append(np.sqrt(np.diag(np.array(of.scatter.noise) + beyond)))
    return Z * np.array(widths)


def test_one_trip_keeps_its_interval():
    of, logs = bogie(misfit=2.0), np.log([[0.7, *[1.01] * 11]])
    found = joint_estimate(of, logs, half_widths(of, logs), LEVEL)
    np.testing.assert_allclose(found.values, np.exp(logs[0]), rtol=1e-12)
    np.testing.assert_allclose(Z * found.deviations, half_widths(of, logs)[0], rtol=1e-9)
    assert found.names == BOGIE_PARTS


def test_estimate_is_that_of_the_formula():
    of = bogie(misfit=2.0)
    logs = 0.02 * np.random.default_rng(1).standard_normal((3, 12))
    logs[:, 4] -= 0.3
    found = joint_estimate(of, logs, half_widths(of, logs), LEVEL)
    noise, scatter = np.array(of.scatter.noise), of.scatter.widened(LEVEL)
    total = noise + scatter
    np.testing.assert_allclose(np.log(found.values), logs.mean(axis=0), rtol=1e-9)
    wear = beyond_noise(of, np.append(logs.mean(axis=0), 0.0), LEVEL)[0][:-1, :-1] - scatter
    expected = (6 / 7) * total / 3 + total / 7 + wear
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-9, atol=1e-15)


def test_the_error_of_draws_is_that_of_the_covariance():
    """Each trip errs by itself, and all of them by what the mean of six healthy ones errs."""
    of, rng = bogie(), np.random.default_rng(2)
    total = np.array(of.scatter.noise) + of.scatter.widened(LEVEL)
    root, n, errors = np.linalg.cholesky(total), 4, []
    for _ in range(2000):
        trips = rng.standard_normal((n + 6, 12)) @ root.T
        # relative to the healthy ones, with the covariance of one trip
        logs = np.sqrt(6 / 7) * (trips[:n] - trips[n:].mean(axis=0))
        errors.append(np.log(joint_estimate(of, logs, WIDTHS, LEVEL).values))
    found = np.cov(np.array(errors).T)
    stated = joint_estimate(of, np.zeros((n, 12)), WIDTHS, LEVEL).covariance
    np.testing.assert_allclose(np.diag(found), np.diag(stated), rtol=0.12)


WIDTHS = half_widths(bogie(), np.zeros((4, 12)))


def test_a_bogie_without_parts_is_refused():
    of = bogie()
    of_kinds = replace(of.scatter, noise=tuple(map(tuple, np.eye(4))))
    with pytest.raises(ValueError, match="do not show each part"):
        joint_estimate(replace(of, scatter=of_kinds), np.zeros((1, 12)), WIDTHS[:1], LEVEL)
    with pytest.raises(ValueError, match="do not show each part"):
        least_losses(replace(of, scatter=of_kinds))
