"""Samples of the mileage until a degradation process first passes a limit."""

from __future__ import annotations

import numpy as np

from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.trains.maintenance.degradation import (
    DIFFUSIONS,
    EXPONENTIAL,
    FIRST_CHANGING,
    FIRST_WIENER,
    RATE_CHANGES,
    STEP,
    NodeStates,
    powered,
)
from suspnet.trains.maintenance.noise import UNIT_KM

HORIZON_KM = 5e6
"""Mileage after which a crossing counts as never, as no prediction reaches so far, [km]."""
FUTURE = np.concatenate([[0.0], np.geomspace(1e-3, HORIZON_KM / UNIT_KM, 150)])
"""Mileages [UNIT_KM] after the last trip at which paths of a changing rate are sampled."""


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
    return UNIT_KM * np.where(distance <= 0, 0.0, np.where(reachable, passage, np.inf))


def changing_passage_km(
    mean: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    spread: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Return samples [km] of the mileage until a value with a Brownian rate passes a limit.

    Paths are exact at ``FUTURE``; the crossing is interpolated linearly. `mean`,
    (n_samples, n_future), is the mean value at ``FUTURE``. The limits `lower` and `upper`, and
    `spread`, the standard deviation of the change of the rate after ``UNIT_KM``: (n_samples,).
    """
    dt = np.diff(FUTURE)
    a, b = rng.normal(size=(2, lower.size, dt.size))
    rates = np.cumsum(np.sqrt(dt) * a, axis=1)
    before = rates - np.sqrt(dt) * a
    # given its ends, the integral of Brownian motion over dt has variance dt^3 / 12
    motion = np.cumsum((before + rates) / 2 * dt + np.sqrt(dt**3 / 12) * b, axis=1)
    values = mean + spread[:, None] * np.pad(motion, ((0, 0), (1, 0)))
    out = (values <= lower[:, None]) | (values >= upper[:, None])
    index, each = out.argmax(axis=1), np.arange(lower.size)
    last = np.maximum(index - 1, 0)
    start, end = values[each, last], values[each, index]
    limit = np.where(end >= upper, upper, lower)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(out.any(axis=1) & (index > 0), (limit - start) / (end - start), 0.0)
    passage = FUTURE[last] + share * (FUTURE[index] - FUTURE[last])
    return UNIT_KM * np.where(out.any(axis=1), passage, np.inf)


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
    lower, upper = (_on_scale(limit, row == EXPONENTIAL) for limit in limits)
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
        samples[changing] = changing_passage_km(mean, lower[changing], upper[changing], spread, rng)
    return np.where(samples > HORIZON_KM, np.inf, samples)


def _on_scale(limit: float, logarithmic: BoolArray) -> FloatArray:
    if limit == 0:
        return np.full(logarithmic.size, -np.inf)
    return np.where(logarithmic, np.log(limit), limit - 1)
