"""Degradation models of one parameter: posterior of its level, its rate and its onset.

Mileages are in ``UNIT_KM``. Neighbouring trips are averaged into blocks, so the cost does not grow
with the history. A model is a drift that starts at the onset h,

    level + rate * f(t - h) + B(t - h),

in the value or, for "exponential", in its logarithm. f(x) = x; "changing rate" uses powers of x,
and "step" the power 0, as where one of two nested springs breaks: nothing goes on after it. B is
Brownian motion of variance q x for "wiener", its integral for "changing rate", and 0 otherwise.
Measurement noise is autoregressive of order one. Given a node (onset, power, q and component of the
prior), level and rate are Gaussian with closed-form posterior and evidence; the nodes form a grid
over which everything else is summed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from suspnet.ground.types import FloatArray, IntArray
from suspnet.trains.maintenance.noise import Blocks, Noise, noise_covariance

MODELS = ("no trend", "linear", "exponential", "step", "wiener", "changing rate")
LEAST_EIGENVALUE = 1e-9
"""Lower bound of the eigenvalues, relative to the largest, of a covariance without a Cholesky
factor."""
N_ONSETS = 40  # number of onsets on the grid of each model
ONSET_PASSES = 3
"""Number of times that models without B refine the grid of onsets around the best one."""
AT_ONCE = 0.5  # prior probability that wear starts before the first trip; a step is after it
LEVEL_SPREAD = 0.1  # prior standard deviation of the value at the first trip, whose prior mean is 1
DIFFUSIONS = np.geomspace(0.0015, 0.1, 13)
"""Standard deviations of Brownian motion after ``UNIT_KM``."""
RATE_CHANGES = np.geomspace(0.0002, 0.02, 7)
"""Standard deviations of the change of the rate after ``UNIT_KM``, per ``UNIT_KM``."""
POWERS = np.array([0.5, 0.7, 1.0, 1.4, 2.0])
"""Powers of the mileage since the onset in "changing rate"."""
POWER_UNITS = 3.0
"""Mileage [UNIT_KM] after the onset over which the rate of a power law is the mean rate."""
LINEAR, EXPONENTIAL, STEP, FIRST_WIENER = 1, 2, 3, 4
FIRST_CHANGING = FIRST_WIENER + DIFFUSIONS.size
"""Rows of ``WearPrior.models``, those of "wiener" and "changing rate" the first ones."""
N_STARTS = 8
"""Number of onsets of Brownian motion; an onset of the drift uses the last one before it."""
SHORTEST = 1e-9  # least length of a block [UNIT_KM], that of one of a single trip being 0
TINY = 1e-300  # replaces a probability of 0 in logarithms
DETAILED = 0.3
"""Models with Brownian motion are fitted only if a trend has at least this probability without."""


@dataclass(frozen=True)
class WearPrior:
    """Prior over models and rates.

    `models`, (n_rows,): probability of "no trend", "linear", "exponential", "step", "wiener" with
    each of ``DIFFUSIONS`` and "changing rate" with each of ``RATE_CHANGES``. `weights` [-] and
    `spreads` [1 / UNIT_KM], (n_components,): the mixture of normal distributions of mean 0 of the
    rate.
    """

    models: FloatArray
    weights: FloatArray
    spreads: FloatArray


DEFAULT_PRIOR = WearPrior(
    models=np.concatenate(
        [
            [0.8, 0.04, 0.04, 0.02],
            0.06 * DIFFUSIONS / DIFFUSIONS.sum(),
            np.full(RATE_CHANGES.size, 0.04 / RATE_CHANGES.size),
        ]
    ),
    weights=np.array([0.5, 0.35, 0.15]),
    spreads=np.array([0.03, 0.1, 0.3]),
)
"""Vague prior: four of five parameters do not wear. The rates of the others have standard
deviations of 3, 10 or 30 % in 100,000 km, with either sign; slow rates are more likely."""


def fit_models(
    blocks: Blocks, noise_of: Callable[[FloatArray], Noise], prior: WearPrior = DEFAULT_PRIOR
) -> list[Fit]:
    """Return the fit of each of ``MODELS``, or of the first four if a change is unlikely.

    `noise_of` returns the noise for diffusions like ``DIFFUSIONS``.
    """

    def covariance_for(diffusions: FloatArray) -> Covariance:
        noise = noise_of(diffusions)
        return Covariance(noise_covariance(blocks, noise.variance, noise.correlation)[:, None])

    covariance = covariance_for(np.zeros(1))  # factored once for all models without motion
    # a constant value is a rate whose prior is 0
    constant = WearPrior(prior.models, np.ones(1), np.full(1, 1e-9))
    hinges = Hinges(np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))
    fits = [Fit(blocks, covariance, hinges, constant, np.zeros(1, dtype=np.int64))]
    for row in (LINEAR, EXPONENTIAL, STEP):
        onsets = _onsets(blocks.last)
        fit = _straight(blocks, covariance, prior, row, onsets)
        for _ in range(ONSET_PASSES):
            best = int(fit.log_weight.max(axis=(0, 1, 3)).argmax())
            low, high = onsets[max(best - 1, 0)], onsets[min(best + 1, onsets.size - 1)]
            onsets = np.unique(np.concatenate([onsets, np.linspace(low, high, 17)]))
            fit = _straight(blocks, covariance, prior, row, onsets)
        fits.append(fit)
    # Brownian motion costs most of the time and only matters where there is a trend
    if shares(fits)[0][0] <= 1 - DETAILED:
        of_diffusions = covariance_for(DIFFUSIONS)
        fits.append(_wandering(blocks, of_diffusions, prior, Motion(DIFFUSIONS**2, False)))
        fits.append(_wandering(blocks, covariance, prior, Motion(RATE_CHANGES**2, True)))
    return fits


def _onsets(last: float) -> FloatArray:
    return last * np.linspace(0, 0.95, N_ONSETS)


def _straight(
    blocks: Blocks, covariance: Covariance, prior: WearPrior, row: int, onsets: FloatArray
) -> Fit:
    log_measure = _log_measure(onsets, 0.0 if row == STEP else AT_ONCE)[None]
    hinges = Hinges(onsets[None], np.full((1, onsets.size), float(row != STEP)), log_measure)
    linear = row != EXPONENTIAL
    return Fit(blocks, covariance, hinges, prior, np.array([row]), linear=linear)


def _wandering(blocks: Blocks, covariance: Covariance, prior: WearPrior, motion: Motion) -> Fit:
    powers = POWERS if motion.integrated else np.ones(1)
    onsets = _onsets(blocks.last)
    log_measure = np.repeat(_log_measure(onsets), powers.size) - np.log(powers.size)
    hinges = Hinges(
        np.repeat(onsets, powers.size).reshape(N_STARTS, -1),
        np.tile(powers, N_ONSETS).reshape(N_STARTS, -1),
        log_measure.reshape(N_STARTS, -1),
    )
    first = FIRST_CHANGING if motion.integrated else FIRST_WIENER
    return Fit(blocks, covariance, hinges, prior, first + np.arange(motion.variances.size), motion)


def _log_measure(onsets: FloatArray, at_once: float = AT_ONCE) -> FloatArray:
    """Return the log prior of each onset; the first one includes all earlier ones, `at_once`."""
    widths = np.gradient(onsets)
    widths[0] = 0.0
    share = (1 - at_once) * widths / widths.sum()
    share[0] = at_once
    return np.asarray(np.log(np.maximum(share, TINY)))


@dataclass(frozen=True)
class Motion:
    """Brownian motion of the value, or of the rate if `integrated`.

    `variances`, (n_motions,), are per ``UNIT_KM``.
    """

    variances: FloatArray
    integrated: bool

    def covariance(self, since: FloatArray, length: FloatArray) -> FloatArray:
        """Return the covariance between blocks for unit variance, (n_starts, n_blocks, n_blocks).

        `since`, (n_starts, n_blocks), is the mileage since the start, `length` that of each block.
        """
        least = np.minimum(since[:, :, None], since[:, None, :])
        if self.integrated:
            most = np.maximum(since[:, :, None], since[:, None, :])
            return np.asarray(least**2 * (3 * most - least) / 6)
        index = np.arange(since.shape[1])
        least[:, index, index] = np.maximum(since - length / 6, since / 2)
        return least

    def with_last(self, since: FloatArray, last: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return covariances with the state (value, 0, rate) at the last trip, for unit variance.

        Those of the blocks with the state, (n_starts, n_blocks, 3), and those of the state itself,
        (n_starts, 3, 3).
        """
        of_last, of_blocks = np.zeros((last.size, 3, 3)), np.zeros((*since.shape, 3))
        if not self.integrated:
            of_last[:, 0, 0], of_blocks[..., 0] = last, since
            return of_blocks, of_last
        of_last[:, 0, 0], of_last[:, 2, 2] = last**3 / 3, last
        of_last[:, 0, 2] = of_last[:, 2, 0] = last**2 / 2
        of_blocks[..., 0] = since**2 * (3 * last[:, None] - since) / 6
        of_blocks[..., 2] = since**2 / 2
        return of_blocks, of_last


@dataclass(frozen=True)
class Hinges:
    """Drifts on the grid: onsets [UNIT_KM], powers of the mileage since them, and log prior.

    All are of shape (n_starts, n_onsets): the drifts that share each start of Brownian motion.
    """

    onsets: FloatArray
    powers: FloatArray
    log_prior: FloatArray

    def course(self, blocks: Blocks) -> FloatArray:
        """Return the drift of blocks for a rate of 1, (n_starts, n_onsets, n_blocks).

        A block counts as its mean mileage, but a step by the share of the block that is after it.
        """
        since, power = blocks.t - self.onsets[..., None], self.powers[..., None]
        if self.powers.any():
            return powered(np.maximum(since, 0), power)
        share = np.clip(0.5 + since / np.maximum(blocks.length, SHORTEST), 0, 1)
        return np.asarray(share * powered(np.ones_like(since), power))


def powered(since: FloatArray, power: FloatArray) -> FloatArray:
    """Return the drift for a rate of 1 at a mileage `since` the onset [UNIT_KM]."""
    return np.asarray(POWER_UNITS * (since / POWER_UNITS) ** power)


class Covariance:
    """Covariances of blocks, `values` of shape (n_motions or 1, n_starts or 1, n_blocks, n_blocks).

    Those that averaging has made indefinite are repaired.
    """

    def __init__(self, values: FloatArray) -> None:
        self.values = values

    @cached_property
    def inverted(self) -> tuple[FloatArray, FloatArray]:
        """Inverse of each, and logarithm of its determinant (n_motions or 1, n_starts or 1)."""
        values = self.values
        try:
            factor = np.linalg.cholesky(values)
        except np.linalg.LinAlgError:
            values = positive_definite(values)
            factor = np.linalg.cholesky(values)
        diagonal = np.diagonal(factor, axis1=-2, axis2=-1)
        return np.asarray(np.linalg.inv(values)), np.asarray(2 * np.log(diagonal).sum(axis=-1))


class Fit:
    """Posterior of one model at its nodes: motions x starts x onsets x components of the rate.

    With the covariance C, X = (1, course) and P the prior precision of level and rate, their
    posterior precision is M = X^T C^-1 X + P; the evidence is that of Bayesian linear regression
    ([1]_, sec. 2.7). `linear` models the value, else its logarithm; the linear scale is divided by
    the value, so that noise is relative to the value in both.

    `covariance`, (n_motions or 1, 1, n_blocks, n_blocks), is that of the noise. `rows`,
    (n_motions,), are rows of ``WearPrior.models``. `log_weight`, (n_motions, n_starts, n_onsets,
    n_components), is the logarithm of prior times evidence of each node.

    References
    ----------
    .. [1] Rasmussen, Williams, Gaussian Processes for Machine Learning, MIT Press, 2006.
    """

    def __init__(
        self,
        blocks: Blocks,
        covariance: Covariance,
        hinges: Hinges,
        prior: WearPrior,
        rows: IntArray,
        motion: Motion | None = None,
        *,
        linear: bool = True,
    ) -> None:
        self.hinges, self.rows, self.last = hinges, rows, blocks.last
        scale = 1 + blocks.value if linear else np.ones(blocks.t.size)
        self._unit = 1 / scale
        self._values = (blocks.value if linear else blocks.log_value) / scale
        self._course = hinges.course(blocks) / scale
        start = hinges.onsets[:, 0]
        self._with_last = np.zeros((1, start.size, scale.size, 3))
        self._own = np.zeros((1, start.size, 3, 3))
        total = covariance
        if motion is not None:  # Brownian motion adds to the noise and to the state at the end
            since = np.maximum(blocks.t - start[:, None], 0)
            variances = motion.variances[:, None, None, None]
            shape = motion.covariance(since, blocks.length) / np.outer(scale, scale)
            total = Covariance(total.values + variances * shape)
            with_last, own = motion.with_last(since, blocks.last - start)
            self._with_last = variances * with_last / scale[:, None]
            self._own = variances * own
        self._inverse, log_det = total.inverted
        # sums of the normal equations of the two unknowns level and rate
        of_unit, of_values = (self._inverse @ x for x in (self._unit, self._values))
        of_course = self._course @ self._inverse  # (motions, starts, onsets, blocks)
        a11 = (of_unit @ self._unit)[..., None, None]
        a12 = np.einsum("sob,msb->mso", self._course, of_unit)[..., None]
        a22 = np.einsum("sob,msob->mso", self._course, of_course)[..., None]
        c1 = (of_unit @ self._values)[..., None, None]
        c2 = np.einsum("sob,msb->mso", self._course, of_values)[..., None]
        yy = (of_values @ self._values)[..., None, None]
        # with the prior: their posterior, and the evidence of each node
        p1, p2 = LEVEL_SPREAD**-2.0, prior.spreads**-2.0
        m11, m22 = a11 + p1, a22 + p2
        det = m11 * m22 - a12**2
        self._level, self._rate = (m22 * c1 - a12 * c2) / det, (m11 * c2 - a12 * c1) / det
        self._spreads = [m / det for m in (m22, -a12, m11)]
        misfit = yy - self._level * c1 - self._rate * c2
        evidence = -0.5 * (log_det[..., None, None] + np.log(det / (p1 * p2)) + misfit)
        log_prior = np.log(np.maximum(prior.models[rows], TINY))[:, None, None] + hinges.log_prior
        self.log_weight = evidence + log_prior[..., None] + np.log(np.maximum(prior.weights, TINY))

    def now(self, nodes: IntArray) -> NodeStates:
        """Return the posterior state at the last trip of `nodes`, indices into flat log_weight."""
        m, s, o, j = np.unravel_index(nodes, self.log_weight.shape)
        first = np.minimum(m, self._with_last.shape[0] - 1)
        with_last = self._with_last[first, s]
        of_last = self._inverse[m, np.minimum(s, self._inverse.shape[1] - 1)] @ with_last
        since, power = self.last - self.hinges.onsets[s, o], self.hinges.powers[s, o]
        # at the last trip: gain (level, rate) + Brownian motion given the trips
        gain = np.zeros((m.size, 3, 2))
        gain[:, :, 0] = -(self._unit @ of_last)
        gain[:, :, 1] = -(self._course[s, o][:, None] @ of_last)[:, 0]
        gain[:, 0, 0] += 1
        gain[:, 0, 1] += powered(since, power)
        gain[:, 1, 1] += 1
        level, rate, s11, s12, s22 = (
            np.broadcast_to(x, self._rate.shape)[m, s, o, j]
            for x in (self._level, self._rate, *self._spreads)
        )
        spread = np.stack([s11, s12, s12, s22], axis=-1).reshape(-1, 2, 2)
        spare = self._own[first, s] - with_last.swapaxes(1, 2) @ of_last
        return NodeStates(
            row=self.rows[m],
            since=since,
            power=power,
            mean=self._values @ of_last + (gain @ np.stack([level, rate], -1)[..., None])[..., 0],
            covariance=gain @ spread @ gain.swapaxes(1, 2) + spare,
        )


@dataclass(frozen=True)
class NodeStates:
    """Gaussian states of nodes at the last trip.

    `row` of ``WearPrior.models``, mileage `since` the onset [UNIT_KM] and its `power`: (n_nodes,).
    `mean`, (n_nodes, 3): value - 1 (or the logarithm of the value for "exponential"), rate of the
    drift and change of the rate by Brownian motion, both [1 / UNIT_KM]; `covariance`,
    (n_nodes, 3, 3).
    """

    row: IntArray
    since: FloatArray
    power: FloatArray
    mean: FloatArray
    covariance: FloatArray


def join(several: list[NodeStates]) -> NodeStates:
    """Return the nodes of several together."""
    names = [field.name for field in fields(NodeStates)]
    return NodeStates(*(np.concatenate([getattr(s, name) for s in several]) for name in names))


def shares(fits: list[Fit]) -> list[FloatArray]:
    """Return the probabilities of the nodes of each fit, flat; they sum to 1 over all fits."""
    peak = max(fit.log_weight.max() for fit in fits)
    weights = [np.exp(fit.log_weight - peak).reshape(-1) for fit in fits]
    total = sum(weight.sum() for weight in weights)
    return [weight / total for weight in weights]


def positive_definite(covariance: FloatArray) -> FloatArray:
    """Return covariances with positive eigenvalues.

    Brownian motion is averaged as if trips were evenly spaced in a block, so a covariance can be
    indefinite if they are spaced very unevenly and their noise differs much.
    """
    values, vectors = np.linalg.eigh(covariance)
    raised = np.maximum(values, LEAST_EIGENVALUE * values[..., -1:])
    definite = (vectors * raised[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray((definite + np.swapaxes(definite, -1, -2)) / 2)
