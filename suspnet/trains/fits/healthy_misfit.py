"""The sum of squares of a healthy trip's two responses, as a function of the vehicle's numbers.

With z the standard normal coordinates of the prior (logarithms of numbers = mean + F z), m the
logarithm of the car-body mass and u(z, m) the whitened misfit of the responses at one speed
(`EstimateMisfit`), the most probable vehicle minimises::

    |u|^2 + |z|^2 + ((m - mean) / deviation)^2

A search allows a model error of ``SPREAD`` in addition to the noise, which may be a thousandth of
the curves: without it the search would end in a valley far off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.curves.curves import every_direction
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import Speeds
from suspnet.ground.parameters import FORWARD, Direction
from suspnet.ground.tensors import complex_log
from suspnet.ground.types import FloatArray
from suspnet.learning.least_squares import LevenbergMarquardt
from suspnet.vehicle import PARAMETERS, VerticalVehicle
from suspnet.vehicle.quantities import MASS_DEVIATION, MASS_MEAN, LogNormal

SPREAD = 0.3
"""Rms model error that a search allows in addition to the noise."""
MAX_ITER, TOL, LEAST_DECREASE, DAMPING = 12, 1e-2, 1e-3, 1e-2
"""Largest number of iterations of a search, the step in standard deviations of the prior and the
decrease of half the sum of squares at which it ends, and its first damping."""
Z_BOUND = 8.0
"""Bound of the coordinates, in standard deviations of the prior."""


@dataclass(frozen=True)
class HealthySpectra:
    """Spectra (3, n_freq) of a trip at one speed: one car-body mass, one direction.

    `left_out` (n_freq,) are bins with lines of out-of-round wheels.
    """

    speeds: Speeds
    spectra: CrossSpectra
    direction: Direction = FORWARD
    left_out: Tensor | None = None


class HealthyMisfit:
    """The sum of squares as a function of theta = (z, m), of one trip at one speed."""

    def __init__(
        self, generator: VerticalVehicle, settings: EstimateSettings, spectra: HealthySpectra
    ) -> None:
        self.prior = generator.distribution or LogNormal((), (), ())
        self._every = every_direction(generator)
        observer = settings.observer(generator.running(spectra.direction)).at(spectra.speeds)
        self._measured = observer.without(spectra.left_out).measured_misfit(spectra.spectra)
        self._thinned = self._measured.thinned()

    def start(self, mass_log: float = MASS_MEAN) -> FloatArray:
        """Return theta of the median vehicle, (n_coordinates,)."""
        return np.append(np.zeros(len(self.prior.names)), mass_log)

    def score(self, theta: FloatArray) -> float:
        """Return the rms of all residuals with model errors of ``SPREAD``, priors included."""
        return float(self._residuals(row_of(theta)).square().mean().sqrt())

    def misfit(self, theta: FloatArray) -> float:
        """Return the rms residual without model errors over that of the noise."""
        ratio = self._measured.observer.noise_free(self._ratios(row_of(theta)))
        u = 1 - ratio / self._measured.observed
        white = self._measured.whitened(u, torch.zeros(1, dtype=torch.int64))
        return math.sqrt(float(white.square().mean()) / self._measured.expected)

    def search(self) -> FloatArray:
        """Return theta at the end of a search from the median vehicle, (n_coordinates,)."""
        start = row_of(self.start())
        high = torch.full((start.shape[1],), Z_BOUND, dtype=torch.float64)
        solver = LevenbergMarquardt(
            max_iter=MAX_ITER,
            tol=TOL,
            first_damping=DAMPING,
            bounds=(-high, high),
            one_sided=True,
            least_decrease=LEAST_DECREASE,
        )
        found = solver.minimise(lambda theta, _: self._residuals(theta), start)
        return np.asarray(found.parameters[0].numpy())

    def _ratios(self, theta: Tensor) -> Tensor:
        """Return all columns of ratios, (n_rows, n_columns)."""
        healthy = torch.ones(len(theta), len(PARAMETERS), dtype=torch.float64)
        healthy[:, -1] = theta[:, -1].exp()
        return self._every.vehicles(healthy, theta[:, :-1])

    def _residuals(self, theta: Tensor) -> Tensor:
        """Return all residuals, those of the priors last, (n_rows, n_points)."""
        misfit = self._thinned
        # logarithms converge from far off, but have the heavy tails of a ratio of noise
        u = complex_log(misfit.observed / misfit.observer.noise_free(self._ratios(theta)))
        white = misfit.whitened(u, torch.zeros(1, dtype=torch.int64), SPREAD)
        mass = (theta[:, -1:] - MASS_MEAN) / MASS_DEVIATION
        return torch.cat([white, theta[:, :-1], mass], dim=1)


def row_of(x: FloatArray) -> Tensor:
    """Return one point as a tensor of one row."""
    return torch.as_tensor(x)[None]
