"""CUSUM of pre-whitened trips against a growing reference, and its thresholds.

Symbols: t is the index of a trip, j the number of trips in the reference, phi the correlation of
successive trips.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from suspnet.ground.settings import check_number
from suspnet.ground.types import BoolArray, FloatArray, IntArray

ALLOWANCE = 0.5  # k of the CUSUM, in standard deviations: half of the shift for which it is optimal
CLIP = 6.0
"""Largest deviation of a trip that counts, [standard deviations]: none raises an alarm alone."""
DELAY = 10  # number of trips after which a trip joins the reference: a change is detected earlier
MAX_CORRELATION = 0.6  # largest correlation of successive trips that pre-whitening removes
LEAST_SPREAD = 1e-6
"""Least standard deviation of trips, in the unit of the values: anything less is rounding."""
N_REFERENCE = 20  # number of first trips that form the reference; no change is detected before
THRESHOLDS = (
    (0.01, 6.000),
    (0.005729, 6.607),
    (0.003282, 7.746),
    (0.00188, 9.102),
    (0.001077, 10.480),
    (0.0006171, 11.890),
    (0.0003536, 13.271),
    (0.0002025, 14.546),
    (0.000116, 15.691),
    (6.648e-05, 17.497),
    (3.809e-05, 19.566),
    (2.182e-05, 21.491),
    (1.25e-05, 23.054),
)
"""Rates of false alarms over 10 to 200 trips after the reference and their thresholds, for trips
whose correlation is up to 0.5, as benchmarks/thresholds.py simulates them."""


@dataclass(frozen=True)
class Residuals:
    """Deviation of each trip after the first reference from its reference, (n_trips, ...).

    `standard` are pre-whitened deviations, approximately standard normal without a change.
    `deviations` are trips minus the values expected from reference and covariates, not
    pre-whitened, in the unit of the trips. `leverage` is the variance of the expected value over
    that of a trip; above 1, the covariates are too unlike those of the reference. `n_reference`,
    (n_trips,), counts the trips that are old enough for the reference, `correlation` is phi, and
    `usual` is whether the trip may join the reference: abs(z) is at most ``CLIP``.
    """

    standard: FloatArray
    deviations: FloatArray
    leverage: FloatArray
    n_reference: IntArray
    correlation: FloatArray
    usual: BoolArray

    def of(self, i: int) -> Self:
        """Return the residuals of the `i`-th parameter, along the last axis."""
        columns = {name: column[..., i] for name, column in vars(self).items() if column.ndim > 1}
        return replace(self, **columns)


def residuals(
    values: FloatArray, covariates: FloatArray, n_reference: int = N_REFERENCE
) -> Residuals:
    """Return the deviation of each trip from a reference that grows with the history.

    Trip t is compared with the j trips before t - ``DELAY``, but at least the first `n_reference`.
    With x the row (1, covariates), trips follow y_t = x_t' b + r_t and r_t = phi r_(t-1) + e_t:

    - phi is the posterior mean, with equal prior weights on 0 to ``MAX_CORRELATION``, given the
      first autocorrelation of the least-squares residuals, whose bias is -(1 + 3 phi) / j and
      whose variance is (1 - phi^2) / j;
    - b and the variance s^2 of e follow from least squares on x_t - phi x_(t-1);
    - z, e_t over its standard deviation including the uncertainty of b, follows Student's t with
      nu = j - 1 minus the length of x degrees of freedom and is made normal by
      z (1 - 1 / (4 nu)) / sqrt(1 + z^2 / (2 nu)) (Abramowitz and Stegun, 26.7.8).

    A later trip with abs(z) above ``CLIP`` never joins the reference, where one outlier would hide
    changes: a lasting change of that size has already raised an alarm.

    `values` is (n_trips, ...), `covariates` (n_trips, ..., n_covariates), where n_covariates may
    be 0. ValueError is raised if `n_reference` is below 8 or n_covariates + 4, or the covariates of
    the reference are linearly dependent.
    """
    n_covariates = covariates.shape[-1]
    check_number("n_reference", n_reference, low=max(8, n_covariates + 4), whole=True)
    centred = values - values[:n_reference].mean(axis=0)
    rows = np.concatenate([np.ones((*values.shape, 1)), covariates, centred[..., None]], axis=-1)
    in_reference = np.ones(values.shape, dtype=bool)
    # which trips join depends on the z of trips at least DELAY older: each pass settles DELAY more
    for _ in range(len(values) // DELAY + 2):
        rest = _compare(rows, in_reference, n_reference)
        if (rest.usual == in_reference[n_reference:]).all():
            break
        in_reference[n_reference:] = rest.usual
    return rest


def _compare(rows: FloatArray, in_reference: BoolArray, n_reference: int) -> Residuals:
    """Return the residuals of rows (x, y), (n_trips, ..., n_x + 1), against the reference."""
    # all references are prefixes of the history: their moments are differences of cumulative sums
    used = rows * in_reference[..., None]
    squares = np.cumsum(_outer(used, used), axis=0)
    products = np.cumsum(_outer(used[1:], used[:-1]), axis=0)
    now = np.arange(n_reference, len(rows))
    j = np.maximum(n_reference, now - DELAY)
    ends, where = np.unique(j, return_inverse=True)
    size = np.cumsum(in_reference, axis=0)[ends - 1].astype(float)
    first, last = _outer(used[:1], used[:1]), _outer(used[ends - 1], used[ends - 1])
    squares, products = squares[ends - 1], products[ends - 2]
    least = size * LEAST_SPREAD**2
    try:
        # first phi from plain least squares, then b from the pre-whitened rows
        plain = _contrast(squares)
        phi = _posterior_mean(
            _form(products, plain) / np.maximum(_form(squares, plain), least), size
        )
        p = phi[..., None, None]
        both = products + np.swapaxes(products, -1, -2)
        whitened = (squares - first) - p * both + p**2 * (squares - last)
        contrast = _contrast(whitened)
        inverse = np.linalg.inv(whitened[..., :-1, :-1])
    except np.linalg.LinAlgError:
        raise ValueError(
            "covariates of the reference trips must not determine each other"
        ) from None
    freedom = size - rows.shape[-1]
    variance = np.maximum(_form(whitened, contrast), least) / freedom
    phi, nu = phi[where], freedom[where]
    # each trip against the reference that it belongs to, and made standard normal
    step = rows[now] - phi[..., None] * rows[now - 1]
    leverage = _form(inverse[where], step[..., :-1])
    z = np.einsum("...i,...i", step, contrast[where])
    z = z / np.sqrt(variance[where] * (1 + leverage))
    standard = z * (1 - 0.25 / nu) / np.sqrt(1 + z**2 / (2 * nu))
    deviations = np.einsum("...i,...i", rows[now], contrast[where])
    return Residuals(standard, deviations, leverage, j, phi, np.abs(z) <= CLIP)


def cusum(standard: FloatArray) -> FloatArray:
    """Return the upward and the downward CUSUM of residuals.

    S_t = max(0, S_(t-1) + s z_t - k) with s = 1 and -1, k = ``ALLOWANCE``, z clipped to
    +-``CLIP``, and S = 0 before the first trip (E. S. Page, Biometrika 41, 1954). `standard` is
    (n_trips, ...), the result (2, n_trips, ...).
    """
    z = np.clip(standard, -CLIP, CLIP)
    walks = np.cumsum(np.stack([z, -z]) - ALLOWANCE, axis=1)
    return walks - np.minimum(0, np.minimum.accumulate(walks, axis=1))


def threshold(rate: ArrayLike) -> FloatArray:
    """Return the thresholds of ``cusum``, [standard deviations], for rates of false alarms.

    A rate counts first false alarms per monitored trip. The log rate is interpolated linearly in
    ``THRESHOLDS``, and extrapolated beyond its rarest alarms with the slope of the last decade,
    flatter than the exp(-2 k h) of a known level; a threshold is at least ``CLIP``, so that
    no trip raises an alarm alone. ValueError is raised if a rate is not above 0 and below 1.
    """
    rates = np.asarray(rate, dtype=float)
    if not ((rates > 0) & (rates < 1)).all():
        raise ValueError(f"`rate` must be above 0 and below 1, got {rates}")
    rarer, limits = -np.log([row[0] for row in THRESHOLDS]), [row[1] for row in THRESHOLDS]
    beyond = np.maximum(-np.log(rates) - rarer[-1], 0.0)
    slope = (limits[-1] - limits[-5]) / (rarer[-1] - rarer[-5])
    return np.asarray(np.interp(-np.log(rates), rarer, limits) + slope * beyond)


def _posterior_mean(lagged: FloatArray, size: FloatArray) -> FloatArray:
    """Return the posterior mean of phi, given the lag-1 autocorrelation of `size` residuals."""
    grid = np.linspace(0, MAX_CORRELATION, 13).reshape(-1, *[1] * lagged.ndim)
    mean, variance = grid - (1 + 3 * grid) / size, (1 - grid**2) / size
    log_weights = -((lagged - mean) ** 2) / (2 * variance) - np.log(variance) / 2
    weights = np.exp(log_weights - log_weights.max(axis=0))
    return np.asarray((grid * weights).sum(axis=0) / weights.sum(axis=0))


def _outer(left: FloatArray, right: FloatArray) -> FloatArray:
    return left[..., :, None] * right[..., None, :]


def _contrast(moments: FloatArray) -> FloatArray:
    """Return (-b, 1), whose product with a row (x, y) is the row's least-squares residual."""
    b = np.linalg.solve(moments[..., :-1, :-1], moments[..., :-1, -1:])[..., 0]
    return np.concatenate([-b, np.ones((*b.shape[:-1], 1))], axis=-1)


def _form(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return v' M v."""
    return np.asarray(np.einsum("...i,...ij,...j", vector, matrix, vector))
