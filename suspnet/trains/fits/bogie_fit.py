"""Each spring and damper of a bogie from the spectral matrices of its sensors.

A vehicle's uncertain numbers z, with the prior of its distribution, are fitted to healthy trips, of
which each has its own car-body mass; then the twelve parts and the mass of a later trip, with z
under the posterior of the healthy trips. Both minimise the sum of squares of ::

    the residuals of `trains.spectra.subspace`, F^-1 (log z - mean), (log M_s - log m) / 0.15
    and, of a later trip, (log part) / WEAR

with F F^T the covariance of log z, and m 1.05 for the healthy trips, their masses' geometric mean
for later ones. The noise of each trip, what excites each wheelset alone and what bins leak are
those that its spectra show with the vehicle as found so far (`trains.spectra.noise_subspace`).
`suspnet.trains.fits.bogie_search` finds the minimum. A part's interval is that of the posterior
there, times ``COMMON``: what healthy trips leave open is one draw for all later ones. The
information J^T J of n residuals is divided by that of the misfit mu, the rms residual over that of
the noise::

    max(1, mu)^2 + ALIGNED^2 n max(0, mu^2 - EXPLAINED^2)

as errors of the physics do not average out over the residuals like noise: a fraction of them acts
like a change of a part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.stats import norm

from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.intervals import COMMON
from suspnet.estimation.temperature import (
    SLOPE_DEVIATION,
    USUAL_SLOPE,
    DampingByTemperature,
    kelvins_warmer,
)
from suspnet.estimation.trip_settings import LEAST_TRIPS
from suspnet.ground.parameters import COMPONENTS, PARAMETERS
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.trains.fits.bogie_misfit import EQUAL, SEPARATE, BogieMisfit
from suspnet.trains.fits.bogie_search import NEARLY_EXPLAINED, best_end, narrowed, nearer_start
from suspnet.trains.spectra.bogie_trip import BogieTrip, smallest_noise
from suspnet.vehicle import SpatialVehicle
from suspnet.vehicle.quantities import LogNormal

EXPLAINED = 1.15
"""Misfit up to which a bogie is explained: plain trips of five minutes have up to 1.08."""
FURTHER_PARTS = (
    ("second_bending", "body_torsion", "equipment", "floors"),
    ("track", "cross_axis"),
)
"""What a vehicle is given that does not explain its healthy trips: flexible modes of its body and
what hangs on it; then a track that gives way, and sensors that read a share of the lateral motion.
All at once end in a worse valley: c_p of the modes alone was 2.8 % off, with all 6.9 %
(benchmarks/rough_train.py, flexible modes, seed 0)."""
FURTHER_FROM = 1.3
"""Misfit above which it is given these: a search with them takes three to ten times as long."""
ALIGNED = 0.15
"""Fraction of unexplained residuals that acts like a change of a part. Found on two trains of
tests/blind_train.py (seeds 0 and 1, misfits of 1.7 to 6.9, 128 trips with one worn part of twelve
each at most): intervals without it held 45 to 57 % at a misfit of 2, and 15 to 40 % at 6."""


@dataclass(frozen=True, repr=False)
class PartsEstimate(ShortRepr):
    """The ratio to healthy of each of `names`, M_s to nominal.

    `covariance` (n_names, n_names) is that of their logarithms.
    """

    values: FloatArray
    covariance: FloatArray
    misfit: float
    converged: bool
    level: float
    names: tuple[str, ...] = COMPONENTS

    @property
    def deviations(self) -> FloatArray:
        """Standard deviation of each logarithm, (n_names,), [-]."""
        return np.sqrt(np.diag(self.covariance))

    def as_estimate(self) -> Estimate:
        """Return the estimate as one row, with intervals of the level."""
        half = norm.ppf((1 + self.level) / 2) * self.deviations
        rows = self.values[None], (self.values * np.exp(-half))[None]
        high = (self.values * np.exp(half))[None]
        return Estimate(self.names, *rows, high, self.level, Flags.none(1))


def fit_parts(
    bogie: CommissionedBogie,
    trip: BogieTrip,
    level: float = 0.9,
    start: FloatArray | None = None,
    *,
    equal: bool = False,
) -> PartsEstimate:
    """Return the ratio to healthy of every part on a later trip; `equal`: of every kind.

    `start` (13,) are ratios near it, such as those of an earlier trip: the search starts there,
    or from the healthy vehicle where that is nearer. If it does not explain the trip, it starts
    from the healthy vehicle in bands that widen. ValueError if the trip has another number of
    sensors.
    """
    assert bogie.generator.sensors is not None
    noise = bogie.noise[trip.kept(bogie.generator.sensors)]
    # far from the healthy trips' mass, as by a wrong one on the drawing, valleys differ
    mass = float(np.exp(np.log(bogie.masses).mean()))
    ties = EQUAL if equal else SEPARATE
    fit = BogieMisfit(bogie.generator, [noise], [trip], are_healthy=False, mass=mass, ties=ties)
    explained = EXPLAINED * max(1.0, bogie.misfit)
    near, first = (fit.start(), 0) if start is None else (nearer_start(fit, start), 2)
    end = narrowed(fit, near, first).finished(NEARLY_EXPLAINED * explained)
    if not end.explains(explained):
        end = min(end, best_end(fit, explained), key=lambda end: end.misfit)
    fit, x, misfit = end.fit, end.x, end.misfit
    unexplained = max(0.0, max(misfit, bogie.misfit) ** 2 - EXPLAINED**2)
    excess = max(1.0, misfit) ** 2 + ALIGNED**2 * fit.exact.n_independent * unexplained
    own = slice(fit.n_shared, None)
    covariance = COMMON**2 * fit.covariance(x, excess)[own, own]
    names = PARAMETERS if equal else COMPONENTS
    return PartsEstimate(np.exp(x[own]), covariance, misfit, end.converged, level, names)


def healthy_misfit(
    generator: SpatialVehicle, trips: Sequence[BogieTrip], warmer: Sequence[float] = ()
) -> BogieMisfit:
    """Return the sum of squares of healthy trips, the prior the vehicle's distribution.

    `warmer` is as of `BogieMisfit`.
    """
    assert generator.distribution is not None
    # the free spectra hold the densities of cross level and alignment
    prior = generator.distribution.without(("cross_level", "alignment"))
    noise = torch.stack([smallest_noise(trip.spectra) for trip in trips]).amin(dim=0)
    vehicle = replace(generator, distribution=prior)
    return BogieMisfit(vehicle, [noise] * len(trips), trips, are_healthy=True, warmer=warmer)


def commission_bogie(
    generator: SpatialVehicle,
    trips: Sequence[BogieTrip],
    temperatures_c: Sequence[float | None] | None = None,
) -> CommissionedBogie:
    """Return the most probable vehicle given healthy trips.

    Parameters
    ----------
    generator : SpatialVehicle
        With the prior as its distribution, and the sensors of the trips.
    trips : sequence of BogieTrip
        At least three, on the same bins.
    temperatures_c : sequence of float or None, optional, [°C]
        Of each trip, None if unknown.

    Raises
    ------
    ValueError
        If nothing of the vehicle is uncertain, there are fewer than three trips, they have other
        sensors or bins, or one has lost a sensor.
    """
    if generator.distribution is None or not generator.distribution.names:
        raise ValueError("nothing of the vehicle is uncertain: there is nothing to commission")
    if len(trips) < LEAST_TRIPS:
        raise ValueError(f"{len(trips)} healthy trips are given, at least {LEAST_TRIPS} are needed")
    if lost := sorted({name for trip in trips for name in trip.lost}):
        raise ValueError(f"healthy trips need all sensors, one has none at {', '.join(lost)}")
    healthy_c, warmer = kelvins_warmer(temperatures_c or [None] * len(trips))
    fit = healthy_misfit(generator, trips, warmer if any(warmer) else ())
    generator, prior = fit.generator, fit.numbers
    end = best_end(fit, EXPLAINED)
    fit, x, misfit, n, shared = end.fit, end.x, end.misfit, fit.n_numbers, fit.n_shared
    covariance = fit.covariance(x, max(1.0, misfit) ** 2)
    factor = prior.factor
    spread_of = factor @ covariance[:n, :n] @ factor.T
    logs = np.array(prior.mean) + factor @ x[:n]
    rows = tuple(map(tuple, ((spread_of + spread_of.T) / 2).tolist()))
    posterior = LogNormal(prior.names, tuple(logs.tolist()), rows)
    return CommissionedBogie(
        replace(generator, distribution=posterior),
        torch.stack([noise.densities for noise in fit.noise_at(x)]).mean(dim=0),
        np.exp(x[shared:]),
        misfit,
        end.converged,
        _law(healthy_c, x[n:shared], covariance[n:shared, n:shared]),
    )


def with_further_parts(
    bogie: CommissionedBogie,
    generator: SpatialVehicle,
    trips: Sequence[BogieTrip],
    temperatures_c: Sequence[float | None] | None = None,
) -> CommissionedBogie:
    """Return the bogie with ``FURTHER_PARTS`` if the trips are not explained, and are so better.

    `bogie` is that of `commission_bogie` for the other arguments; up to a misfit of
    ``FURTHER_FROM`` it stays.
    """
    for parts in FURTHER_PARTS:
        if bogie.misfit <= FURTHER_FROM:
            break
        generator = generator.with_parts(parts)
        richer = commission_bogie(generator, trips, temperatures_c)
        bogie = min(bogie, richer, key=lambda bogie: bogie.misfit)
    return bogie


def _law(
    healthy_c: float | None, slopes: FloatArray, covariance: FloatArray
) -> DampingByTemperature | None:
    """Return the law of slopes in deviations from their prior; of none: the prior's."""
    if healthy_c is None or not len(slopes):
        return None if healthy_c is None else DampingByTemperature(healthy_c)
    deviations = SLOPE_DEVIATION * np.sqrt(np.diag(covariance))
    means = USUAL_SLOPE + SLOPE_DEVIATION * slopes
    return DampingByTemperature(healthy_c, tuple(means.tolist()), tuple(deviations.tolist()))
