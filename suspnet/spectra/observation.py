"""Interfaces of an observation of curves, and the directions of uncertain numbers that curves show.

An observation is a pair of classes: settings, which hold the numbers of a YAML file, and the
observer that they make of a generator. `curves` is the paper's (magnitudes with white noise),
`estimates` that of trips (transfer functions estimated from recordings).

Directions: with F the factor of the log-normal distribution of a generator's uncertain numbers,
their logarithms (of those that may be absent: of 1 + number) are mean + F z, z standard normal.
Many directions of z leave the curves as they are. With J the derivative of the curves in units of
their noise, the eigenvectors of the mean of J^T J over vehicles (the active subspace; Constantine,
Active subspaces, 2015) are directions of ever less effect, whose rms is the root of the eigenvalue.
Those of next to no effect stay at the median.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from suspnet.dynamics import PARAMETERS, ResponseGenerator, Vehicle
from suspnet.ground.checks import check_number

LEAST_CALIBRATION = 100
"""Least number of calibration curves; the coverage of a 90 % interval then scatters by 3 %."""

MOST_CURVES = 100_000_000
"""Largest number of curves; their parameters alone then fill 4 GB."""
LEAST_EFFECT = 0.1
"""Rms effect of a direction that counts, in standard deviations of the noise; each one left out
widens a parameter's deviation by about 0.5 % at most."""
N_VEHICLES = 24
"""Vehicles over which the effect is averaged."""
FURTHEST = 2.0
"""Their parameters lie within this factor of healthy."""
STEP = 1e-4
"""Step of the central differences, in standard deviations of the numbers."""


class Misfit(Protocol):
    """Residuals of observed curves in units of their noise.

    Their sum of squares is -2 log likelihood; with J the derivative, J^T J is the Fisher
    information.

    Attributes
    ----------
    observed : tensor of shape (n_rows, 2, n_freq), [-]
    expected : float
        Mean square of a residual if the model is true.
    """

    @property
    def observed(self) -> Tensor: ...  # noqa: D102

    @property
    def expected(self) -> float: ...  # noqa: D102

    def __call__(self, ratios: Tensor, rows: Tensor) -> Tensor:
        """Return residuals (n, n_points) of the vehicles `ratios` (n, 5) to the curves `rows`."""
        ...


class Observer(Protocol):
    """Makes curves of vehicles as they would be observed.

    Attributes
    ----------
    settings : Observation
    generator : ResponseGenerator
    frequencies_hz : tensor of shape (n_freq,), [Hz]
    directions : Directions
        Of the generator's uncertain numbers, which its curves show.
    """

    @property
    def settings(self) -> Any: ...  # noqa: D102

    @property
    def generator(self) -> ResponseGenerator: ...  # noqa: D102

    @property
    def frequencies_hz(self) -> Tensor: ...  # noqa: D102

    @property
    def directions(self) -> Directions: ...  # noqa: D102

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return curves without noise, shape (n_vehicles, 2, n_freq)."""
        ...

    def observe(self, ratios: Tensor, seed: int) -> Tensor:
        """Return noisy curves; the generator's uncertain quantities are drawn too."""
        ...

    def for_features(self, curves: Tensor) -> Tensor:
        """Return curves (n_curves, 2, n_freq) as the feature set is to see them."""
        ...

    def misfit(self, curves: Tensor, near: Tensor, used: Sequence[int] = (0, 1)) -> Misfit:
        """Return the misfit of observed curves.

        Parameters
        ----------
        curves : tensor of shape (n_curves, 2, n_freq), [-]
        near : tensor of shape (n_curves, 5), [-]
            Ratios of vehicles whose noise is like that of the curves.
        used : sequence of int
            Which of G_p (0) and G_s (1) are used.
        """
        ...


class Observation(Protocol):
    """Settings of an observation, as in a file of configs/data.

    Attributes
    ----------
    kind : str
        Names the observation in model files.
    n_train, n_test : int or "all"
        Curves for training and testing; "all" is the whole grid of the protocol.
    n_calibrate : int or None
        Fresh curves from which intervals and thresholds are learnt; None gives the model neither.
    snr_db : float, [dB]
    low_hz, high_hz : float or None, [Hz]
        Band.
    cache_dir : str or None
        Where feature tables are stored between runs; None stores none.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]
    kind: ClassVar[str]

    @property
    def n_train(self) -> int | str: ...  # noqa: D102

    @property
    def n_test(self) -> int | str: ...  # noqa: D102

    @property
    def n_calibrate(self) -> int | None: ...  # noqa: D102

    @property
    def snr_db(self) -> float: ...  # noqa: D102

    @property
    def low_hz(self) -> float | None: ...  # noqa: D102

    @property
    def high_hz(self) -> float | None: ...  # noqa: D102

    @property
    def cache_dir(self) -> str | None: ...  # noqa: D102

    def bound(self, vehicle: Vehicle) -> Self:
        """Return the settings for a vehicle, with the values that follow from it filled in."""
        ...

    def frequencies_hz(self) -> Tensor:
        """Return the frequency bins, shape (n_freq,), [Hz]."""
        ...

    def observer(self, generator: ResponseGenerator) -> Observer:
        """Return the observer of a generator's vehicles."""
        ...

    def words(self) -> str:
        """Return a text on what is observed, with which noise."""
        ...


def check_counts(settings: Observation) -> None:
    """Raise TypeError or ValueError unless every number of curves is one."""
    for name in ("n_train", "n_test"):
        value = getattr(settings, name)
        if value != "all":
            check_number(f"data.{name}", value, low=1, most=MOST_CURVES, whole=True)
    check_number(
        "data.n_calibrate",
        settings.n_calibrate,
        low=LEAST_CALIBRATION,
        most=MOST_CURVES,
        whole=True,
        optional=True,
    )


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
