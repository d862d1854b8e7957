"""Remaining life: the distribution of the mileage until a parameter passes a limit."""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray, IntArray
from suspnet.trains.maintenance.degradation import (
    DIFFUSIONS,
    MODELS,
    RATE_CHANGES,
    Fit,
    FleetPrior,
    fit_models,
    join,
    shares,
)
from suspnet.trains.maintenance.first_passage import HORIZON_KM, draw_lives_km
from suspnet.trains.maintenance.noise import (
    LEAST_NOISE,
    ROUNDED_QUARTILE,
    UNIT_KM,
    average,
    clip_outliers,
    estimate_noise,
    robust_spread,
)

BEST_TRIP = 0.01
"""Lower bound of a trip's noise, relative to the median of all trips: an interval of width 0 is not
credible."""
MIN_TRIPS = 5
"""Fewest trips with an estimate from which a life is predicted."""
SHOWN_LEVEL = 0.8
"""Probability of the interval in which a limit is passed, as texts, pages and the plan show it."""
NOISE_TRIPS = 4.0
"""Degrees of freedom that the half-widths add to those of the trips when the noise is estimated."""
DEFAULT_PRIOR = FleetPrior(
    models=np.concatenate(
        [
            [0.8, 0.04, 0.04, 0.02],
            0.06 * DIFFUSIONS / DIFFUSIONS.sum(),
            np.full(RATE_CHANGES.size, 0.04 / RATE_CHANGES.size),
        ]
    ),
    weights=np.array([0.5, 0.35, 0.15]),
    means=np.zeros(3),
    spreads=np.array([0.03, 0.1, 0.3]),
)
"""Vague prior: four of five parameters do not wear. The rates of the others have standard
deviations of 3, 10 or 30 % in 100,000 km, with either sign; slow rates are more likely."""


@dataclass(frozen=True)
class Life:
    """Remaining life of one parameter, as samples.

    `model` is "no trend" if its probability is at least 0.5, else the most probable other one of
    ``MODELS``. `samples_km`, (n_samples,), are mileages from the last trip until the nearer limit
    is passed; inf: not within ``HORIZON_KM``, 0: already passed. `probabilities` [-] are those of
    the models; the samples are drawn from all models in these proportions.
    """

    model: str
    samples_km: FloatArray
    probabilities: dict[str, float] = field(default_factory=dict)

    def quantile_km(self, q: float) -> float:
        """Return the mileage within which the limit is passed with probability `q`."""
        check_number("q", q, low=0, high=1)
        return float(np.quantile(self.samples_km, q, method="inverted_cdf"))

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
        low, high = self.interval_km()
        median = self.quantile_km(0.5)
        if np.isinf(low):
            return f"{self.model}: no crossing within {HORIZON_KM:,.0f} km (90 %)"
        if high == 0:
            return f"{self.model}: limit passed"
        if np.isinf(median):
            return f"{self.model}: limit passed within {low:,.0f} km with 10 %, perhaps never"
        latest = f"{high:,.0f}" if np.isfinite(high) else "never"
        return f"{self.model}: {median:,.0f} km to go (80 %: {low:,.0f} to {latest})"


def predict_life(
    mileage_km: ArrayLike,
    values: ArrayLike,
    half_widths: ArrayLike,
    limits_pair: tuple[float, float],
    *,
    fleet: FleetPrior | None = None,
    level: float = INTERVAL_LEVEL,
    seed: int = 0,
    n_samples: int = 500,
) -> Life:
    """Return the remaining life of one parameter of one suspension.

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
    fleet : FleetPrior, optional
        Prior of suspensions of this type, from ``learn_fleet``.
    level : float
        Level of the intervals.
    seed, n_samples : int

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
    check_number("n_samples", n_samples, low=1, most=1e5, whole=True)
    check_number("seed", seed, low=0, whole=True)
    lower, upper = _checked_limits(limits_pair)
    fits, n_trips = fit_trips(mileage_km, values, half_widths, level, fleet or DEFAULT_PRIOR)
    rng = np.random.default_rng(seed)
    # draw nodes of all models by their probability, then each one's state and passage
    weights = shares(fits)
    ends = np.cumsum([0, *(weight.size for weight in weights)])
    drawn = _stratified(np.concatenate(weights), n_samples, rng)
    node, draw = np.unique(drawn, return_inverse=True)
    states = [
        fit.now(node[(node >= begin) & (node < end)] - begin)
        for fit, begin, end in zip(fits, ends[:-1], ends[1:], strict=True)
    ]
    freedom = n_trips + NOISE_TRIPS
    samples = rng.permutation(draw_lives_km(join(states), draw, (lower, upper), freedom, rng))
    # models that were not fitted have no share
    share = np.zeros(len(MODELS))
    share[: len(fits)] = [weight.sum() for weight in weights]
    model = MODELS[0 if share[0] >= 0.5 else 1 + int(share[1:].argmax())]
    return Life(model, samples, dict(zip(MODELS, share.tolist(), strict=True)))


def _stratified(weight: FloatArray, n: int, rng: np.random.Generator) -> IntArray:
    """Return `n` indices drawn with these weights by stratified sampling."""
    places = (np.arange(n) + rng.random(n)) / n
    return np.minimum(np.searchsorted(np.cumsum(weight), places), weight.size - 1)


def fit_trips(
    mileage_km: ArrayLike,
    values: ArrayLike,
    half_widths: ArrayLike,
    level: float,
    prior: FleetPrior,
) -> tuple[list[Fit], int]:
    """Return the fits of the models, in the order of ``MODELS``, and the number of estimates."""
    check_number("level", level, above=0, below=1)
    km, value, half = _checked_series(mileage_km, values, half_widths)
    t = (km - km[0]) / UNIT_KM
    sigma = half / NormalDist().inv_cdf((1 + level) / 2)
    is_known = np.isfinite(sigma)
    steps = np.diff(np.log(value), 2)
    usual = robust_spread(steps, 6, ROUNDED_QUARTILE)
    if is_known.any():
        usual = np.median(sigma[is_known])
    sigma = np.maximum(np.where(is_known, sigma, usual), max(LEAST_NOISE, BEST_TRIP * usual))
    value = clip_outliers(value)
    noise = estimate_noise(t, np.log(value), sigma, np.append(0.0, DIFFUSIONS))
    blocks = average(t, value, sigma)
    return fit_models(blocks, noise, prior), km.size


def _checked_series(
    mileage_km: ArrayLike, values: ArrayLike, half_widths: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    columns = {"mileage_km": mileage_km, "values": values, "half_widths": half_widths}
    km, value, half = (np.asarray(column, dtype=float) for column in columns.values())
    if km.ndim != 1 or value.shape != km.shape or half.shape != km.shape:
        shapes = ", ".join(f"{k} {np.shape(v)}" for k, v in columns.items())
        raise ValueError(f"arrays must have one and the same length, got {shapes}")
    if not np.isfinite(km).all():
        raise ValueError("`mileage_km` must be finite numbers")
    if (np.diff(km) < 0).any():
        raise ValueError("`mileage_km` must be ascending: sort the trips by mileage")
    if np.isinf(value).any() or (value <= 0).any():
        raise ValueError("`values` must be above 0 and finite, or NaN where there is no estimate")
    if np.isinf(half).any() or (half < 0).any():
        raise ValueError("`half_widths` must be at least 0 and finite, or NaN where there is none")
    kept = np.isfinite(value)
    if kept.sum() < MIN_TRIPS or km[kept][-1] == km[kept][0]:
        raise ValueError(
            f"a life needs at least {MIN_TRIPS} trips with an estimate, at different mileages, "
            f"got {kept.sum()}"
        )
    return km[kept], value[kept], half[kept]


def _checked_limits(limits_pair: tuple[float, float]) -> tuple[float, float]:
    pair = tuple(limits_pair)
    if len(pair) != 2:
        raise ValueError(f"`limits_pair` must be two numbers, lower and upper, got {pair}")
    check_number("limits_pair[0]", pair[0], low=0, below=1)
    if pair[1] != np.inf:
        check_number("limits_pair[1]", pair[1], above=1)
    return float(pair[0]), float(pair[1])
