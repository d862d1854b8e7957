"""Measurement noise of a history, and blocks of trips for the degradation models."""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from scipy.ndimage import median_filter

from suspnet.ground.types import FloatArray, IntArray

UNIT_KM = 100_000.0  # internal unit of mileage, [km], which keeps numbers near 1
MAX_BLOCKS = 32  # largest number of blocks into which the trips of a history are averaged
LEAST_NOISE = 1e-5  # smallest standard deviation of the noise of a trip, relative to the value
NOISE_SCALES = np.geomspace(0.05, 20.0, 24)
"""Grid of the factor from the noise that half-widths state to the noise from trip to trip."""
NOISE_SPREAD = 0.5  # prior standard deviation of the logarithm of the factor on ``NOISE_SCALES``
CORRELATIONS = np.linspace(0.0, 0.75, 6)  # grid of the correlation of the noise of successive trips
N_HINGES = 12
"""Number of hinge onsets that are tried to remove the trend before the noise is estimated."""
N_SLOWEST = 2
"""Number of lowest frequencies that drifts disturb, so that the noise is not estimated there."""
MAX_BINS = 32  # largest number of frequencies of the Whittle likelihood
QUARTILE = NormalDist().inv_cdf(0.75)  # median magnitude of a standard normal number
OUTLYING = 6.0  # largest deviation of a trip from the median of five, in robust standard deviations


@dataclass(frozen=True)
class Blocks:
    """Averages of neighbouring trips; arrays of shape (n_blocks,).

    `t` is the mean mileage after the first trip, `length` the mileage from first to last trip of a
    block, `last` the mileage of the last trip after the first, all [UNIT_KM]. `value` and
    `log_value` are the means of value - 1 and of the logarithm of the value. `sigma` is the
    standard deviation of one trip from its half-width, `size` the number of trips and `first` the
    index of the first one.
    """

    t: FloatArray
    length: FloatArray
    last: float
    value: FloatArray
    log_value: FloatArray
    sigma: FloatArray
    size: IntArray
    first: IntArray


@dataclass(frozen=True)
class Noise:
    """Noise of a trip for each diffusion of Brownian motion; (n_diffusions,).

    `variance` is relative to that of the half-widths, `correlation` that of successive trips.
    """

    variance: FloatArray
    correlation: FloatArray


def average(t: FloatArray, values: FloatArray, sigma: FloatArray) -> Blocks:
    """Return the blocks of a history; `t` [UNIT_KM], `values`, weighted by `sigma`: (n_trips,)."""
    n_trips = t.size
    first = np.linspace(0, n_trips, min(n_trips, MAX_BLOCKS) + 1)[:-1].astype(np.int64)
    size = np.diff(first, append=n_trips)
    weight = 1 / sigma**2
    total = np.add.reduceat(weight, first)

    def mean(x: FloatArray) -> FloatArray:
        return np.add.reduceat(weight * x, first) / total

    return Blocks(
        t=mean(t),
        length=t[first + size - 1] - t[first],
        last=float(t[-1]),
        value=mean(values - 1),
        log_value=mean(np.log(values)),
        sigma=np.sqrt(size / total),
        size=size,
        first=first,
    )


def estimate_noise(
    t: FloatArray, log_values: FloatArray, sigma: FloatArray, diffusions: FloatArray
) -> Noise:
    """Return the noise from differences of neighbouring trips, by the Whittle likelihood.

    The differences of the residuals of the best hinge or step have the spectrum, at omega per trip,

        variance * (2 - 2 cos omega) * (1 - rho^2) / |1 - rho e^(-i omega)|^2 + q dt / sigma^2,

    where q is the square of a diffusion. Log variance and rho are posterior means. `t` [UNIT_KM],
    `log_values` and `sigma`, their standard deviations from the half-widths: (n_trips,).
    `diffusions`, (n_diffusions,): standard deviations of Brownian motion after ``UNIT_KM``.
    """
    scale = float(np.sqrt(np.mean(sigma**2)))
    omega, power, count = _periodogram(np.diff(_residuals(t, log_values) / scale))
    rho = CORRELATIONS[:, None]
    shape = (2 - 2 * np.cos(omega)) * (1 - rho**2) / (1 - 2 * rho * np.cos(omega) + rho**2)
    spectrum = (NOISE_SCALES[:, None, None] ** 2 * shape).reshape(-1, omega.size)
    brownian = diffusions**2 * (t[-1] / (t.size - 1)) / scale**2
    spectrum = spectrum + brownian[:, None, None]  # (n_diffusions, scales x correlations, n_freq)
    log_likelihood = -(count * (np.log(spectrum) + power / spectrum)).sum(axis=-1)
    log_prior = np.repeat(-0.5 * (np.log(NOISE_SCALES) / NOISE_SPREAD) ** 2, rho.size)
    joint = log_likelihood + log_prior
    weight = np.exp(joint - joint.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    return Noise(
        variance=np.exp(weight @ np.repeat(2 * np.log(NOISE_SCALES), rho.size)),
        correlation=weight @ np.tile(CORRELATIONS, NOISE_SCALES.size),
    )


def _residuals(t: FloatArray, values: FloatArray) -> FloatArray:
    """Return the residuals of the hinge, of ``N_HINGES``, or the step of least sum of squares."""
    hinges = np.maximum(t - t[-1] * np.linspace(0, 0.95, N_HINGES)[:, None], 0)
    fits = np.stack([np.ones(hinges.shape), hinges], axis=-1)
    gram = np.swapaxes(fits, 1, 2) @ fits + 1e-9 * np.eye(2)
    coefficients = np.linalg.solve(gram, np.swapaxes(fits, 1, 2) @ values[:, None])
    residuals = values - (fits @ coefficients)[..., 0]
    # a step: the means of the n first trips and of the others
    n = np.arange(1, t.size)
    sums = np.cumsum(values - values.mean())
    first = n[np.argmax(sums[:-1] ** 2 * (1 / n + 1 / (t.size - n)))]
    stepped = [side - side.mean() for side in np.split(values, [first])]
    residuals = np.vstack([residuals, np.concatenate(stepped)])
    return np.asarray(residuals[np.argmin((residuals**2).sum(axis=1))])


def _periodogram(steps: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return frequencies [rad/trip], power and number of ordinates of at most ``MAX_BINS`` bins."""
    n = steps.size
    power = np.abs(np.fft.rfft(steps))[1:] ** 2 / n
    omega = 2 * np.pi * np.arange(1, power.size + 1) / n
    ordinates = np.where(omega > np.pi - 1e-9, 0.5, 1.0)
    skip = min(N_SLOWEST, power.size - 1)
    n_bins = min(power.size - skip, MAX_BINS)
    start = (skip + np.linspace(0, power.size - skip, n_bins + 1)[:-1]).astype(np.int64)
    count = np.add.reduceat(ordinates, start)
    omega, power = (np.add.reduceat(ordinates * x, start) / count for x in (omega, power))
    return omega, power, count


def noise_covariance(blocks: Blocks, variance: FloatArray, rho: FloatArray) -> FloatArray:
    """Return the covariance of block means of autoregressive noise, (..., n_blocks, n_blocks)."""
    m = blocks.size.astype(float)
    r = np.maximum(rho[..., None], 1e-9)
    g = (1 - r**m) / (m * (1 - r))
    end = blocks.first + blocks.size - 1
    between = np.abs(blocks.first[None, :] - end[:, None])
    between = np.where(np.arange(m.size)[:, None] < np.arange(m.size), between, between.T)
    covariance = g[..., :, None] * g[..., None, :] * r[..., None] ** between
    index = np.arange(m.size)
    covariance[..., index, index] = (1 + r) / (1 - r) / m - 2 * r * (1 - r**m) / (m * (1 - r)) ** 2
    scaled = variance[..., None, None] * covariance * np.outer(blocks.sigma, blocks.sigma)
    return np.asarray(scaled)


def robust_spread(differences: FloatArray, variance: float) -> float:
    """Return a robust standard deviation of trips from differences between them; NaN if none.

    The variance of a difference is `variance` times that of a trip.
    """
    if not len(differences):
        return math.nan
    return float(np.median(np.abs(differences)) / QUARTILE / math.sqrt(variance))


def clip_outliers(values: FloatArray) -> FloatArray:
    """Return values with outliers clipped to ``OUTLYING`` deviations from the median of five."""
    logs = np.log(values)
    middle = median_filter(logs, 5, mode="mirror")
    off = logs - middle
    scale = max(np.median(np.abs(off)), np.median(np.abs(np.diff(logs))), LEAST_NOISE)
    most = OUTLYING * scale / QUARTILE
    return np.where(np.abs(off) > most, np.exp(middle + np.clip(off, -most, most)), values)
