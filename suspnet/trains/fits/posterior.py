"""What some trips tell of a bogie's numbers and parts at the minimum of their sum of squares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suspnet.ground.types import FloatArray
from suspnet.trains.fits.bogie_misfit import BogieMisfit
from suspnet.trains.spectra.model_errors import SPACING_HZ

DRAWS = 60
"""Draws by which a posterior's bend is measured. In README's demonstration the true vehicle is at
chi^2 = 4470 of a posterior without it, and at 94 with it, of 91 numbers."""
LEAST_CHANCE = 1e-4
"""Least standard deviation of the logarithms that dampers differ by from trip to trip."""


def posterior_covariance(fit: BogieMisfit, x: FloatArray, excess: float) -> FloatArray:
    """Return the posterior covariance of all coordinates, residuals `excess` times as large.

    `excess` is that of their squares. With J the derivatives of all residuals and P those of
    the priors, w = 1 where residuals are of noise alone, it is ::

        A^-1 (J^T w J / excess + P^T P) A^-1,     A = J^T J / excess + P^T P

    Errors of the vehicle are the same on all trips and alike in neighbouring bins: where the
    fraction s of a residual's variance is theirs, w = 1 + s (n - 1), with n the number of trips
    times that of the bins in ``SPACING_HZ``.
    """
    jacobian = fit.exact.jacobian(x)
    n_prior = len(fit.prior_deviations)
    data, prior = jacobian[:-n_prior], jacobian[-n_prior:]
    inverse = np.linalg.inv(data.T @ data / excess + prior.T @ prior)
    if fit.errors is None or not fit.are_healthy:
        return np.asarray(inverse)
    n_alike = SPACING_HZ / float(fit.frequencies_hz[:2].diff()) * len(fit.trips)
    weights = 1 + fit.exact.error_shares(x) * max(0.0, n_alike - 1)
    middle = (data.T * weights) @ data / excess + prior.T @ prior
    return np.asarray(inverse @ middle @ inverse)


def bent(fit: BogieMisfit, x: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return a posterior covariance with what it neglects: residuals are not linear in x.

    The minimum lies in a valley that bends: where some numbers are off by d, normal with the
    `covariance`, others have to follow. With r all residuals and J their derivatives ::

        q = (r(x + d) + r(x - d)) / 2 - r(x),    s = -(J^T J)^-1 J^T q

    and the mean of s s^T over ``DRAWS`` of d is added.
    """
    residuals, jacobian = fit.exact, fit.exact.jacobian(x)
    draws = np.random.default_rng(0).standard_normal((DRAWS, len(x)))
    offs, at_x = draws @ np.linalg.cholesky(covariance).T, residuals(x)
    even = [(residuals(x + off) + residuals(x - off)) / 2 - at_x for off in offs]
    steps = np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ np.transpose(even))
    return covariance + steps @ steps.T / DRAWS


def step_left(fit: BogieMisfit, x: FloatArray) -> float:
    """Return the largest Newton step of a part from x, in deviations of the posterior."""
    slopes = fit.exact.jacobian(x)
    spread = np.linalg.inv(slopes.T @ slopes)
    step = -spread @ (slopes.T @ fit.exact(x))
    rows = np.eye(len(x))[fit.n_shared :]  # the trips' own numbers
    if fit.are_healthy:
        names = [name.startswith("healthy_") for name in fit.numbers.names]
        factor = fit.numbers.factor[np.flatnonzero(names)]
        rows = np.pad(factor, ((0, 0), (0, len(x) - fit.n_numbers)))
    deviations = np.sqrt(np.einsum("ij,jk,ik->i", rows, spread, rows))
    return float(np.abs(rows @ step / deviations).max())


def with_chance_at(fit: BogieMisfit, x: FloatArray, *, at_end: bool = False) -> BogieMisfit:
    """Return the fit with the scatter of the dampers that healthy trips show at x.

    With u_i what the dampers of a kind differ by on trip i, V_i its variance and s the standard
    deviation so far, s^2 becomes the mean of u_i^2 + V_i, a step of expectation maximisation. At
    the end of a search it is at once what such steps lead to in the end (MacKay 1992, eq. 4.9), but
    at least ``LEAST_CHANCE``^2 ::

        sum_i u_i^2 / sum_i (1 - V_i / s^2)

    so that it vanishes where the trips show none. A search from afar needs the play of the former.
    """
    if not fit.n_chance:
        return fit
    if at_end:
        slopes = fit.exact.jacobian(x)
        covariance = np.linalg.inv(slopes.T @ slopes)
    else:
        covariance = posterior_covariance(fit, x, 1.0)
    every = np.stack([x, np.diag(covariance)])[:, fit.n_shared :].reshape(2, len(fit.trips), -1)
    own, variances = every[:, :, : fit.n_chance]
    if at_end:
        known = np.maximum((1 - variances / np.square(fit.chance)).sum(axis=0), LEAST_CHANCE**2)
        squares = np.maximum(np.square(own).sum(axis=0) / known, LEAST_CHANCE**2)
    else:
        squares = (np.square(own) + variances).mean(axis=0)
    c_p, c_s = np.sqrt(squares).tolist()
    return replace(fit, chance=(c_p, c_s))
