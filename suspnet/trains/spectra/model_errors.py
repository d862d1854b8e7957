"""Errors of a vehicle's responses by frequency, learnt on trips that it should explain.

The true response of sensor i to input k is H_ik (1 + e_ik), with e_ik of variance eps_i(f)^2. Noise
N averages out over n averages, errors do not: they act like noise of ::

    N' = N + n diag(eps_i^2 S_ii)

on the residuals y_k = V r_k of a bin (`suspnet.trains.spectra.subspace`, with N' for N), V the
m - p directions that the vehicle does not move. With W = V N'^-1/2 and unit vectors u_i ::

    E sum_k y_k y_k^* / 2 = p W N' W^*
                          = p W N W^* + p n sum_i eps_i^2 S_ii (W u_i) (W u_i)^*

eps_i^2 are non-negative sums of hat functions ``SPACING_HZ`` apart, fitted by least squares to all
bins of all trips; N' on the left is that of the round before. ``CERTAIN`` standard deviations that
noise alone gives are taken off, so that a vehicle that explains its trips has no errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from suspnet.ground.types import FloatArray
from suspnet.trains.spectra.covariance_matching import misfit_of
from suspnet.trains.spectra.hat_functions import hat_functions
from suspnet.trains.spectra.subspace import SpectralMatrix

SPACING_HZ = 1.0
"""Distance of the frequencies between which errors are interpolated."""
ROUNDS = 3
"""Rounds of least squares, each with the weights of the one before."""
CERTAIN = 3.0
"""Standard deviations of noise above which there is an error."""
RIDGE = 1e-9
"""Added to the scaled normal equations, which are singular where a sensor shows nothing."""
LARGEST = 10.0
"""Largest error: a sensor that shows nothing of the vehicle."""


@dataclass(frozen=True)
class Explained:
    """A trip and what a vehicle makes of it.

    `noise` is N (n_freq, m, m), `responses` H (p, m, n_freq); `bins` and `sensors` are their
    numbers among those of all trips.
    """

    spectra: SpectralMatrix
    noise: Tensor
    responses: Tensor
    bins: Tensor
    sensors: Sequence[int]

    def rest(self, squares: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what errors must explain, its standard deviation by noise, and their patterns.

        Real and imaginary parts one after the other, (n_freq, n), (n_freq, n), (n_freq, m, n);
        `squares` (n_freq, m) are eps_i^2 in N'.
        """
        spread = (self.spectra.n_averages * squares).sqrt()
        misfit = misfit_of(self.spectra, self.noise, len(self.responses), spread)
        return misfit.error_equations(self.responses)


class ExplainedTrip(Protocol):
    """A trip or record with what its vehicle leaves of it, as of `Explained`."""

    @property
    def bins(self) -> Tensor:
        """Numbers of its bins."""

    @property
    def sensors(self) -> Sequence[int]:
        """Numbers of its sensors."""

    def rest(self, squares: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what errors must explain, its deviation by noise, and their patterns."""


def model_errors(
    frequencies_hz: Tensor,
    trips: Sequence[ExplainedTrip],
    before: Tensor | None,
    n_sensors: int,
    spacing_hz: float = SPACING_HZ,
) -> Tensor:
    """Return eps, (n_freq, n_sensors) [-]; `before` is that of an earlier round, None: 0."""
    basis = hat_functions(frequencies_hz, spacing_hz)
    zeros = torch.zeros(len(basis), n_sensors, dtype=torch.float64)
    squares = zeros if before is None else before**2
    n = basis.shape[1] * n_sensors
    for _ in range(ROUNDS):
        information, score, scatter = np.zeros((n, n)), np.zeros(n), np.zeros(n)
        for trip in trips:
            sensors = list(trip.sensors)
            target, deviations, patterns = trip.rest(squares[trip.bins][:, sensors])
            # (n_freq, n, n_knots, n_sensors)
            columns = zeros.new_zeros(*target.shape, basis.shape[1], n_sensors)
            columns[..., sensors] = torch.einsum("fk,fmr->frkm", basis[trip.bins], patterns)
            rows = columns.flatten(0, 1).flatten(1).numpy()
            information += rows.T @ rows
            score += rows.T @ target.flatten().numpy()
            scatter += (rows**2).T @ deviations.flatten().numpy() ** 2
        found = _non_negative(information, score - CERTAIN * np.sqrt(scatter))
        squares = basis @ torch.as_tensor(found.reshape(-1, n_sensors))
        squares = squares.clamp(max=LARGEST**2)
    return squares.sqrt()


def _non_negative(information: FloatArray, score: FloatArray) -> FloatArray:
    """Return the x >= 0 that minimises x^T information x / 2 - score^T x."""
    sizes = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information / sizes[:, None] / sizes + RIDGE * np.eye(len(sizes))
    factor = np.linalg.cholesky(scaled)
    return np.asarray(nnls(factor.T, np.linalg.solve(factor, score / sizes))[0] / sizes)
