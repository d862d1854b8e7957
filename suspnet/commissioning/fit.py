"""The most probable vehicle behind healthy trips, and what they leave uncertain.

With z the standard normal coordinates of the prior (logarithms of numbers = mean + F z), m_i the
logarithm of the car-body mass on trip i and u_g(z, m_i) the whitened misfit of group g, one trip at
one speed (`EstimateMisfit`), the most probable vehicle has the least::

    sum_g |u_g|^2 + |z|^2 + sum_i ((m_i - mean) / deviation)^2

A Gauss-Newton search from the nominal vehicle would end in a valley far off: noise may be a
thousandth of the curves. So the model is first allowed errors of 30 %, then of ever less. The
inverse of J^T J at the end, without the rows of the masses, is the posterior covariance of z. Where
a misfit is left beyond the noise, the noise is taken to be as much larger.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from scipy.optimize import OptimizeResult, least_squares
from torch import Tensor

from suspnet.commissioning.healthy import HealthySpectra
from suspnet.data.directions import every_direction
from suspnet.data.estimates import EstimateSettings
from suspnet.dynamics import PARAMETERS, VerticalVehicle
from suspnet.dynamics.distribution import LogNormal
from suspnet.types import ComplexArray, FloatArray
from suspnet.uncertainty.physics import Residual

MASS_MEAN, MASS_DEVIATION = math.log(1.05), 0.15
"""Prior of the logarithm of the car-body mass over nominal on a trip."""
SPREADS = (0.3, 0.1, 0.03, 0.01, 0.0)
"""Rms errors of the model allowed for beside the noise, one search after the other."""
FEW, MANY = 12, 100
"""Evaluations of each of these searches, and of the last one, which may follow a curved valley:
a damper and its bushing can stand in for each other."""
ROUGH_TOL, TOL = 1e-3, 1e-6
"""Relative change of the sum of squares at which they end."""
STEP = 1e-5
"""Step of differences, in standard deviations of the prior."""
OFF = {"healthy_k_p": 0.2, "healthy_c_p": 0.4, "healthy_k_s": 0.2, "healthy_c_s": 0.4}
"""Shares by which further starts lie off the prior's median."""
SCAN = {
    "half_wheelbase": tuple(np.arange(-3, 3.5, 0.5).tolist()),
    "half_pivot_distance": (-2.0, -1.0, 0.0, 1.0, 2.0),
}
"""Deviations of the prior off its median at which a start may lie. Both lengths move notches of the
responses along frequency: from a notch elsewhere no search leads back."""
N_DRAWS, SEED = 400, 12
"""Vehicles drawn from the prior as further starts, and the seed."""
N_STARTS = 4
AGREEMENT = 0.25
"""Two starts found the same vehicle if no number differs by more than this many deviations of the
posterior, of which the weakest told numbers have one of the prior."""
Z_BOUND = 8.0
"""Standard deviations of the prior within which coordinates stay."""


@dataclass(frozen=True)
class Commissioned:
    """The vehicle that healthy trips show.

    Attributes
    ----------
    generator : VerticalVehicle
        With the posterior as its distribution.
    prior, posterior : LogNormal
        Of the same names.
    masses : array of shape (n_trips,), [-]
        Car-body mass over nominal on each trip.
    misfit : float
        Rms of what is left over that of the noise: 1 if all is explained.
    misfits : tuple of float
        That of each group.
    frequencies_hz : array of shape (n_freq,), [Hz]
    observed, nominal, fitted : complex arrays of shape (n_groups, 2, n_freq), [-]
        G_p and G_s as measured, of the nominal and of the commissioned vehicle.
    deviations : array of shape (n_groups, 2, n_freq), [-]
        Of the measured log-magnitudes; infinite where a bin tells nothing.
    n_agree, n_starts : int
        Searches that found this vehicle, of how many.
    converged : bool
    """

    generator: VerticalVehicle
    prior: LogNormal
    posterior: LogNormal
    masses: FloatArray
    misfit: float
    misfits: tuple[float, ...]
    frequencies_hz: FloatArray
    observed: ComplexArray
    nominal: ComplexArray
    fitted: ComplexArray
    deviations: FloatArray
    n_agree: int
    n_starts: int
    converged: bool

    @property
    def residual(self) -> Residual:
        """What the vehicle leaves unexplained, averaged over the groups."""
        return Residual.of(self.misfit, self.observed, self.fitted, self.deviations)


def commission(
    generator: VerticalVehicle,
    settings: EstimateSettings,
    groups: Sequence[HealthySpectra],
    *,
    n_starts: int = N_STARTS,
) -> Commissioned:
    """Return the most probable vehicle behind healthy trips.

    Parameters
    ----------
    generator : VerticalVehicle
        With the prior as its distribution.
    settings : EstimateSettings
        Bound to the vehicle: bins, window and estimator.
    groups : sequence of HealthySpectra
    n_starts : int
        Searches beyond the first stage. They are the best of twice as many: from springs and
        dampers nominal and off by ``OFF``, and from the likeliest of ``N_DRAWS`` of the prior.

    Raises
    ------
    ValueError
        If nothing is uncertain.
    """
    if generator.distribution is None or not generator.distribution.names:
        raise ValueError("nothing of the vehicle is uncertain: there is nothing to commission")
    target = _Target(generator, settings, groups)
    points = [*target.starts(n_starts), *target.draws(n_starts)]
    first = sorted((target.search(start, SPREADS[:1]) for start in points), key=lambda f: f.cost)
    rough = [target.search(found.x, SPREADS[1:-1]) for found in first[:n_starts]]
    order = np.argsort([found.cost for found in rough], kind="stable")
    best = target.search(rough[order[0]].x, SPREADS[-1:])
    posterior, mean_square = target.posterior(best)
    others = [target.search(rough[i].x, SPREADS[-1:]) for i in order[1:]]
    agree = [target.distance(best.x, other.x, posterior) < AGREEMENT for other in others]
    n = len(target.prior.names)
    theta = torch.as_tensor(best.x)[None]
    observed, fitted, deviations = target.curves(theta)
    plain = replace(generator, distribution=None)
    nominal = _Target(plain, settings, groups).curves(theta[:, n:])[1]
    return Commissioned(
        generator=replace(generator, distribution=posterior),
        prior=target.prior,
        posterior=posterior,
        masses=np.exp(best.x[n:]),
        misfit=math.sqrt(mean_square),
        misfits=tuple(target.misfits(theta)),
        frequencies_hz=settings.frequencies_hz().numpy(),
        observed=observed,
        nominal=nominal,
        fitted=fitted,
        deviations=deviations,
        n_agree=1 + sum(agree),
        n_starts=n_starts,
        converged=bool(best.status > 0),
    )


class _Target:
    """The sum of squares of healthy trips, as a function of theta = (z, logarithms of masses)."""

    def __init__(
        self,
        generator: VerticalVehicle,
        settings: EstimateSettings,
        groups: Sequence[HealthySpectra],
    ) -> None:
        self.prior = generator.distribution or LogNormal((), (), ())
        self._trips = [group.trip for group in groups]
        self.n_trips = 1 + max(self._trips)
        self._every = every_direction(generator)
        observer = settings.observer(generator)
        self._groups = [
            observer.at(group.speeds).measured_misfit(group.spectra) for group in groups
        ]

    def ratios(self, theta: Tensor, trip: int) -> Tensor:
        """Return all columns of ratios of one trip, (n_rows, n_columns)."""
        n = len(self.prior.names)
        healthy = torch.ones(len(theta), len(PARAMETERS), dtype=torch.float64)
        healthy[:, -1] = theta[:, n + trip].exp()
        return self._every.vehicles(healthy, theta[:, :n])

    def part(self, theta: Tensor, group: int, spread: float) -> Tensor:
        """Return the residuals of one group, (n_rows, n_points)."""
        misfit = self._groups[group]
        expected = misfit.observer.noise_free(self.ratios(theta, self._trips[group]))
        # logarithms lead from far off, but have the tails of a ratio of noise
        u = (misfit.observed / expected).log() if spread else 1 - expected / misfit.observed
        return misfit.whitened(u, torch.zeros(len(theta), dtype=torch.int64), spread)

    def parts(self, theta: Tensor, spread: float) -> list[Tensor]:
        """Return the residuals of each group, (n_rows, n_points)."""
        return [self.part(theta, i, spread) for i in range(len(self._groups))]

    def residuals(self, theta: Tensor, spread: float) -> Tensor:
        """Return all residuals with those of the priors, (n_rows, n_points)."""
        n = len(self.prior.names)
        masses = (theta[:, n:] - MASS_MEAN) / MASS_DEVIATION
        return torch.cat([*self.parts(theta, spread), theta[:, :n], masses], dim=1)

    def starts(self, n_starts: int) -> list[FloatArray]:
        """Return points with springs and dampers off the prior's median, each of the best ``SCAN``.

        The first one's springs and dampers are the median.
        """
        names, factor = self.prior.names, self._every.factor.numpy()
        grid = np.array(list(product(*(SCAN.get(name, (0.0,)) for name in names))))
        starts = []
        for i in range(n_starts):
            # both up, both down, springs up and dampers down
            spring, damper = ((0, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))[i % 5]
            logs = [
                math.log1p(OFF.get(name, 0.0) * (spring if "_k_" in name else damper))
                for name in names
            ]
            z = np.linalg.lstsq(factor, (logs + grid * self.prior.deviations).T, rcond=None)[0].T
            theta = np.hstack([z, np.full((len(z), self.n_trips), MASS_MEAN)])
            starts.append(theta[int(self.costs(theta).argmin())])
        return starts

    def draws(self, n_starts: int) -> list[FloatArray]:
        """Return the points of least cost among draws from the prior."""
        n = len(self.prior.names)
        z = np.random.default_rng(SEED).standard_normal((N_DRAWS, n))
        theta = np.hstack([z, np.full((N_DRAWS, self.n_trips), MASS_MEAN)])
        costs = self.costs(theta)
        return list(theta[np.argsort(costs, kind="stable")[:n_starts]])

    def costs(self, theta: FloatArray) -> FloatArray:
        """Return the sums of squares of points at the first search's spread, (n_rows,)."""
        blocks = torch.as_tensor(theta).split(64)
        found = [self.residuals(block, SPREADS[0]).square().sum(dim=1) for block in blocks]
        return np.asarray(torch.cat(found).numpy())

    def search(self, start: FloatArray, spreads: Sequence[float]) -> OptimizeResult:
        """Return the result of the searches with some spreads, one after the other."""
        found = OptimizeResult(x=start)
        for spread in spreads:
            last = spread == 0
            found = least_squares(
                lambda x, spread=spread: self.residuals(_row(x), spread)[0].numpy(),
                np.clip(found.x, -0.99 * Z_BOUND, 0.99 * Z_BOUND),
                jac=lambda x, spread=spread: self.jacobian(x, spread),
                bounds=(-Z_BOUND, Z_BOUND),
                ftol=TOL if last else ROUGH_TOL,
                xtol=TOL,
                gtol=None,
                max_nfev=MANY if last else FEW,
            )
        return found

    def jacobian(self, x: FloatArray, spread: float) -> FloatArray:
        """Return the derivative of all residuals, (n_points, n_coordinates), by differences."""
        n, found = len(self.prior.names), []
        for group, trip in enumerate(self._trips):
            # the masses of other trips move nothing
            columns = [*range(n), n + trip]
            steps = STEP * torch.eye(len(x), dtype=torch.float64)[[0, *columns]]
            steps[0] = 0.0
            rows = self.part(_row(x) + steps, group, spread)
            own = np.zeros((rows.shape[1], len(x)))
            own[:, columns] = ((rows[1:] - rows[:1]) / STEP).T.numpy()
            found.append(own)
        return np.concatenate([*found, np.diag(1 / self._prior_deviations())])

    def _prior_deviations(self) -> FloatArray:
        """Return the standard deviations of theta before any trip, (n_coordinates,)."""
        return np.array([1.0] * len(self.prior.names) + [MASS_DEVIATION] * self.n_trips)

    def misfits(self, theta: Tensor) -> list[float]:
        """Return the rms residual of each group over that of the noise."""
        return [
            math.sqrt(float(part.square().mean()) / misfit.expected)
            for part, misfit in zip(self.parts(theta, 0.0), self._groups, strict=True)
        ]

    def posterior(self, found: OptimizeResult) -> tuple[LogNormal, float]:
        """Return the posterior of the numbers, and the mean square of what is left."""
        n = len(self.prior.names)
        residuals = torch.cat(self.parts(_row(found.x), 0.0), dim=1)[0]
        expected = math.fsum(misfit.expected for misfit in self._groups) / len(self._groups)
        mean_square = float(residuals.square().mean()) / expected
        told = self.jacobian(found.x, 0.0)[: len(residuals)]
        prior = np.diag(self._prior_deviations() ** -2)
        information = told.T @ told / max(mean_square, 1.0) + prior
        spread = np.linalg.inv(information)[:n, :n]
        factor = self._every.factor.numpy()
        covariance = factor @ spread @ factor.T
        logs = np.array(self.prior.mean) + factor @ found.x[:n]
        rows = tuple(map(tuple, ((covariance + covariance.T) / 2).tolist()))
        return LogNormal(self.prior.names, tuple(logs.tolist()), rows), mean_square

    def distance(self, one: FloatArray, other: FloatArray, posterior: LogNormal) -> float:
        """Return the largest difference of a number, in deviations of the posterior."""
        n = len(self.prior.names)
        logs = self._every.factor.numpy() @ (one[:n] - other[:n])
        return float(np.abs(logs / posterior.deviations).max())

    def curves(self, theta: Tensor) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """Return measured and fitted responses and the deviations, each (n_groups, 2, n_freq)."""
        pairs = list(zip(self._groups, self._trips, strict=True))
        fitted = [misfit.observer.noise_free(self.ratios(theta, trip)) for misfit, trip in pairs]
        observed = torch.cat([misfit.observed for misfit, _ in pairs])
        power = torch.cat([m.covariance.diagonal(dim1=1, dim2=2).mT.real for m, _ in pairs])
        return observed.numpy(), torch.cat(fitted).numpy(), (power / 2).sqrt().numpy()


def _row(x: FloatArray) -> Tensor:
    """Return one point as a tensor of one row."""
    return torch.as_tensor(x)[None]
