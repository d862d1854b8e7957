"""Remaining life: the distribution of the mileage until a parameter passes a limit."""

import math
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike

from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray, IntArray
from suspnet.trains.maintenance import noise
from suspnet.trains.maintenance.degradation import (
    DIFFUSIONS,
    EXPONENTIAL,
    FIRST_CHANGING,
    FIRST_WIENER,
    MODELS,
    RATE_CHANGES,
    STEP,
    NodeStates,
    fit_models,
    join,
    powered,
    shares,
)
from suspnet.trains.maintenance.directions import Z

HORIZON_KM = 5e6
"""Mileage after which a crossing counts as never, as no prediction reaches so far, [km]."""
FUTURE = np.concatenate([[0.0], np.geomspace(1e-3, HORIZON_KM / noise.UNIT_KM, 150)])
"""Mileages [UNIT_KM] after the last trip at which paths of a changing rate are sampled."""
BEST_TRIP = 0.01
"""Lower bound of a trip's noise, relative to the median of all trips: an interval of width 0 is not
credible."""
MIN_TRIPS = 5  # fewest trips with an estimate from which a life is predicted
N_SAMPLES = 500
SHOWN_LEVEL = 0.8
"""Probability of the interval in which a limit is passed, as texts, pages and the plan show it."""
NOISE_TRIPS = 4.0
"""Degrees of freedom that the half-widths add to those of the trips when the noise is estimated."""


@dataclass(frozen=True)
class Life:
    """Remaining life of one parameter, as samples.

    `model` is "no trend" if its probability is at least 0.5, else the most probable other one of
    ``MODELS``. `samples_km`, (n_samples,), are mileages from the last trip until the nearer limit
    is passed, of all models by their probabilities; inf: not within ``HORIZON_KM``, 0: already
    passed.
    """

    model: str
    samples_km: FloatArray

    def quantile_km(self, q: float) -> float:
        """Return the mileage within which the limit is passed with probability `q`."""
        check_number("q", q, low=0, high=1)
        # the method "inverted_cdf" of np.quantile, without sorting each time
        return float(self._ascending_km[max(math.ceil(self.samples_km.size * q - 1), 0)])

    @cached_property
    def _ascending_km(self) -> FloatArray:
        return np.sort(self.samples_km)

    def interval_km(self, level: float = SHOWN_LEVEL) -> tuple[float, float]:
        """Return the central interval in which the limit is passed with probability `level`."""
        check_number("level", level, above=0, below=1)
        return self.quantile_km((1 - level) / 2), self.quantile_km((1 + level) / 2)

    def probability(self, km: float) -> float:
        """Return the probability that the limit is passed within `km`, at least 0."""
        check_number("km", km, low=0)
        return float(np.mean(self.samples_km <= km))

    def __str__(self) -> str:
        """Return model, median and the interval of 80 % as text."""
        low, median, high = (f"{self.quantile_km(q):,.0f}" for q in (0.1, 0.5, 0.9))
        return f"{self.model}: {median} km to go (80 %: {low} to {high})"


def predict_life(
    mileage_km: ArrayLike,
    values: ArrayLike,
    half_widths: ArrayLike,
    limits_pair: tuple[float, float],
    *,
    seed: int = 0,
) -> Life:
    """Return the remaining life of one parameter of one suspension, as ``N_SAMPLES`` samples.

    Parameters
    ----------
    mileage_km : array of shape (n_trips,), [km]
        Since the last maintenance, ascending.
    values : array of shape (n_trips,), [-]
        Estimates relative to healthy; NaN: none.
    half_widths : array of shape (n_trips,), [-]
        Half-widths of their intervals, in logarithms; NaN: none.
    limits_pair : (lower, upper), [-]
        Lower 0 or upper infinity means no limit on that side.
    seed : int

    Raises
    ------
    TypeError, ValueError
        If arrays or settings are out of range, or there are fewer than ``MIN_TRIPS`` estimates.

    Examples
    --------
    A damper that has lost 20 % after 300,000 km in a straight line has 150,000 km to go to 70 %:

    >>> import numpy as np
    >>> mileage = np.arange(0, 300_001, 2_000)
    >>> noise = 0.003 * np.random.default_rng(0).normal(size=mileage.size)
    >>> values = (1 - 0.2 * mileage / 300_000) * np.exp(noise)
    >>> life = predict_life(mileage, values, np.full(mileage.size, 0.005), (0.7, 1.4))
    >>> life.model
    'linear'
    >>> 145_000 < life.quantile_km(0.5) < 155_000
    True
    >>> life.probability(50_000)
    0.0
    """
    check_number("seed", seed, low=0, whole=True)
    lower, upper = limits_pair
    check_number("limits_pair[0]", lower, low=0, below=1)
    if upper != np.inf:
        check_number("limits_pair[1]", upper, above=1)
    km, value, half = _checked_series(mileage_km, values, half_widths)
    # the noise of each trip, from its interval or, without one, from the scatter of all
    t, sigma = (km - km[0]) / noise.UNIT_KM, half / Z
    is_known = np.isfinite(sigma)
    usual = noise.robust_spread(np.diff(np.log(value), 2), 6)
    if is_known.any():
        usual = np.median(sigma[is_known])
    sigma = np.maximum(np.where(is_known, sigma, usual), max(noise.LEAST_NOISE, BEST_TRIP * usual))
    value = noise.clip_outliers(value)
    fits = fit_models(
        noise.average(t, value, sigma), partial(noise.estimate_noise, t, np.log(value), sigma)
    )
    # draw nodes of all models by their probability, then each one's state and passage
    rng = np.random.default_rng(seed)
    weights = shares(fits)
    ends = np.cumsum([0, *(weight.size for weight in weights)])
    places = (np.arange(N_SAMPLES) + rng.random(N_SAMPLES)) / N_SAMPLES  # stratified
    indices = np.searchsorted(np.cumsum(np.concatenate(weights)), places)
    node, draw = np.unique(np.minimum(indices, ends[-1] - 1), return_inverse=True)
    states = [
        fit.now(node[(node >= begin) & (node < end)] - begin)
        for fit, begin, end in zip(fits, ends[:-1], ends[1:], strict=True)
    ]
    samples = draw_lives_km(join(states), draw, (lower, upper), km.size + NOISE_TRIPS, rng)
    share = np.array([weight.sum() for weight in weights])
    model = MODELS[0 if share[0] >= 0.5 else 1 + int(share[1:].argmax())]
    return Life(model, rng.permutation(samples))


def _checked_series(
    mileage_km: ArrayLike, values: ArrayLike, half_widths: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    columns = {"mileage_km": mileage_km, "values": values, "half_widths": half_widths}
    km, value, half = (np.asarray(column, dtype=float) for column in columns.values())
    if km.ndim != 1 or value.shape != km.shape or half.shape != km.shape:
        shapes = ", ".join(f"{k} {np.shape(v)}" for k, v in columns.items())
        raise ValueError(f"arrays must have one and the same length, got {shapes}")
    if not np.isfinite(km).all() or (np.diff(km) < 0).any():
        raise ValueError("`mileage_km` must be finite and ascending: sort the trips by mileage")
    if np.isinf(value).any() or (value <= 0).any():
        raise ValueError("`values` must be above 0 and finite, or NaN where there is no estimate")
    if np.isinf(half).any() or (half < 0).any():
        raise ValueError("`half_widths` must be at least 0 and finite, or NaN where there is none")
    has_estimate = np.isfinite(value)
    if has_estimate.sum() < MIN_TRIPS or km[has_estimate][-1] == km[has_estimate][0]:
        raise ValueError(
            f"a life needs at least {MIN_TRIPS} trips with an estimate, at different mileages, "
            f"got {has_estimate.sum()}"
        )
    return km[has_estimate], value[has_estimate], half[has_estimate]


def draw_lives_km(
    state: NodeStates,
    draw: IntArray,
    limits: tuple[float, float],
    freedom: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return samples [km] of the remaining life, inf beyond ``HORIZON_KM``.

    `draw`, (n_samples,), are nodes of the state; `limits` are relative to healthy, with lower 0 or
    upper infinity for no limit; `freedom` is the number of degrees of freedom of the noise. The
    passages of the two limits are sampled independently given rate and present value, which is
    exact except for paths that would pass both.
    """
    row = state.row[draw]
    values, vectors = np.linalg.eigh(state.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))[:, None, :]
    wide = np.sqrt(freedom / rng.chisquare(freedom, (row.size, 1)))
    off = wide * (root[draw] @ rng.normal(size=(row.size, 3, 1)))[..., 0]
    now, rate, change = (state.mean[draw] + off).T
    rate = np.where(row == STEP, 0.0, rate)  # after a step nothing goes on
    low, high = limits[0] - 1 if limits[0] else -np.inf, limits[1] - 1
    is_log = (row == EXPONENTIAL) & (limits[0] > 0)
    lower = np.where(is_log, np.log(limits[0] or 1.0), low)
    upper = np.where(row == EXPONENTIAL, np.log(limits[1]), high)
    wiener = (row >= FIRST_WIENER) & (row < FIRST_CHANGING)
    diffusion = np.where(wiener, DIFFUSIONS[np.where(wiener, row - FIRST_WIENER, 0)] ** 2, 0.0)
    samples = np.minimum(
        first_passage_km(now - lower, -rate, diffusion, rng),
        first_passage_km(upper - now, rate, diffusion, rng),
    )
    changing = np.flatnonzero(row >= FIRST_CHANGING)
    if changing.size:
        spread = RATE_CHANGES[row[changing] - FIRST_CHANGING]
        since, power = (x[draw[changing], None] for x in (state.since, state.power))
        ahead = powered(since + FUTURE, power) - powered(since, power)
        mean = now[changing, None] + rate[changing, None] * ahead + change[changing, None] * FUTURE
        samples[changing] = changing_passage_km(mean, low, high, spread, rng)
    return np.where(samples > HORIZON_KM, np.inf, samples)


def first_passage_km(
    distance: FloatArray, rate: FloatArray, diffusion: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return samples [km] of the mileage until a Wiener process with drift first passes a limit.

    With `distance` d, `rate` v and variance q = `diffusion` per mileage, the distribution for a
    drift towards the limit is inverse Gaussian with mean d / v and shape d^2 / q [1]_; for a drift
    away from it, it is that of |v| with probability exp(-2 |v| d / q) and infinite otherwise.
    Without diffusion the mileage is d / v.

    `distance` [-], `rate` and `diffusion` [1 / UNIT_KM]: (n_samples,). A distance <= 0 gives 0; it
    may be infinite.

    References
    ----------
    .. [1] Chhikara, Folks, The Inverse Gaussian Distribution, Marcel Dekker, 1989; drawn as by
       Michael, Schucany, Haas, The American Statistician 30 (1976) 88-90.
    """
    y, u, away = rng.normal(size=rate.size) ** 2, rng.random(rate.size), rng.random(rate.size)
    reachable = (distance > 0) & (distance < np.inf)
    d, v = np.where(reachable, distance, 1.0), np.maximum(np.abs(rate), 1e-12)
    q = np.where(diffusion > 0, diffusion, 1.0)
    mean = d / v
    half = 0.5 * y * q / (v * d)
    # the smaller root, without the cancellation that gives negative samples of numpy's `wald` < 2.4
    smaller = mean / (1 + half + np.sqrt(half * (half + 2)))
    random = np.where(u <= mean / (mean + smaller), smaller, mean * (mean / smaller))
    reached = np.where(rate > 0, 1.0, np.where(diffusion > 0, np.exp(-2 * v * d / q), 0.0)) > away
    passage = np.where(reached, np.where(diffusion > 0, random, mean), np.inf)
    return noise.UNIT_KM * np.where(distance <= 0, 0.0, np.where(reachable, passage, np.inf))


def changing_passage_km(
    mean: FloatArray, lower: float, upper: float, spread: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return samples [km] of the mileage until a value with a Brownian rate passes a limit.

    Paths are exact at ``FUTURE``; the crossing is interpolated linearly. `mean`,
    (n_samples, n_future), is the mean value at ``FUTURE``, `spread`, (n_samples,), the standard
    deviation of the change of the rate after ``UNIT_KM``.
    """
    dt = np.diff(FUTURE)
    a, b = rng.normal(size=(2, spread.size, dt.size))
    rates = np.cumsum(np.sqrt(dt) * a, axis=1)
    before = rates - np.sqrt(dt) * a
    # given its ends, the integral of Brownian motion over dt has variance dt^3 / 12
    motion = np.cumsum((before + rates) / 2 * dt + np.sqrt(dt**3 / 12) * b, axis=1)
    values = mean + spread[:, None] * np.pad(motion, ((0, 0), (1, 0)))
    out = (values <= lower) | (values >= upper)
    index, each = out.argmax(axis=1), np.arange(spread.size)
    last = np.maximum(index - 1, 0)
    start, end = values[each, last], values[each, index]
    limit = np.where(end >= upper, upper, lower)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(out.any(axis=1) & (index > 0), (limit - start) / (end - start), 0.0)
    passage = FUTURE[last] + share * (FUTURE[index] - FUTURE[last])
    return noise.UNIT_KM * np.where(out.any(axis=1), passage, np.inf)
