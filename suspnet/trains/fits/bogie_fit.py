"""Each spring and damper of a bogie from the spectral matrices of its sensors.

A vehicle's uncertain numbers z, with the prior of its distribution, are fitted to healthy trips, of
which each has its own car-body mass; then the twelve parts and the mass of a later trip, with z
under the posterior of the healthy trips. Both minimise the sum of squares of ::

    the residuals of `trains.spectra.subspace`, F^-1 (log z - mean), (log M_s - log m) / 0.15
    and, of a later trip, (log part) / WEAR

with F F^T the covariance of log z, and m 1.05 for the healthy trips, their masses' geometric mean
for later ones. If the dampers are nonlinear, those of a kind differ by chance by a logarithm u of
each trip, on both bogies (on a later trip, on that which is not measured: the parts tell of the
other), with the residual u / ``DAMPING_OF_TRIP``. The noise of each trip, what excites each
wheelset alone and what bins leak are those that its spectra show with the vehicle as found so far
(`trains.spectra.noise_subspace`). `suspnet.trains.fits.bogie_search` finds the minimum.

What the vehicle does not explain of its healthy trips counts as errors of its responses
(`trains.spectra.model_errors`), and how their parts scatter if they are read as later ones is
measured (`healthy_scatter`). The covariance of a later trip's parts is ::

    max(1, mu)^2 C + tau^2 V + (1 - 1 / max(1, mu_0)^2) D

with C that of the posterior, mu the rms residual over that of noise and errors, V that of the
scatter and tau Student's quantile over the normal one, as few healthy trips tell little of V. D is
diagonal, the square of ``SENSITIVITY`` times the logarithm of the part, or times ``OF_OTHERS`` of
the largest one: a vehicle that leaves mu_0 > 1 of its healthy trips moves differently with wear,
too. With few sensors, or where all parts of a kind are read as one, ``SENSITIVITY_OF_FEW`` is in
its place and mu_0 at least ``MISFIT_OF_FEW``. Few sensors take wear of one part for that of
another, so that all of the largest one counts; where kinds are read, the mass is no better known
than before the trip if mu_0 is large. Verdicts leave out what is due to the wear of a part itself.
The variance of M_s has that of the bogie's mass, too, to which accelerations show it relative; it
does not count where trips are compared. The speed of each damper corrects its part by the law of
the suspension (`SuspensionLaw.beside`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.stats import norm

from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.suspension_law import SuspensionLaw, beyond_pairs
from suspnet.estimation.trip_settings import LEAST_TRIPS
from suspnet.ground.parameters import BOGIE_PARTS, COMPONENTS, DAMPERS, PARAMETERS, kind_of
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.trains.fits.bogie_misfit import EQUAL, SEPARATE, BogieMisfit
from suspnet.trains.fits.bogie_search import (
    NEARLY_EXPLAINED,
    best_end,
    healthy_end,
    narrowed,
    nearer_start,
)
from suspnet.trains.fits.healthy_scatter import healthy_scatter
from suspnet.trains.fits.posterior import bent, posterior_covariance
from suspnet.trains.spectra.bogie_trip import BogieTrip, smallest_noise
from suspnet.vehicle import SpatialVehicle
from suspnet.vehicle.quantities import BOGIE_MASS_DEVIATION, LEAST_SENSORS, MASS_DEVIATION

EXPLAINED = 1.15
"""Misfit up to which a bogie is explained: plain trips of five minutes have up to 1.08."""
SENSITIVITY = {"k_p": 0.005, "c_p": 0.05, "k_s": 0.005, "c_s": 0.05}
"""Error of a part, as a fraction of the logarithm of the wear found, with an incomplete vehicle,
from when the family knew fewer effects: set all of tests/rich_train.py, seeds 0 and 7, shows 0 of
k_p, c_p and k_s, and 0.04 of c_s where it is not corrected by the speed of its damper."""
SENSITIVITY_OF_FEW = {"k_p": 0.25, "c_p": 1.0, "k_s": 0.3, "c_s": 0.3}
"""The same of less than ``LEAST_SENSORS``, which hardly tell errors of the vehicle from its
numbers, and where all parts of a kind are read as one. By three on the left of set all, seeds 0 and
7, misfits 1.11 and 1.15, the rms errors were 8, 34, 12 and 12 % of the wear, noise included: this
is 2.5 to 3 times as much, by the factor of the misfit."""
OF_OTHERS = 0.5
"""Fraction of the largest wear that counts for other parts. With 0.5 for few sensors, too, 3 of 180
trips accused another part, the spring across; with 1, one did, and 65 in place of 71 of 144 worn
parts were named (tests/rich_train.py, three on the left: all, seeds 0 1 2 7 8, of 20 and of 5
minutes; flexible modes, seed 0; cross-axis and noise, seed 7)."""
MISFIT_OF_FEW = 1.05
"""Least misfit that they are taken to have: linear trains with flexible modes (seed 0) and with
cross-axis sensitivity and noise (seed 7) had 0.94 and 0.97, and errors of 5 to 25 % of the wear."""
FURTHER_PARTS = (
    "track",
    "cross_axis",
    "second_bending",
    "equipment",
    "body_torsion",
    "floors",
    "load",
    "nonlinear_dampers",
)
"""What a vehicle may be given that does not explain its healthy trips: a track that gives way,
sensors that read a share of the lateral motion, flexible modes of its body and what hangs on it."""


@dataclass(frozen=True, repr=False)
class PartsEstimate(ShortRepr):
    """The ratio to healthy of each of `names`, M_s to nominal.

    `covariance` (n_names, n_names) is that of their logarithms, `by_own_wear` (n_names,) the
    variances in it that a part has only if it has worn itself.
    """

    values: FloatArray
    covariance: FloatArray
    misfit: float
    converged: bool
    level: float
    names: tuple[str, ...] = COMPONENTS
    by_own_wear: FloatArray | float = 0.0

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
    equal: bool | None = None,
    temperature_c: float | None = None,
) -> PartsEstimate:
    """Return the ratio to healthy of every part on a later trip; `equal`: of every kind.

    Springs and dampers are as at the temperature and the speeds of the healthy trips.
    `temperature_c` is that of the trip, None if unknown. `equal` None: of every kind where the
    sensors do not show each part. `start` (13,) are ratios near it, such as those of an earlier
    trip: the search starts there, or from the healthy vehicle where that is nearer. If it does not
    explain the trip, it starts from the healthy vehicle in bands that widen. ValueError if the trip
    has another number of sensors.
    """
    equal = not bogie.generator.shows_parts if equal is None else equal
    noise = bogie.noise[trip.kept(bogie.generator.places)]
    # far from the healthy trips' mass, as by a wrong one on the drawing, valleys differ
    mass = float(np.exp(np.log(bogie.masses).mean()))
    ties = EQUAL if equal else SEPARATE
    fit = BogieMisfit(
        *(bogie.generator, [noise], [trip]),
        are_healthy=False,
        mass=mass,
        ties=ties,
        errors=bogie.errors,
    )
    law = bogie.law or SuspensionLaw(None)  # no condition is known to it
    conditions = law.conditions(temperature_c, trip.damper_speeds(bogie.generator.places))
    fit = replace(fit, conditions=conditions[None], slopes=np.array(law.slopes))
    near, first = (fit.start(), 0) if start is None else (nearer_start(fit, start), 2)
    end = narrowed(fit, near, first).finished(NEARLY_EXPLAINED * EXPLAINED)
    if not end.converged or end.misfit > EXPLAINED:
        end = min(end, best_end(fit, EXPLAINED), key=lambda end: end.misfit)
    fit, x, misfit = end.fit, end.x, end.misfit
    first = fit.n_shared + fit.n_free
    own = slice(first, first + ties.shape[1])
    covariance = posterior_covariance(fit, x, max(1.0, misfit) ** 2)[own, own]
    beyond, by_own_wear = beyond_noise(bogie, x[own], level, len(noise))
    names = PARAMETERS if equal else COMPONENTS
    faster = np.zeros(len(DAMPERS))
    if fit.has_speeds:
        faster = beyond_pairs(fit.own_speeds(x)[0] - law.own_speeds, conditions)
    by_speed, of_law = law.beside(names, conditions, faster)
    covariance = covariance + beyond + of_law
    covariance[-1, -1] += BOGIE_MASS_DEVIATION**2
    values = np.exp(x[own] - by_speed)
    return PartsEstimate(values, covariance, misfit, end.converged, level, names, by_own_wear)


def beyond_noise(
    bogie: CommissionedBogie, logs: FloatArray, level: float, n_sensors: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance tau^2 V + (1 - 1 / mu_0^2) D of the logarithms of parts and mass.

    Then the variances in it that a part has only if it has worn itself. `logs` (13,) are those
    found, or (5,) of each kind; `n_sensors` found them, None: all.
    """
    covariance: FloatArray = np.pad(bogie.scatter.widened(level), (0, 1))
    if len(logs) == len(PARAMETERS):
        tied = np.linalg.pinv(EQUAL)
        covariance = tied @ covariance @ tied.T
    n_sensors = n_sensors or len(bogie.generator.places)
    variances, own = wear_errors(bogie.misfit, logs, n_sensors)
    return covariance + np.diag(variances), own


def wear_errors(misfit: float, logs: FloatArray, n_sensors: int) -> tuple[FloatArray, FloatArray]:
    """Return the variances (1 - 1 / mu_0^2) D of the logarithms of all parts and the mass.

    Then what of each is there only if the part itself has worn. `misfit` is mu_0, all else is as of
    `beyond_noise`.
    """
    are_kinds, wear = len(logs) == len(PARAMETERS), np.abs(logs[:-1])
    is_few = are_kinds or n_sensors < LEAST_SENSORS
    names = PARAMETERS[:-1] if are_kinds else BOGIE_PARTS
    sizes = np.array([(SENSITIVITY_OF_FEW if is_few else SENSITIVITY)[kind_of(n)] for n in names])
    sizes *= np.sqrt(1 - 1 / max(misfit, MISFIT_OF_FEW if is_few else 1.0) ** 2)
    share = 1.0 if is_few and not are_kinds else OF_OTHERS
    of_others = share * np.array([np.delete(wear, i).max() for i in range(len(wear))])
    variances = np.square(sizes * np.maximum(wear, of_others))
    of_mass = (1 - 1 / max(1.0, misfit) ** 2) * MASS_DEVIATION**2 if are_kinds else 0.0
    own = variances - np.square(sizes * of_others)
    return np.append(variances, of_mass), np.append(own, 0.0)


def healthy_misfit(
    generator: SpatialVehicle, trips: Sequence[BogieTrip], conditions: FloatArray | None = None
) -> BogieMisfit:
    """Return the sum of squares of healthy trips, the prior the vehicle's distribution.

    `conditions` are as of `BogieMisfit`.
    """
    assert generator.distribution is not None
    # the free spectra hold the densities of cross level and alignment
    prior = generator.distribution.without(("cross_level", "alignment"))
    noise = torch.stack([smallest_noise(trip.spectra) for trip in trips]).amin(dim=0)
    vehicle = replace(generator, distribution=prior)
    noises = [noise] * len(trips)
    return BogieMisfit(vehicle, noises, trips, are_healthy=True, conditions=conditions)


def commission_bogie(
    generator: SpatialVehicle,
    trips: Sequence[BogieTrip],
    temperatures_c: Sequence[float | None] | None = None,
    *,
    further_parts: Sequence[str] = (),
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
    further_parts : sequence of str, optional
        Parts of ``SpatialVehicle`` that it is given if the trips show that it needs them.

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
    celsius = temperatures_c or [None] * len(trips)
    speeds = [trip.damper_speeds(generator.places) for trip in trips]
    law = SuspensionLaw.of_trips(celsius, speeds)
    conditions = [law.conditions(*of) for of in zip(celsius, speeds, strict=True)]
    fit = healthy_misfit(generator, trips, np.array(conditions))
    end = healthy_end(fit, further_parts, EXPLAINED).finished(NEARLY_EXPLAINED * EXPLAINED)
    if end.fit.errors is None:
        end = replace(end, fit=end.fit.with_errors_at(end.x))
    # x are the vehicle's numbers, the slopes of its law, then each trip's own numbers
    fit, x, misfit, n, shared = end.fit, end.x, end.misfit, end.fit.n_numbers, end.fit.n_shared
    covariance = posterior_covariance(fit, x, max(1.0, misfit) ** 2)
    if end.bare_misfit <= EXPLAINED:  # errors of the physics widen it more
        covariance = bent(fit, x, covariance)
    posterior = fit.numbers.moved(x[:n], covariance[:n, :n])
    own_speeds = fit.own_speeds(x).mean(axis=0)
    carried = x[shared:].reshape(len(trips), -1)[:, fit.n_parts :]
    return CommissionedBogie(
        replace(fit.generator, distribution=posterior),
        torch.stack([noise.densities for noise in fit.noise_at(x)]).mean(dim=0),
        np.exp(carried[:, 0]),
        end.bare_misfit,
        end.converged,
        healthy_scatter(fit, x),
        law.fitted(x[n:shared], covariance[n:shared, n:shared], own_speeds),
        fit.errors,
        np.expm1(carried[:, 1:]) if carried.shape[1] > 1 else None,
    )
