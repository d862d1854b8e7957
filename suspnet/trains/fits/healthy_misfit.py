"""The sum of squares of healthy trips, as a function of the vehicle's numbers.

Its symbols are those of `suspnet.trains.fits.vehicle_search`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.curves.curves import every_direction
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.expected_spectra import EstimateMisfit
from suspnet.curves.speeds import Speeds
from suspnet.estimation.damping_laws import DampingNumbers, Laws
from suspnet.estimation.relative_velocity import CHANGING, relative_velocities
from suspnet.ground.parameters import FORWARD, Direction
from suspnet.ground.tensors import complex_log
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.learning.least_squares import ONE_SIDED_DIFFERENCE
from suspnet.vehicle import PARAMETERS, VerticalVehicle
from suspnet.vehicle.quantities import MASS_DEVIATION, MASS_MEAN, UNMEASURED, LogNormal

_COLUMNS = (*PARAMETERS, *UNMEASURED)
_CHANGING = [_COLUMNS.index(bogie + name) for bogie in ("", "other_") for name in CHANGING]
"""Columns of what depends on temperature or velocity, of the measured and of the other bogie."""
ROUGH = 0.01
"""Least allowed model error of a search on thinned bins, without leakage."""


@dataclass(frozen=True)
class HealthySpectra:
    """Spectra (3, n_freq) at one speed of trip number `trip`: one car-body mass, one direction.

    `left_out` (n_freq,) are bins with lines of out-of-round wheels; `temperature_c` [°C] is that of
    the trip, None if unknown.
    """

    trip: int
    name: str
    speeds: Speeds
    spectra: CrossSpectra
    direction: Direction = FORWARD
    left_out: Tensor | None = None
    temperature_c: float | None = None

    @property
    def speed_m_per_s(self) -> float:
        """Mean speed, [m/s]."""
        return self.speeds.mean


class HealthyMisfit:
    """The sum of squares of healthy trips, as a function of theta.

    theta = (z, logarithms of masses), followed, where trips differ in temperature, by the slopes of
    damping over temperature (`suspnet.estimation.temperature`), and where they differ in relative
    velocity, by friction and blow-off (`suspnet.estimation.relative_velocity`), in deviations from
    their priors.
    """

    def __init__(
        self,
        generator: VerticalVehicle,
        settings: EstimateSettings,
        groups: Sequence[HealthySpectra],
    ) -> None:
        self.prior = generator.distribution or LogNormal((), (), ())
        self._generator = generator
        self._trips = [group.trip for group in groups]
        self.n_trips = 1 + max(self._trips)
        self.frequencies_hz = settings.frequencies_hz()
        given = {group.trip: group.temperature_c for group in groups}
        self._of_damping = DampingNumbers(
            generator.vehicle,
            [given.get(i) for i in range(self.n_trips)],
            np.array([relative_velocities(one.spectra, self.frequencies_hz) for one in groups]),
            self._trips,
        )
        self.n_of_damping = len(self._of_damping)
        self.every = every_direction(generator)
        observers = {
            direction: settings.observer(generator.running(direction))
            for direction in {group.direction for group in groups}
        }
        self._groups = [
            observers[group.direction]
            .at(group.speeds)
            .without(group.left_out)
            .measured_misfit(group.spectra)
            for group in groups
        ]
        self._thinned = [misfit.thinned() for misfit in self._groups]
        # groups at the same speeds and direction share a call of the observer
        conditions = [(group.direction, group.speeds) for group in groups]
        self._alike = [
            [i for i, other in enumerate(conditions) if other == one]
            for one in dict.fromkeys(conditions)
        ]

    def ratios(self, theta: Tensor, group: int) -> Tensor:
        """Return all columns of ratios for the trip of one group, (n_rows, n_columns)."""
        n = len(self.prior.names)
        healthy = torch.ones(len(theta), len(PARAMETERS), dtype=torch.float64)
        healthy[:, -1] = theta[:, n + self._trips[group]].exp()
        rows = self.every.vehicles(healthy, theta[:, :n])
        if self.n_of_damping:
            rows = self._generator.complete(rows)  # both bogies are alike
            own = theta[:, -self.n_of_damping :]
            rows[:, _CHANGING] *= self._of_damping.factors(own, group).repeat(1, 2)
        return rows

    @staticmethod
    def _compared(
        misfit: EstimateMisfit, expected: Tensor, spread: float, high_hz: float
    ) -> Tensor:
        """Return the residuals of a group whose curves are expected to be those.

        They are 0 above `high_hz`.
        """
        # logarithms converge from far off, but have the heavy tails of a ratio of noise
        ratio = misfit.observed / expected if spread else expected / misfit.observed
        u = complex_log(ratio) if spread else 1 - ratio
        spreads = torch.where(misfit.observer.frequencies_hz > high_hz, math.inf, spread)
        return misfit.whitened(u, torch.zeros(1, dtype=torch.int64), spreads)

    def parts(self, theta: Tensor, spread: float, high_hz: float = math.inf) -> list[Tensor]:
        """Return the residuals of each group, (n_rows, n_points)."""
        return self._each([theta] * len(self._trips), spread, high_hz)

    def _each(self, thetas: Sequence[Tensor], spread: float, high_hz: float) -> list[Tensor]:
        """Return the residuals of each group at points of its own, (n_rows, n_points)."""
        misfits = self._thinned if spread >= ROUGH else self._groups
        residuals: dict[int, Tensor] = {}
        # one call for all groups at the same speeds: a call for 1 row takes as long as for 10
        for alike in self._alike:
            rows = [self.ratios(thetas[group], group) for group in alike]
            expected = misfits[alike[0]].observer.noise_free(torch.cat(rows))
            for group, own in zip(alike, expected.split([*map(len, rows)]), strict=True):
                residuals[group] = self._compared(misfits[group], own, spread, high_hz)
        return [residuals[group] for group in range(len(misfits))]

    def residuals(self, theta: Tensor, spread: float, high_hz: float = math.inf) -> Tensor:
        """Return all residuals, including those of the priors, (n_rows, n_points)."""
        n = len(self.prior.names)
        masses = (theta[:, n : n + self.n_trips] - MASS_MEAN) / MASS_DEVIATION
        priors = theta[:, :n], masses, theta[:, n + self.n_trips :]
        return torch.cat([*self.parts(theta, spread, high_hz), *priors], dim=1)

    def jacobian(self, x: FloatArray, spread: float, high_hz: float = math.inf) -> FloatArray:
        """Return the finite-difference derivative of all residuals, (n_points, n_coordinates)."""
        return self.derivative(row_of(x), spread, high_hz)[0].T.numpy()

    def derivative(self, theta: Tensor, spread: float, high_hz: float = math.inf) -> Tensor:
        """Return the derivative as `jacobian` for one row, (1, n_coordinates, n_points)."""
        n = len(self.prior.names)
        steps = ONE_SIDED_DIFFERENCE * torch.eye(theta.shape[1], dtype=torch.float64)
        # the masses of other trips do not affect a group
        columns = [
            [*range(n), n + trip, *range(n + self.n_trips, theta.shape[1])] for trip in self._trips
        ]
        moved = [torch.cat([theta, theta + steps[own]]) for own in columns]
        found = []
        for own, rows in zip(columns, self._each(moved, spread, high_hz), strict=True):
            slopes = rows.new_zeros(theta.shape[1], rows.shape[1])
            slopes[own] = (rows[1:] - rows[:1]) / ONE_SIDED_DIFFERENCE
            found.append(slopes)
        priors = torch.as_tensor(1 / self._prior_deviations()).diag()
        return torch.cat([*found, priors], dim=1)[None]

    def _prior_deviations(self) -> FloatArray:
        """Return the prior standard deviations of theta, (n_coordinates,)."""
        masses = [MASS_DEVIATION] * self.n_trips
        return np.array([1.0] * len(self.prior.names) + masses + [1.0] * self.n_of_damping)

    def misfits(self, theta: Tensor) -> list[float]:
        """Return the rms residual of each group over that of the noise."""
        return [
            math.sqrt(float(part.square().mean()) / misfit.expected)
            for part, misfit in zip(self.parts(theta, 0.0), self._groups, strict=True)
        ]

    def posterior(self, x: FloatArray) -> tuple[LogNormal, Laws, float]:
        """Return the posterior of the numbers and the laws of damping.

        The last result is the mean square of the residuals over that of the noise.
        """
        n = len(self.prior.names)
        residuals = torch.cat(self.parts(row_of(x), 0.0), dim=1)[0]
        expected = math.fsum(misfit.expected for misfit in self._groups) / len(self._groups)
        mean_square = float(residuals.square().mean()) / expected
        slopes = self.jacobian(x, 0.0)[: len(residuals)]
        prior = np.diag(self._prior_deviations() ** -2)
        information = slopes.T @ slopes / max(mean_square, 1.0) + prior
        spread: FloatArray = np.linalg.inv(information).astype(np.float64)
        posterior = self.prior.moved(x[:n], spread[:n, :n])
        own = slice(len(x) - self.n_of_damping, None)
        laws = self._of_damping.laws(x[own], spread[own, own])
        return posterior, laws, mean_square

    def distance(self, x: FloatArray, other: FloatArray, posterior: LogNormal) -> float:
        """Return the largest difference of a number, in deviations of the posterior."""
        n = len(self.prior.names)
        logs = self.every.factor.numpy() @ (x[:n] - other[:n])
        return float(np.abs(logs / posterior.deviations).max())

    def curves(self, theta: Tensor) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """Return measured and fitted responses and deviations, each (n_groups, 2, n_freq)."""
        fitted = [
            misfit.observer.noise_free(self.ratios(theta, group))
            for group, misfit in enumerate(self._groups)
        ]
        observed = torch.cat([misfit.observed for misfit in self._groups])
        power = torch.cat([m.covariance.diagonal(dim1=1, dim2=2).mT.real for m in self._groups])
        return observed.numpy(), torch.cat(fitted).numpy(), (power / 2).sqrt().numpy()


def row_of(x: FloatArray) -> Tensor:
    """Return one point as a tensor of one row."""
    return torch.as_tensor(x)[None]
