"""Degradation models: covariances, evidence and present state against naive evaluations."""

from functools import partial

import numpy as np
import pytest
from drifting_series import history
from scipy.stats import multivariate_normal

from suspnet.trains.maintenance.degradation import (
    DEFAULT_PRIOR,
    DIFFUSIONS,
    FIRST_CHANGING,
    LEVEL_SPREAD,
    RATE_CHANGES,
    Motion,
    WearPrior,
    fit_models,
    positive_definite,
    powered,
)
from suspnet.trains.maintenance.noise import average, estimate_noise, noise_covariance

# reference: naive evaluation


@pytest.mark.parametrize("integrated", [False, True])
def test_brownian_motion_has_the_covariance_of_its_increments(integrated):
    """Sums over 3,000 steps: the error is of the order of a step."""
    n, t_last = 3000, 1.5
    dt = t_last / n
    steps = np.tril(np.ones((n, n))) * np.sqrt(dt)
    rate = steps
    paths = np.cumsum(steps, axis=0) * dt if integrated else steps
    at = np.array([299, 1499, 2399])
    since = (at + 1.0) * dt
    motion = Motion(np.ones(1), integrated)
    naive = paths[at] @ paths[at].T
    found = motion.covariance(since[None], np.zeros(3))[0]
    np.testing.assert_allclose(found, naive, rtol=0.01)
    with_last, own = (part[0] for part in motion.with_last(since[None], np.array([t_last])))
    np.testing.assert_allclose(with_last[:, 0], paths[at] @ paths[-1], rtol=0.01)
    np.testing.assert_allclose(own[0, 0], paths[-1] @ paths[-1], rtol=0.01)
    if integrated:
        np.testing.assert_allclose(with_last[:, 2], paths[at] @ rate[-1], rtol=0.01)
        np.testing.assert_allclose(own[0, 2], paths[-1] @ rate[-1], rtol=0.01)
        np.testing.assert_allclose(own[2, 2], t_last)
    else:
        assert (with_last[:, 1:] == 0).all()


@pytest.mark.parametrize("model", range(6))
def test_evidence_and_present_state_are_those_of_the_joint_gaussian(model):
    """Level, rate, Brownian motion and noise are one Gaussian vector, conditioned naively."""
    t, values, sigma = history(60, rate=-0.05)
    blocks, noise_of = average(t, values, sigma), partial(estimate_noise, t, np.log(values), sigma)
    noise = noise_of(np.append(0, DIFFUSIONS))
    prior = WearPrior(DEFAULT_PRIOR.models, np.ones(1), np.array([0.04]))
    fits = fit_models(blocks, noise_of, prior)
    assert len(fits) == 6
    fit = fits[model]
    rng = np.random.default_rng(3)
    nodes = np.unique(rng.integers(0, fit.log_weight.size, 6))
    state = fit.now(nodes)
    scale = np.ones(blocks.t.size) if model == 2 else 1 + blocks.value
    observed = (blocks.log_value if model == 2 else blocks.value) / scale
    naive, found = [], []
    for i, node in enumerate(nodes):
        m, s, o, _ = np.unravel_index(node, fit.log_weight.shape)
        start, onset = fit.hinges.onsets[s, 0], fit.hinges.onsets[s, o]
        power, row = fit.hinges.powers[s, o], fit.rows[m]
        which = m + 1 if model == 4 else 0
        covariance = noise_covariance(blocks, noise.variance[[which]], noise.correlation[[which]])[
            0
        ]
        spread = 1e-9 if model == 0 else 0.04
        # columns: level, rate, and what the present state is
        basis = np.stack([np.ones(blocks.t.size), powered(np.maximum(blocks.t - onset, 0), power)])
        if model == 3:  # the share of each block's trips after the step, as if evenly spaced
            past = (np.linspace(-0.5, 0.5, 200_001) * blocks.length[:, None]) > onset - blocks.t[
                :, None
            ]
            basis[1] = past.mean(axis=1) * powered(np.ones(1), 0)
        now = np.array([[1, powered(t[-1] - onset, power)], [0, 1], [0, 0]])
        weights = np.diag([LEVEL_SPREAD**2, spread**2])
        total = basis.T @ weights @ basis
        cross, own = now @ weights @ basis, now @ weights @ now.T
        if model > 3:
            changing = model == 5
            size = (RATE_CHANGES[row - FIRST_CHANGING] if changing else DIFFUSIONS[m]) ** 2
            motion = Motion(np.ones(1), changing)
            since = np.maximum(blocks.t - start, 0)[None]
            with_last, ends = motion.with_last(since, np.array([t[-1] - start]))
            total = total + size * motion.covariance(since, blocks.length)[0]
            cross, own = cross + size * with_last[0].T, own + size * ends[0]
        total = total / np.outer(scale, scale) + covariance
        gain = cross / scale @ np.linalg.inv(total)
        naive.append(
            multivariate_normal(cov=total).logpdf(observed)
            + fit.hinges.log_prior[s, o]
            + np.log(prior.models[row])
        )
        found.append(fit.log_weight.reshape(-1)[node])
        np.testing.assert_allclose(state.mean[i], gain @ observed, rtol=1e-5, atol=1e-9)
        spread_now = own - gain @ (cross / scale).T
        np.testing.assert_allclose(state.covariance[i], spread_now, rtol=1e-4, atol=1e-10)
        assert state.row[i] == row
    constant = blocks.t.size / 2 * np.log(2 * np.pi)
    np.testing.assert_allclose(found, np.array(naive) + constant, rtol=1e-6, atol=1e-4)


def test_covariance_that_is_none_is_made_one():
    near = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.9], [0.0, 0.9, 1.0]])  # least eigenvalue -0.27
    values = np.linalg.eigvalsh(near)
    found = positive_definite(np.stack([near, np.eye(3)]))
    np.testing.assert_allclose(found[1], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(found[0])[1:], values[1:], rtol=1e-9)
    np.linalg.cholesky(found)
