"""CUSUM of pre-whitened trips against a reference that grows, and its thresholds by simulation.

Symbols: t counts trips, j the trips in the reference, phi is the correlation of successive trips.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.checks import check_number
from suspnet.ground.types import BoolArray, FloatArray, IntArray

ALLOWANCE = 0.5
"""k of the CUSUM, in standard deviations: half of the smallest change that it is best for."""
CLIP = 6.0
"""Deviation to which one trip is limited, in standard deviations: no trip raises an alarm alone."""
DELAY = 10
"""Number of trips after which a trip joins the reference: a change is detected before."""
MAX_CORRELATION = 0.6
"""Largest correlation of successive trips that pre-whitening removes."""
LEAST_SPREAD = 1e-6
"""Least standard deviation of trips, in the unit of the values: smaller is rounding."""
N_SIMULATED = 8000
N_MONITORED = 200
"""Number of simulated healthy histories, and of their trips after the reference."""
HORIZONS = (10, 20, 50, 100, 200)
"""Numbers of trips after the reference over each of which the false-alarm rate holds."""


@dataclass(frozen=True)
class Residuals:
    """Deviation of each trip from the reference.

    Attributes
    ----------
    standard : array of shape (n_trips - n_reference, ...), [-]
        Pre-whitened, about standard normal as long as nothing changes.
    deviations : array of the same shape
        Trip minus its expectation by reference and covariates, not pre-whitened, in the unit of the
        trips.
    leverage : array of the same shape, [-]
        Variance of that expectation over the variance of a trip: above 1, the covariates are too
        unlike those of the reference.
    n_reference : int array of shape (n_trips - n_reference,)
        Trips that are old enough for the reference.
    correlation : array of the shape of `standard`, [-]
        phi.
    usual : bool array of the shape of `standard`
        Whether the trip may become part of the reference: abs(z) is at most ``CLIP``.
    """

    standard: FloatArray
    deviations: FloatArray
    leverage: FloatArray
    n_reference: IntArray
    correlation: FloatArray
    usual: BoolArray

    def of(self, i: int) -> Residuals:
        """Return the residuals of one parameter, the `i`-th of the last axis."""
        one = {name: column[..., i] for name, column in vars(self).items() if column.ndim > 1}
        return replace(self, **one)


def residuals(values: FloatArray, covariates: FloatArray, n_reference: int) -> Residuals:
    """Return the deviation of each trip from a reference that grows with the history.

    Trip t is compared with the j trips before t - ``DELAY``, with the first `n_reference` at least.
    With x the row (1, covariates), trips follow y_t = x_t' b + r_t and r_t = phi r_(t-1) + e_t:

    - phi is the posterior mean, with equal prior weights on 0 to ``MAX_CORRELATION``, given the
      first autocorrelation of the least-squares residuals, whose bias is -(1 + 3 phi) / j and
      whose variance is (1 - phi^2) / j;
    - b and the variance s^2 of e are those of least squares on x_t - phi x_(t-1), s^2 at least
      j / nu times the square of ``LEAST_SPREAD``;
    - e_t over s and the uncertainty of b follows Student's t and is turned into a standard normal
      by z (1 - 1 / (4 nu)) / sqrt(1 + z^2 / (2 nu)), nu = j - 1 less the length of x (Abramowitz
      and Stegun, 26.7.8).

    A later trip with abs(z) above ``CLIP`` never becomes part of the reference, as one outlier
    there would hide changes: its x and y count as zeros, and not in j. A change of that size has
    raised its alarm before.

    Parameters
    ----------
    values : array of shape (n_trips, ...)
    covariates : array of shape (n_trips, ..., n_covariates)
        May have none, n_covariates 0; leading dimensions of `values`.
    n_reference : int
        At least 8, and 4 more than there are covariates.

    Returns
    -------
    Residuals

    Raises
    ------
    ValueError
        If the reference is too short, or has covariates that determine each other.
    """
    n_covariates = covariates.shape[-1]
    check_number("n_reference", n_reference, low=max(8, n_covariates + 4), whole=True)
    centred = values - values[:n_reference].mean(axis=0)
    rows = np.concatenate([np.ones((*values.shape, 1)), covariates, centred[..., None]], axis=-1)
    kept = np.ones(values.shape, dtype=bool)
    # z of a trip needs `kept` of trips DELAY older alone: each turn settles DELAY trips more
    for _ in range(len(values) // DELAY + 2):
        rest = _compare(rows, kept, n_reference)
        if (rest.usual == kept[n_reference:]).all():
            break
        kept[n_reference:] = rest.usual
    return rest


def _compare(rows: FloatArray, kept: BoolArray, n_reference: int) -> Residuals:
    """Return the residuals of rows (x, y) against those `kept`."""
    used = rows * kept[..., None]
    squares = np.cumsum(_outer(used, used), axis=0)
    products = np.cumsum(_outer(used[1:], used[:-1]), axis=0)
    now = np.arange(n_reference, len(rows))
    j = np.maximum(n_reference, now - DELAY)
    ends, where = np.unique(j, return_inverse=True)
    size = np.cumsum(kept, axis=0)[ends - 1].astype(float)
    first, last = _outer(used[:1], used[:1]), _outer(used[ends - 1], used[ends - 1])
    squares, products = squares[ends - 1], products[ends - 2]
    least = size * LEAST_SPREAD**2
    try:
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
    step = rows[now] - phi[..., None] * rows[now - 1]
    leverage = _form(inverse[where], step[..., :-1])
    z = np.einsum("...i,...i", step, contrast[where])
    z = z / np.sqrt(variance[where] * (1 + leverage))
    standard = z * (1 - 0.25 / nu) / np.sqrt(1 + z**2 / (2 * nu))
    deviations = np.einsum("...i,...i", rows[now], contrast[where])
    return Residuals(standard, deviations, leverage, j, phi, np.abs(z) <= CLIP)


def cusum(standard: FloatArray) -> FloatArray:
    """Return the two CUSUMs of residuals, upwards and downwards.

    S_t = max(0, S_(t-1) + s z_t - k) with s = 1 and -1, k = ``ALLOWANCE``, abs(z) at most ``CLIP``,
    and S = 0 before the first trip (E. S. Page, Biometrika 41, 1954).

    Parameters
    ----------
    standard : array of shape (n_trips, ...)

    Returns
    -------
    array of shape (2, n_trips, ...)
    """
    z = np.clip(standard, -CLIP, CLIP)
    walks = np.cumsum(np.stack([z, -z]) - ALLOWANCE, axis=1)
    return walks - np.minimum(0, np.minimum.accumulate(walks, axis=1))


@functools.lru_cache(maxsize=1024)
def threshold(rate: float, n_reference: int, correlation: float = 0.5, seed: int = 0) -> float:
    """Return the threshold of ``cusum`` at which healthy trips raise false alarms at a given rate.

    ``N_SIMULATED`` healthy histories, each with a reference of its own, are made by a normal
    autoregressive process. The rate is that of the first false alarms for each trip monitored, and
    it holds over each of ``HORIZONS``. As the CUSUM of standardised residuals does not depend on
    level and spread of the trips, that is a parametric bootstrap of any suspension's reference,
    with the least favourable correlation instead of its own, which `n_reference` trips do not
    determine well enough. At least ``CLIP``, so that no trip raises an alarm alone. Below the
    smallest rate that the simulation shows, the logarithm of the rate falls with the threshold as
    over the last decade shown, which is slower than the exp(-2 k h) of a known level.

    Parameters
    ----------
    rate : float, [1/trip]
    n_reference : int
        At least 8.
    correlation : float, [-]
        Of successive trips, 0 to ``MAX_CORRELATION``: the largest to be expected.
    seed : int

    Raises
    ------
    ValueError
        If a setting is out of range.
    """
    check_number("rate", rate, above=0, below=1)
    check_number("correlation", correlation, low=0, high=MAX_CORRELATION)
    peaks = _healthy_peaks(n_reference, float(correlation), seed)
    shown = 20 / (N_SIMULATED * HORIZONS[-1])
    if rate >= shown:
        return _least(peaks, rate)
    last, before = _least(peaks, shown), _least(peaks, 10 * shown)
    slope = max((last - before) / math.log(10), 1 / (2 * ALLOWANCE))
    return last + slope * math.log(shown / rate)


def _least(peaks: NDArray[np.float32], rate: float) -> float:
    """Return the least threshold, from ``CLIP`` on, that keeps a rate."""
    low, high = CLIP, float(peaks[-1].max())
    for _ in range(24):  # the rate falls with the threshold: bisection to 1e-7 of the range
        middle = (low + high) / 2
        low, high = (middle, high) if _false_alarms(peaks, middle) > rate else (low, middle)
    return high


def _false_alarms(peaks: NDArray[np.float32], threshold: float) -> float:
    """Return the largest rate of first alarms over the horizons, of the peaks at each trip."""
    quiet = (peaks <= threshold).sum(axis=0)  # trips before the first alarm
    return max(
        float((quiet < trips).mean() / np.minimum(quiet + 1, trips).mean()) for trips in HORIZONS
    )


@functools.lru_cache(maxsize=8)
def _healthy_peaks(n_reference: int, correlation: float, seed: int) -> NDArray[np.float32]:
    """Return the largest CUSUM until each trip; shape (``N_MONITORED``, ``N_SIMULATED``)."""
    random = np.random.default_rng(seed)
    peaks = np.empty((N_MONITORED, N_SIMULATED), np.float32)
    chunk = 500
    for begin in range(0, N_SIMULATED, chunk):
        noise = random.standard_normal((n_reference + N_MONITORED, chunk))
        values = autoregressive(noise, correlation)
        standard = residuals(values, np.empty((*values.shape, 0)), n_reference).standard
        largest = cusum(standard).max(axis=0)
        peaks[:, begin : begin + chunk] = np.maximum.accumulate(largest, axis=0)
    return peaks


def autoregressive(noise: FloatArray, correlation: float | FloatArray) -> FloatArray:
    """Return a stationary series of unit variance made of independent noise of unit variance.

    y_t = phi y_(t-1) + sqrt(1 - phi^2) e_t along the first axis, and y_0 = e_0.
    """
    values = np.array(noise, dtype=float)
    spread = np.sqrt(1 - np.square(correlation))
    for t in range(1, len(values)):
        values[t] = correlation * values[t - 1] + spread * noise[t]
    return values


def _posterior_mean(lagged: FloatArray, size: FloatArray) -> FloatArray:
    """Return the posterior mean of phi, given the autocorrelation of `size` residuals."""
    grid = np.linspace(0, MAX_CORRELATION, 13).reshape(-1, *[1] * lagged.ndim)
    mean, variance = grid - (1 + 3 * grid) / size, (1 - grid**2) / size
    log_weights = -((lagged - mean) ** 2) / (2 * variance) - np.log(variance) / 2
    weights = np.exp(log_weights - log_weights.max(axis=0))
    return np.asarray((grid * weights).sum(axis=0) / weights.sum(axis=0))


def _outer(left: FloatArray, right: FloatArray) -> FloatArray:
    return left[..., :, None] * right[..., None, :]


def _contrast(moments: FloatArray) -> FloatArray:
    """Return (-b, 1), of which the product with a row (x, y) is its least-squares residual."""
    b = np.linalg.solve(moments[..., :-1, :-1], moments[..., :-1, -1:])[..., 0]
    return np.concatenate([-b, np.ones((*b.shape[:-1], 1))], axis=-1)


def _form(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return v' M v."""
    return np.asarray(np.einsum("...i,...ij,...j", vector, matrix, vector))
