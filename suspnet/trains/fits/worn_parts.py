"""Which of a bogie's twelve parts have worn: a verdict with odds, as wear is sparse.

An estimate gives the logarithms e of the twelve ratios with the covariance C, without what a part
has by its own wear alone. Parts that have not worn scatter by ``USUAL``, those of one kind (the
four k_p) by ``SHARED`` alike, as temperature and load act on all of them; worn ones scatter by
``WEAR`` as well. For a set W of worn parts::

    log P(e | W) = -1/2 (e^T V^-1 e + log det V),
    V = C + USUAL^2 + SHARED^2 within a kind + WEAR^2 on the diagonal of W

A part has worn with the prior probability ``RARE``, springs to either side, dampers upwards in the
fraction ``STIFFER`` of cases: oil and seals are lost, blocked valves are rare. The side is that of
the part's wear as expected given e and W, WEAR^2 V^-1 e. Parts, or all of a kind at once, join W
one after the other, the most probable first, as long as the odds of W with it over W without it
exceed 20 : 1; then those leave again whose odds, given the others, do not. Where another part in
its place is not 20 times less probable, they are named together. The estimates themselves are not
changed by this.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter
from suspnet.ground.findings import WORN, WORN_ONE_OF, Finding, together
from suspnet.ground.parameters import BOGIE_PARTS, kind_of, part_words
from suspnet.ground.tensors import threads
from suspnet.ground.types import FloatArray
from suspnet.trains.fits.bogie_fit import (
    PartsEstimate,
    beyond_noise,
    healthy_misfit,
    wear_errors,
)
from suspnet.trains.fits.bogie_misfit import WEAR
from suspnet.trains.fits.healthy_scatter import expected_noise
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.vehicle import SpatialVehicle

USUAL = {"k": 0.003, "c": 0.006}
"""Standard deviation of the logarithm of a part that has not worn, of springs and of dampers."""
SHARED = {"k": 0.005, "c": 0.02}
"""Standard deviation that all parts of a kind have in common: 5 K more make every damper 2 % weaker
where a manifest gives no temperature."""
RARE = 0.01
"""Prior probability that a part has worn."""
STIFFER = {"k": 0.5, "c": 0.1}
"""Fraction of the worn springs and dampers that have more than healthy; an assumption, chosen when
one of two secondary dampers at 95 % could not be told from the other at 105 % with both weaker."""
ODDS = 20.0
"""Odds from which a part is named."""
MOST_ODDS = 1000.0
"""Odds above which no number is reported: they are those of a model."""
N_HEALTHY = 20_000
"""Healthy trips that are drawn to find how many of them are given a verdict."""
MOST_LOSS, LOSS_STEP = 0.8, 1e-3
"""Largest loss that is tried where the least one that is named is asked for, and its step."""


@dataclass(frozen=True)
class WornPart:
    """A part that has worn, or several of which one has.

    `names` are of ``COMPONENTS``, the most probable first; `odds` are those of wear over none;
    `ratio` is the estimate of the first one, [-].
    """

    names: tuple[str, ...]
    odds: float
    ratio: float

    @property
    def is_named(self) -> bool:
        """Whether one part alone is accused."""
        return len(self.names) == 1

    @property
    def finding(self) -> Finding:
        """The part with its level and the odds."""
        above, unknown = self.odds > MOST_ODDS, not self.is_named
        return Finding(
            WORN_ONE_OF if unknown else WORN,
            names=self.names,
            where=together(map(part_words, self.names), " or "),
            percent=100 * self.ratio,
            odds=Finding("odds-over" if above else "odds", odds=min(self.odds, MOST_ODDS)),
        )


def worn_parts(estimate: PartsEstimate) -> list[WornPart]:
    """Return the parts that have worn, the most certain first; none if none has.

    Differences of the log posteriors of two sets of worn parts are their log odds.
    """
    logs = np.log(estimate.values[: len(BOGIE_PARTS)])
    by_own_wear = np.broadcast_to(estimate.by_own_wear, len(estimate.values))
    unworn = estimate.covariance - np.diag(by_own_wear)
    covariance = unworn[: len(BOGIE_PARTS), : len(BOGIE_PARTS)] + _usual()

    def log_posterior(worn: Sequence[int]) -> float:
        evidence = float(_log_probability(logs, covariance, worn))
        return evidence + len(worn) * math.log(RARE / (1 - RARE))

    worn: list[int] = []
    for _ in BOGIE_PARTS:  # each round adds a part or ends
        events = {event: log_posterior([*worn, *event]) for event in _events(worn)}
        best = max(events, key=events.__getitem__, default=())
        if not best or events[best] - log_posterior(worn) < math.log(ODDS):
            break
        worn += best
    for _ in tuple(worn):  # a part that another one has explained since leaves again
        gains = {j: log_posterior(worn) - log_posterior([i for i in worn if i != j]) for j in worn}
        least = min(gains, key=gains.__getitem__)
        if gains[least] >= math.log(ODDS):
            break
        worn.remove(least)
    found = []
    # each worn part is named with those that would explain the trip nearly as well in its place
    for j in worn:
        rest = [i for i in worn if i != j]
        others = {
            i: log_posterior(worn) - log_posterior([*rest, i])
            for i in range(len(BOGIE_PARTS))
            if i not in worn
        }
        alike = [i for i in sorted(others, key=others.__getitem__) if others[i] < math.log(ODDS)]
        names = tuple(BOGIE_PARTS[i] for i in (j, *alike))
        odds = math.exp(min(log_posterior(worn) - log_posterior(rest), 700.0))  # no overflow
        found.append(WornPart(names, odds, float(estimate.values[j])))
    return sorted(found, key=lambda one: -one.odds)


def least_losses(bogie: CommissionedBogie, level: float = 0.9) -> dict[str, float]:
    """Return the least loss of each part [-] from which it is named by one trip like the healthy.

    That is also where the trip shows the loss too small, by as much as an interval of the level
    allows for wear of this part. 1 if it is not named at ``MOST_LOSS`` either. ValueError if the
    sensors do not show each part.
    """
    scatter = scatter_of_parts(bogie)
    noise = np.pad(np.array(scatter.noise), (0, 1))

    def errors(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
        beyond, by_own_wear = beyond_noise(bogie, logs, level)
        return noise + beyond, by_own_wear

    return _least_losses(errors, level)


@threads(1)  # systems of 30 equations are too small for two
def expected_losses(
    vehicle: SpatialVehicle, trip: BogieTrip, n_healthy: int, level: float = 0.9
) -> dict[str, float]:
    """Return the `least_losses` before commissioning, on `n_healthy` trips like this one.

    `vehicle` has the prior of its numbers. The vehicle is taken to be complete, its trips to differ
    by noise alone: what commissioning finds beyond it adds to these losses. They have what is
    always allowed for few sensors. ValueError if the trip has other sensors than the vehicle.
    """
    fit = healthy_misfit(vehicle, [trip])
    noise = expected_noise(fit, fit.start(), n_healthy)

    def errors(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
        variances, by_own_wear = wear_errors(1.0, logs, len(vehicle.places))
        return noise + np.diag(variances), by_own_wear

    return _least_losses(errors, level)


@threads(1)
def false_verdicts(bogie: CommissionedBogie, level: float = 0.9, seed: int = 0) -> float:
    """Return the fraction of healthy trips like those of the commissioning that accuse a part.

    With N the covariance of noise and V that of the scatter, which n healthy trips have shown,
    the logarithms of the parts of such trips are drawn, ``N_HEALTHY`` of them, from ::

        N(0, N + V (n - 1) / chi^2_(n - 1))

    which is Student's distribution where V is all, and each is judged as by `worn_parts`, with
    N + tau^2 V. ValueError as of `least_losses`.
    """
    scatter = scatter_of_parts(bogie)
    noise, beyond = np.array(scatter.noise), scatter.covariance
    rng, free = np.random.default_rng(seed), scatter.n_trips - 1
    zeros, spread = np.zeros(len(noise)), np.sqrt(free / rng.chisquare(free, N_HEALTHY))
    logs = rng.multivariate_normal(zeros, noise, N_HEALTHY, method="eigh")
    logs += spread[:, None] * rng.multivariate_normal(zeros, beyond, N_HEALTHY, method="eigh")
    covariance = noise + scatter.widened(level) + _usual()
    healthy = _log_probability(logs, covariance, [])
    accused = np.zeros(N_HEALTHY, dtype=bool)
    for event in _events([]):
        prior = len(event) * math.log(RARE / (1 - RARE))
        gains = _log_probability(logs, covariance, event) + prior - healthy
        accused |= gains >= math.log(ODDS)
    return float(accused.mean())


def scatter_of_parts(bogie: CommissionedBogie) -> HealthyScatter:
    """Return the scatter of the healthy trips; ValueError if it is not that of each part."""
    if len(bogie.scatter.noise) != len(BOGIE_PARTS):
        raise ValueError("the sensors do not show each part: none has an estimate")
    return bogie.scatter


def _least_losses(
    errors: Callable[[FloatArray], tuple[FloatArray, FloatArray]], level: float
) -> dict[str, float]:
    """Return the least losses, given covariance and `by_own_wear` of logarithms found (13,)."""
    reach = norm.ppf((1 + level) / 2)

    def is_named(part: int, loss: float) -> bool:
        logs = np.zeros(len(BOGIE_PARTS) + 1)
        logs[part] = math.log(1 - loss)
        # read too small by as much as intervals allow
        logs[part] = min(0.0, logs[part] + reach * np.sqrt(errors(logs)[1][part]))
        covariance, own = errors(logs)
        estimate = PartsEstimate(np.exp(logs), covariance, 1.0, True, level, by_own_wear=own)
        return [one.names for one in worn_parts(estimate)] == [(BOGIE_PARTS[part],)]

    losses = {}
    for part, name in enumerate(BOGIE_PARTS):
        low, high = 0.0, MOST_LOSS
        while high - low > LOSS_STEP:
            middle = (low + high) / 2
            low, high = (low, middle) if is_named(part, middle) else (middle, high)
        losses[name] = high if is_named(part, high) else 1.0
    return losses


def _events(worn: Sequence[int]) -> list[tuple[int, ...]]:
    """Return what may join the worn parts: each other one, or all of a kind at once.

    What parts of a kind share hides that all have worn alike until the last one joins.
    """
    single = [(j,) for j in range(len(BOGIE_PARTS)) if j not in worn]
    kinds = {kind_of(name) for name in BOGIE_PARTS}
    whole = [
        tuple(j for j, n in enumerate(BOGIE_PARTS) if kind_of(n) == kind) for kind in sorted(kinds)
    ]
    return [*single, *(event for event in whole if not set(event) & set(worn))]


def _usual() -> FloatArray:
    """Return the covariance of the logarithms of parts that have not worn, (12, 12)."""
    kinds = np.array([kind_of(name) for name in BOGIE_PARTS])
    shared = np.array([SHARED[kind[0]] for kind in kinds])
    own = np.array([USUAL[kind[0]] for kind in kinds])
    return np.diag(own**2) + np.where(kinds[:, None] == kinds, shared**2, 0.0)


def _log_probability(logs: FloatArray, covariance: FloatArray, worn: Sequence[int]) -> FloatArray:
    """Return log P(e | W) up to a constant, with the prior of the side to which each part wears.

    `logs` (..., 12), the result (...).
    """
    whole = covariance.copy()
    chosen = list(worn)
    whole[chosen, chosen] += WEAR**2
    sign, size = np.linalg.slogdet(whole)
    assert sign > 0
    weighted = logs @ np.linalg.inv(whole)
    stiffer = np.array([STIFFER[BOGIE_PARTS[j][0]] for j in chosen])
    sides = np.where(weighted[..., chosen] > 0, stiffer, 1 - stiffer)
    squares = np.sum(logs * weighted, axis=-1)
    return np.asarray(-0.5 * (squares + size) + np.log(2 * sides).sum(axis=-1))
