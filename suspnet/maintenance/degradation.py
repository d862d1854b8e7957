"""Degradation models of one parameter: posterior of its level, its rate and its onset.

All work in units of ``UNIT_KM`` and on blocks of neighbouring trips: the cost does not grow with
the history. A model is a drift from an onset h on,

    level + rate * f(t - h) + B(t - h),

in the value or, "exponential", in its logarithm. f(x) = x, but "changing rate" has powers of x. B
is Brownian motion of variance q x for "wiener", its integral for "changing rate", and 0 otherwise.
Measurement noise is autoregressive of order one. Given onset, power, q and the component of the
prior ("node"), level and rate are Gaussian: their posterior and the evidence are closed forms, and
everything else is a sum over a grid of nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from suspnet.ground.types import FloatArray, IntArray
from suspnet.maintenance.noise import Blocks, Noise, noise_covariance

MODELS = ("no trend", "linear", "exponential", "wiener", "changing rate")
LEAST_EIGENVALUE = 1e-9
"""Least eigenvalue over the largest to which a covariance that has no Cholesky factor is raised."""
N_ONSETS = 40
"""Number of onsets of each model."""
ONSET_PASSES = 3
"""Number of times that "linear" and "exponential" add onsets about the best one."""
AT_ONCE = 0.5
"""Prior probability that wear begins before the first trip."""
LEVEL_SPREAD = 0.1
"""Prior standard deviation of the value at the first trip about 1."""
DIFFUSIONS = np.geomspace(0.0015, 0.1, 13)
"""Standard deviations of Brownian motion after ``UNIT_KM``."""
RATE_CHANGES = np.geomspace(0.0002, 0.02, 7)
"""Standard deviations of the change of the rate after ``UNIT_KM``, per ``UNIT_KM``."""
POWERS = np.array([0.5, 0.7, 1.0, 1.4, 2.0])
"""Powers of the mileage since the onset in "changing rate"."""
POWER_UNITS = 3.0
"""Mileage [UNIT_KM] since the onset to which the rate of a power is the mean rate."""
FIRST_WIENER = 3
FIRST_CHANGING = FIRST_WIENER + DIFFUSIONS.size
"""First rows of "wiener" and "changing rate" in ``FleetPrior.models``."""
N_STARTS = 8
"""Number of onsets of Brownian motion; an onset of the drift uses the last one before it."""
TINY = 1e-300
"""Replaces a probability of 0 in logarithms."""
DETAILED = 0.3
"""Least probability of a trend, without Brownian motion, for which that is fitted too."""


@dataclass(frozen=True)
class FleetPrior:
    """Prior over models and rates.

    Attributes
    ----------
    models : array of shape (n_rows,), [-]
        Probability of "no trend", "linear", "exponential", "wiener" with each of ``DIFFUSIONS``
        and "changing rate" with each of ``RATE_CHANGES``.
    weights, means, spreads : arrays of shape (n_components,), [-], [1 / UNIT_KM]
        The rate is a mixture of normal distributions.
    """

    models: FloatArray
    weights: FloatArray
    means: FloatArray
    spreads: FloatArray


def fit_models(blocks: Blocks, noise: Noise, prior: FleetPrior) -> list[Fit]:
    """Return the fit of each of ``MODELS``, or of the first three where no trend is likely.

    Parameters
    ----------
    blocks : Blocks
    noise : Noise
        For diffusion 0 and each of ``DIFFUSIONS``.
    prior : FleetPrior
    """
    covariance = noise_covariance(blocks, noise.variance, noise.correlation)
    fits = [_without_trend(blocks, covariance[:1], prior)]
    fits += [_straight(blocks, covariance[:1], prior, row, _onsets(blocks.last)) for row in (1, 2)]
    if shares(fits)[0][0] > 1 - DETAILED:
        return fits
    fits[1:] = [_refined(blocks, covariance[:1], prior, fit) for fit in fits[1:]]
    fits.append(_wandering(blocks, covariance[1:], prior, Motion(DIFFUSIONS**2, False)))
    fits.append(_wandering(blocks, covariance[:1], prior, Motion(RATE_CHANGES**2, True)))
    return fits


def _onsets(last: float) -> FloatArray:
    return last * np.linspace(0, 0.95, N_ONSETS)


def _without_trend(blocks: Blocks, covariance: FloatArray, prior: FleetPrior) -> Fit:
    # a constant value is a rate whose prior is 0
    constant = FleetPrior(prior.models, np.ones(1), np.zeros(1), np.full(1, 1e-9))
    hinges = Hinges(np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))
    return Fit(blocks, True, covariance[:, None], hinges, constant, np.zeros(1, dtype=np.int64))


def _straight(
    blocks: Blocks, covariance: FloatArray, prior: FleetPrior, row: int, onsets: FloatArray
) -> Fit:
    hinges = Hinges(onsets[None], np.ones((1, onsets.size)), _log_measure(onsets)[None])
    return Fit(blocks, row == 1, covariance[:, None], hinges, prior, np.array([row]))


def _refined(blocks: Blocks, covariance: FloatArray, prior: FleetPrior, fit: Fit) -> Fit:
    for _ in range(ONSET_PASSES):
        onsets = fit.hinges.onsets[0]
        best = int(fit.log_weight.max(axis=(0, 1, 3)).argmax())
        low, high = onsets[max(best - 1, 0)], onsets[min(best + 1, onsets.size - 1)]
        onsets = np.unique(np.concatenate([onsets, np.linspace(low, high, 17)]))
        fit = _straight(blocks, covariance, prior, int(fit.rows[0]), onsets)
    return fit


def _wandering(blocks: Blocks, covariance: FloatArray, prior: FleetPrior, motion: Motion) -> Fit:
    powers = POWERS if motion.integrated else np.ones(1)
    onsets = _onsets(blocks.last)
    log_measure = np.repeat(_log_measure(onsets), powers.size) - np.log(powers.size)
    hinges = Hinges(
        np.repeat(onsets, powers.size).reshape(N_STARTS, -1),
        np.tile(powers, N_ONSETS).reshape(N_STARTS, -1),
        log_measure.reshape(N_STARTS, -1),
    )
    first = FIRST_CHANGING if motion.integrated else FIRST_WIENER
    rows = first + np.arange(motion.variances.size)
    return Fit(blocks, True, covariance[:, None], hinges, prior, rows, motion)


def _log_measure(onsets: FloatArray) -> FloatArray:
    """Return the logarithm of the prior of each onset; the first stands for all before it."""
    widths = np.gradient(onsets)
    widths[0] = 0.0
    share = (1 - AT_ONCE) * widths / widths.sum()
    share[0] = AT_ONCE
    return np.asarray(np.log(share), dtype=float)


@dataclass(frozen=True)
class Motion:
    """Brownian motion of the value, or of the rate if `integrated`; `variances` per mileage."""

    variances: FloatArray
    integrated: bool

    def covariance(self, since: FloatArray, length: FloatArray) -> FloatArray:
        """Return the covariance of unit variance between blocks (starts, blocks, blocks)."""
        least = np.minimum(since[:, :, None], since[:, None, :])
        if self.integrated:
            most = np.maximum(since[:, :, None], since[:, None, :])
            return np.asarray(least**2 * (3 * most - least) / 6)
        index = np.arange(since.shape[1])
        least[:, index, index] = np.maximum(since - length / 6, since / 2)
        return least

    def with_last(self, since: FloatArray, last: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return covariances of blocks with value and rate at the last trip (starts, blocks, 3).

        The third axis is value, 0, rate; the second array is their own (starts, 3, 3).
        """
        own = np.zeros((last.size, 3, 3))
        none = np.zeros_like(since)
        if not self.integrated:
            own[:, 0, 0] = last
            return np.stack([since, none, none], axis=-1), own
        own[:, 0, 0], own[:, 2, 2] = last**3 / 3, last
        own[:, 0, 2] = own[:, 2, 0] = last**2 / 2
        value = since**2 * (3 * last[:, None] - since) / 6
        return np.stack([value, none, since**2 / 2], axis=-1), own


@dataclass(frozen=True)
class Hinges:
    """Courses of the drift: arrays of shape (n_starts, n_onsets), Brownian motion from each start.

    Attributes
    ----------
    onsets : array, [UNIT_KM]
    powers : array, [-]
        Of the mileage since the onset.
    log_prior : array
    """

    onsets: FloatArray
    powers: FloatArray
    log_prior: FloatArray

    def course(self, t: FloatArray) -> FloatArray:
        """Return the course for a rate of 1, of shape (n_starts, n_onsets, n_t)."""
        return powered(np.maximum(t - self.onsets[..., None], 0), self.powers[..., None])


def powered(since: FloatArray, power: FloatArray) -> FloatArray:
    """Return the drift for a rate of 1 at a mileage since the onset, in ``UNIT_KM``."""
    return np.asarray(POWER_UNITS * (since / POWER_UNITS) ** power)


class Fit:
    """Posterior of one model, for motions x starts x onsets x components of the rate ("nodes").

    With C the covariance, X = (1, course) and the Gaussian prior of level and rate, their posterior
    has precision M = X^T C^-1 X + P; the evidence is that of Bayesian linear regression ([1]_, sec.
    2.7). The linear scale is divided by the value, so that noise is relative to the value in both.

    Parameters
    ----------
    blocks : Blocks
    linear : bool
        The value itself, or else its logarithm.
    covariance : array of shape (n_motions or 1, 1, n_blocks, n_blocks)
        Of the noise.
    hinges : Hinges
    prior : FleetPrior
    rows : int array of shape (n_motions,)
        As in ``FleetPrior.models``.
    motion : Motion, optional

    Attributes
    ----------
    log_weight : array of shape (n_motions, n_starts, n_onsets, n_components)
        Logarithm of prior times evidence of each node.

    References
    ----------
    .. [1] Rasmussen, Williams, Gaussian Processes for Machine Learning, MIT Press, 2006.
    """

    def __init__(
        self,
        blocks: Blocks,
        linear: bool,
        covariance: FloatArray,
        hinges: Hinges,
        prior: FleetPrior,
        rows: IntArray,
        motion: Motion | None = None,
    ) -> None:
        self.hinges, self.rows, self.last = hinges, rows, blocks.last
        scale = 1 + blocks.value if linear else np.ones(blocks.t.size)
        self._one = 1 / scale
        self._values = (blocks.value if linear else blocks.log_value) / scale
        self._course = hinges.course(blocks.t) / scale
        start = hinges.onsets[:, 0]
        self._with_last = np.zeros((1, start.size, scale.size, 3))
        self._own = np.zeros((1, start.size, 3, 3))
        total = covariance
        if motion is not None:
            since = np.maximum(blocks.t - start[:, None], 0)
            variances = motion.variances[:, None, None, None]
            shape = motion.covariance(since, blocks.length) / np.outer(scale, scale)
            total = covariance + variances * shape
            with_last, own = motion.with_last(since, blocks.last - start)
            self._with_last = variances * with_last / scale[:, None]
            self._own = variances * own
        try:
            factor = np.linalg.cholesky(total)
        except np.linalg.LinAlgError:
            total = _definite(total)
            factor = np.linalg.cholesky(total)
        diagonal = np.diagonal(factor, axis1=-2, axis2=-1)
        self._inverse = np.linalg.inv(total)
        self._solve(2 * np.log(diagonal).sum(axis=-1), prior)

    def _solve(self, log_det: FloatArray, prior: FleetPrior) -> None:
        # level, rate and evidence of each node, by the normal equations of two unknowns
        of_one, of_values = (self._inverse @ x for x in (self._one, self._values))
        of_course = self._course @ self._inverse  # (motions, starts, onsets, blocks)
        a11 = (of_one @ self._one)[..., None, None]
        a12 = np.einsum("sob,msb->mso", self._course, of_one)[..., None]
        a22 = np.einsum("sob,msob->mso", self._course, of_course)[..., None]
        c1 = (of_one @ self._values)[..., None, None]
        c2 = np.einsum("sob,msb->mso", self._course, of_values)[..., None]
        yy = (of_values @ self._values)[..., None, None]
        p1, p2 = LEVEL_SPREAD**-2.0, prior.spreads**-2.0
        m11, m12, m22, r2 = a11 + p1, a12, a22 + p2, c2 + p2 * prior.means
        det = m11 * m22 - m12**2
        self._level, self._rate = (m22 * c1 - m12 * r2) / det, (m11 * r2 - m12 * c1) / det
        self._spreads = [m / det for m in (m22, -m12, m11)]
        misfit = yy + p2 * prior.means**2 - self._level * c1 - self._rate * r2
        evidence = -0.5 * (log_det[..., None, None] + np.log(det / (p1 * p2)) + misfit)
        log_prior = np.log(np.maximum(prior.models[self.rows], TINY))[:, None, None]
        log_prior = log_prior + self.hinges.log_prior
        self.log_weight = evidence + log_prior[..., None] + np.log(np.maximum(prior.weights, TINY))

    def now(self, nodes: IntArray) -> State:
        """Return the posterior of the present state of some nodes, by index of the flat array."""
        m, s, o, j = np.unravel_index(nodes, self.log_weight.shape)
        first = np.minimum(m, self._with_last.shape[0] - 1)
        with_last = self._with_last[first, s]
        of_last = self._inverse[m, np.minimum(s, self._inverse.shape[1] - 1)] @ with_last
        since, power = self.last - self.hinges.onsets[s, o], self.hinges.powers[s, o]
        # at the last trip: gain (level, rate) + Brownian motion given the trips
        gain = np.zeros((m.size, 3, 2))
        gain[:, :, 0] = -(self._one @ of_last)
        gain[:, :, 1] = -(self._course[s, o][:, None] @ of_last)[:, 0]
        gain[:, 0, 0] += 1
        gain[:, 0, 1] += powered(since, power)
        gain[:, 1, 1] += 1
        at = (m, s, o, j)
        level, rate = (np.broadcast_to(x, self._rate.shape)[at] for x in (self._level, self._rate))
        s11, s12, s22 = (np.broadcast_to(x, self._rate.shape)[at] for x in self._spreads)
        spread = np.stack([s11, s12, s12, s22], axis=-1).reshape(-1, 2, 2)
        spare = self._own[first, s] - with_last.swapaxes(1, 2) @ of_last
        return State(
            row=self.rows[m],
            since=since,
            power=power,
            mean=self._values @ of_last + (gain @ np.stack([level, rate], -1)[..., None])[..., 0],
            covariance=gain @ spread @ gain.swapaxes(1, 2) + spare,
        )


@dataclass(frozen=True)
class State:
    """Present state of nodes; arrays of shape (n_nodes,).

    Attributes
    ----------
    row : int array
        As in ``FleetPrior.models``.
    since : array, [UNIT_KM]
        Mileage from the onset to the last trip.
    power : array, [-]
        Of the mileage since the onset.
    mean : array of shape (n_nodes, 3), [-], [1 / UNIT_KM], [1 / UNIT_KM]
        At the last trip: value - 1 (or its logarithm for "exponential"), rate of the drift,
        change of the rate by Brownian motion.
    covariance : array of shape (n_nodes, 3, 3)
    """

    row: IntArray
    since: FloatArray
    power: FloatArray
    mean: FloatArray
    covariance: FloatArray


def join(states: list[State]) -> State:
    """Return the nodes of several states as one."""
    return State(*(np.concatenate([getattr(one, f.name) for one in states]) for f in fields(State)))


def shares(fits: list[Fit]) -> list[FloatArray]:
    """Return the probabilities of the nodes of each fit, flat; all of them sum to 1."""
    peak = max(fit.log_weight.max() for fit in fits)
    weights = [np.exp(fit.log_weight - peak).reshape(-1) for fit in fits]
    total = sum(weight.sum() for weight in weights)
    return [weight / total for weight in weights]


def _definite(covariance: FloatArray) -> FloatArray:
    """Return covariances with positive eigenvalues.

    The covariance of a path between blocks is that of evenly spaced trips within each; it is not
    definite where trips of very different noise are spaced very unevenly.
    """
    values, vectors = np.linalg.eigh(covariance)
    raised = np.maximum(values, LEAST_EIGENVALUE * values[..., -1:])
    found = (vectors * raised[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray((found + np.swapaxes(found, -1, -2)) / 2)
