"""The directions of a generator's uncertain numbers that its curves show.

With F the factor of the log-normal distribution, the logarithms of the numbers (of those that may
be absent: of 1 + number) are mean + F z, z standard normal. Many directions of z leave the curves
as they are. With J the derivative of the curves in units of their noise, the eigenvectors of the
mean of J^T J over vehicles (the active subspace; Constantine, Active subspaces, 2015) are
directions of ever less effect, whose rms is the root of the eigenvalue. Those of next to no effect
are left at the median.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from suspnet.dynamics import PARAMETERS, ResponseGenerator

if TYPE_CHECKING:
    from suspnet.spectra.observation import Observer

LEAST_EFFECT = 0.1
"""Rms effect of a direction that counts, in standard deviations of the noise: what is left out
widens a parameter's deviation by about 0.5 % a direction at most."""
N_VEHICLES = 24
"""Vehicles over which the effect is averaged."""
FURTHEST = 2.0
"""Their parameters lie within this factor of healthy."""
STEP = 1e-4
"""Step of the central differences, in standard deviations of the numbers."""


@dataclass(frozen=True)
class Directions:
    """Directions of uncertain numbers: a few standard normal coordinates instead of every number.

    Attributes
    ----------
    generator : ResponseGenerator
    factor : tensor of shape (n_names, n), [-]
        Change of the logarithms of the distribution's numbers for a coordinate of 1.
    neglected, strongest : float, [-]
        Rms effect of all directions left out, and of the first one, in standard deviations of the
        noise.
    """

    generator: ResponseGenerator
    factor: Tensor
    neglected: float = 0.0
    strongest: float = 0.0

    @property
    def n(self) -> int:
        """Number of directions."""
        return self.factor.shape[1]

    def vehicles(self, ratios: Tensor, coordinates: Tensor) -> Tensor:
        """Return ratios with all columns, or as they are where no number is uncertain.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, n_columns), [-]
        coordinates : tensor of shape (n_vehicles, n), [-]
            0 is the median of the distribution.
        """
        distribution = self.generator.distribution
        if not self.n or distribution is None:
            return ratios
        mean = torch.tensor(distribution.mean, dtype=torch.float64).to(coordinates)
        exponentials = (mean + coordinates @ self.factor.to(coordinates).T).exp()
        offsets = torch.as_tensor(distribution.offsets).to(coordinates)
        return self.generator.with_uncertain(ratios, exponentials - offsets)


def every_direction(generator: ResponseGenerator) -> Directions:
    """Return coordinates of all uncertain numbers of a generator."""
    distribution = generator.distribution
    if distribution is None or not distribution.names:
        return Directions(generator, torch.zeros(0, 0, dtype=torch.float64))
    return Directions(generator, torch.as_tensor(distribution.factor.copy()))


def directions(observer: Observer) -> Directions:
    """Return the directions of the uncertain numbers that matter to an observer's curves."""
    every = every_direction(observer.generator)
    if not every.n:
        return every
    points = torch.quasirandom.SobolEngine(len(PARAMETERS)).draw(N_VEHICLES, dtype=torch.float64)
    ratios = torch.exp(math.log(FURTHEST) * (2 * points - 1))
    standard = np.random.default_rng(0).standard_normal((N_VEHICLES, every.n))
    jacobian = _jacobian(observer, every, ratios, torch.as_tensor(standard))
    values, vectors = torch.linalg.eigh((jacobian @ jacobian.mT).mean(dim=0))
    effects = values.clamp(min=0).sqrt()
    kept = effects >= LEAST_EFFECT
    factor = (every.factor.to(vectors) @ vectors)[:, kept].flip(1)
    neglected = float(effects[~kept].square().sum().sqrt())
    return Directions(every.generator, factor, neglected, float(effects[-1]))


def _jacobian(observer: Observer, every: Directions, ratios: Tensor, standard: Tensor) -> Tensor:
    """Return the derivative of the misfit with respect to z, shape (n, n_names, n_points)."""
    rows = torch.arange(len(ratios))
    here = every.vehicles(ratios, standard)
    misfit = observer.misfit(observer.noise_free(here), here)
    columns = []
    for step in STEP * torch.eye(every.n, dtype=standard.dtype):
        above, below = (every.vehicles(ratios, standard + way * step) for way in (1, -1))
        columns.append(misfit(above, rows) - misfit(below, rows))
    return torch.stack(columns, dim=1) / (2 * STEP)
