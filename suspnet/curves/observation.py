"""What observations of curves share: numbers of curves, and directions of uncertain numbers.

An observation is a set of three classes: settings with the values of a YAML file, the observer that
they create for a generator, and its misfit to observed curves. `curves` has those of the paper
(magnitudes with white noise), `estimates` those of trips (transfer functions estimated from
recordings), and the types of what may be either.

Directions: the logarithms of a generator's uncertain numbers (of 1 + number for those that may be
absent) are normal, mean + F z with z standard normal. Many directions of z hardly change the
curves. With J the derivative of the curves in units of their noise, the eigenvectors of the mean of
J^T J over vehicles (the active subspace; Constantine, Active subspaces, 2015) are directions of
decreasing effect, with the root of the eigenvalue as rms effect. Directions of negligible effect
are fixed at the median.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Self

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.settings import Setting, check_number, check_settings, setting
from suspnet.vehicle import PARAMETERS, ResponseGenerator

if TYPE_CHECKING:
    from suspnet.curves.estimates import Observer

LEAST_CALIBRATION = 100
"""Smallest number of calibration curves; the coverage of a 90 % interval then scatters by 3 %."""
MOST_BINS = 100_000
"""Largest number of frequency bins of a curve; the paper has 1,000, a band up to 25 Hz 500."""
MOST_CURVES = 100_000_000
"""Largest number of curves; their parameters alone then take 4 GB."""
LEAST_EFFECT = 0.1
"""Smallest rms effect of a direction that is retained, in standard deviations of the noise; each
neglected one would widen a parameter's deviation by about 0.5 % at most."""
N_VEHICLES = 24
"""Number of vehicles over which the effect is averaged."""
FURTHEST = 2.0
"""Largest factor, up or down, between the parameters of these vehicles and healthy."""
STEP = 1e-4
"""Step of the central differences, in standard deviations of the numbers."""


N_TRAIN, N_UNCERTAIN_TRAIN = 20_000, 4_000
"""Default numbers of training curves; the second for a vehicle with uncertain numbers, where the
regression is only the start of the fit that reads a trip: with 20,000 its results are the same."""
CACHE_FOLDER = ".cache/suspnet"
CacheFolder = Annotated[
    str | None,
    Setting(
        "Folder where features of curves are stored between runs; null stores none", rule="path"
    ),
]


@dataclass(frozen=True)
class Counts:
    """Numbers of curves, which the settings of every observation start with."""

    n_train: int | str | None = setting(
        None,
        "Number of training curves, or all for the whole grid of the protocol; null is "
        f"{N_TRAIN}, and {N_UNCERTAIN_TRAIN} of a vehicle with uncertain numbers",
        rule="whole number; 1 to 1e8",
    )
    n_test: int | str = setting(
        4_000, "Number of test curves, or all", rule="whole number; 1 to 1e8"
    )
    n_calibrate: int | None = setting(
        30_000,
        "Number of fresh curves that intervals and thresholds are learnt from; null gives the "
        "model neither",
        low=LEAST_CALIBRATION,
        most=MOST_CURVES,
    )

    def counted(self, uncertain: bool) -> Self:
        """Return the settings with `n_train` filled in, for a vehicle with `uncertain` numbers."""
        usual = N_UNCERTAIN_TRAIN if uncertain else N_TRAIN
        return self if self.n_train is not None else replace(self, n_train=usual)

    def check(self) -> None:
        """Raise TypeError or ValueError unless the settings of an observation are valid."""
        for name in ("n_train", "n_test"):
            value = getattr(self, name)
            if value != "all" and not (value is None and name == "n_train"):
                check_number(f"data.{name}", value, low=1, most=MOST_CURVES, whole=True)
        check_settings(self, "data")


@dataclass(frozen=True)
class Directions:
    """A few standard normal coordinates that replace all the uncertain numbers.

    `factor` (n_names, n) is the change of the logarithms of the distribution's numbers for a
    coordinate of 1; `strongest` is the rms effect of the strongest direction, in standard
    deviations of the noise.
    """

    generator: ResponseGenerator
    factor: Tensor
    strongest: float = 0.0

    @property
    def n(self) -> int:
        """Number of directions."""
        return self.factor.shape[1]

    def vehicles(self, ratios: Tensor, coordinates: Tensor) -> Tensor:
        """Return ratios with the columns of the uncertain numbers added, if there are any.

        `ratios`: (n_vehicles, n_columns); `coordinates`: (n_vehicles, n), 0 is the median.
        """
        distribution = self.generator.distribution
        if not self.n or distribution is None:
            return ratios
        mean = torch.tensor(distribution.mean, dtype=torch.float64).to(coordinates)
        exponentials = (mean + coordinates @ self.factor.to(coordinates).T).exp()
        offsets = torch.as_tensor(distribution.offsets).to(coordinates)
        return self.generator.with_uncertain(ratios, exponentials - offsets)


def every_direction(generator: ResponseGenerator) -> Directions:
    """Return directions that span all uncertain numbers of a generator."""
    distribution = generator.distribution
    if distribution is None or not distribution.names:
        return Directions(generator, torch.zeros(0, 0, dtype=torch.float64))
    return Directions(generator, torch.as_tensor(distribution.factor.copy()))


def directions(observer: Observer) -> Directions:
    """Return the directions of the uncertain numbers that affect an observer's curves."""
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
    return Directions(every.generator, factor, float(effects[-1]))


def _jacobian(observer: Observer, every: Directions, ratios: Tensor, standard: Tensor) -> Tensor:
    """Return the derivative of the misfit with respect to z, (n, n_names, n_points)."""
    rows = torch.arange(len(ratios))
    vehicles = every.vehicles(ratios, standard)
    misfit = observer.misfit(observer.noise_free(vehicles), vehicles)
    columns = []
    for step in STEP * torch.eye(every.n, dtype=standard.dtype):
        above, below = (every.vehicles(ratios, standard + way * step) for way in (1, -1))
        columns.append(misfit(above, rows) - misfit(below, rows))
    return torch.stack(columns, dim=1) / (2 * STEP)
