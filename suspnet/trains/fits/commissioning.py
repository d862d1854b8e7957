"""Commissioning: the most probable vehicle given healthy trips, and its remaining uncertainty.

`suspnet.trains.fits.vehicle_search` finds the vehicle. The inverse of J^T J there, without the rows
of the masses, is the posterior covariance of z. If the final misfit exceeds the noise, the noise is
scaled up to match.

Where the temperatures of the trips differ, the slopes of damping over temperature are fitted, too
(`suspnet.estimation.temperature`), and where their relative velocities differ, what dampers lose as
they move faster (`suspnet.estimation.relative_velocity`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter

import numpy as np
import torch

from suspnet.curves.estimates import EstimateSettings
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.damping_laws import Laws
from suspnet.estimation.flags import Residual
from suspnet.ground.progress import bar
from suspnet.ground.tensors import threads
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.trains.fits.healthy_misfit import HealthyMisfit, HealthySpectra
from suspnet.trains.fits.vehicle_search import SHARE, SPREADS, VehicleSearch
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.quantities import OF_THE_TRIP, QUANTITIES, LogNormal

N_STARTS = 4
"""Largest number of searches that are completed, unless another one is given."""
NEGLIGIBLE_SHARE = 5e-4
"""Share of what excites each wheelset alone below which it is left out: at 0.01 it makes c_p 4.8 %
wrong."""


@dataclass(frozen=True, repr=False)
class Commissioned(ShortRepr):
    """The vehicle identified from healthy trips.

    Attributes
    ----------
    generator : VerticalVehicle
        With the posterior as its distribution.
    prior, posterior : LogNormal
        Of the same names.
    masses : array of shape (n_trips,), [-]
        Car-body mass over nominal on each trip.
    misfit : float
        Rms of the residuals over that of the noise: 1 if all is explained.
    misfits : tuple of float
        The same for each group.
    frequencies_hz : array of shape (n_freq,), [Hz]
    observed, nominal, fitted : complex arrays of shape (n_groups, 2, n_freq), [-]
        G_p and G_s as measured, of the nominal and of the commissioned vehicle.
    deviations : array of shape (n_groups, 2, n_freq), [-]
        Standard deviations of the measured log-magnitudes; infinite where a bin is not used.
    n_agree, n_starts : int
        Number of completed searches that found this vehicle, and of all.
    converged : bool
    laws : Laws
        How damping depends on temperature and on relative velocity.
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
    laws: Laws = field(default_factory=Laws)

    @property
    def residual(self) -> Residual | None:
        """The unexplained difference of the healthy trips, averaged over the groups.

        None without groups: the vehicle is that of a bogie whose sensors show no curves.
        """
        if not self.misfits:
            return None
        return Residual.of(self.misfit, self.observed, self.fitted, self.deviations)


def commission(
    generator: VerticalVehicle,
    settings: EstimateSettings,
    groups: Sequence[HealthySpectra],
    *,
    n_starts: int = N_STARTS,
    progress: bool = False,
) -> Commissioned:
    """Return the most probable vehicle given healthy trips.

    Parameters
    ----------
    generator : VerticalVehicle
        With the prior as its distribution.
    settings : EstimateSettings
        Bound to the vehicle: bins, window and estimator.
    groups : sequence of HealthySpectra
        From `read_healthy`.
    n_starts : int
        Largest number of searches that are completed.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If the generator has no uncertain numbers.
    """
    if generator.distribution is None or not generator.distribution.names:
        raise ValueError("nothing of the vehicle is uncertain: there is nothing to commission")
    with threads(1), bar("search of the vehicle", unit="step", shown=progress) as steps:
        target = VehicleSearch(generator, settings, groups)
        target.on_step = steps.update
        # allow model errors first: a direct search would end in a valley far off
        first = target.first_searches(n_starts)
        distinct = {id(found): found for found in first}
        on = {key: target.search(found.x, SPREADS[1:]) for key, found in distinct.items()}
        rough = sorted((on[id(found)] for found in first), key=attrgetter("cost"))
        ends = [target.finished(rough[0].x)]
        # the others show whether the best vehicle is the only one: those that meet it end alike
        first_posterior = target.posterior(ends[0].x)[0]
        for other in rough[1:]:
            best = min(ends, key=attrgetter("cost"))
            meets = partial(target.meets, best, target.posterior(best.x)[0])
            is_same = target.agrees(rough[0].x, first_posterior, other.x)
            ends.append(ends[0] if is_same else target.finished(other.x, meets))
        best = min(ends, key=attrgetter("cost"))
        posterior, laws, mean_square = target.posterior(best.x)
        n_agree = sum(target.agrees(best.x, posterior, end.x) for end in ends)
    n = len(target.prior.names)
    theta = torch.as_tensor(best.x)[None]
    observed, fitted, deviations = target.curves(theta)
    plain = replace(generator, distribution=None)
    nominal = HealthyMisfit(plain, settings, groups).curves(theta[:, n:])[1]
    return Commissioned(
        generator=_simplest(generator, posterior),
        prior=target.prior,
        posterior=posterior,
        masses=np.exp(best.x[n : n + target.n_trips]),
        misfit=math.sqrt(mean_square),
        misfits=tuple(target.misfits(theta)),
        frequencies_hz=settings.frequencies_hz().numpy(),
        observed=observed,
        nominal=nominal,
        fitted=fitted,
        deviations=deviations,
        n_agree=n_agree,
        n_starts=len(first),
        converged=best.converged,
        laws=laws,
    )


def as_bogie(
    generator: VerticalVehicle,
    settings: EstimateSettings,
    groups: Sequence[HealthySpectra],
    bogie: CommissionedBogie,
) -> Commissioned:
    """Return the vehicle of equal sides with the numbers of a bogie, beside the trips' curves.

    It takes what `commission` does, also no groups. Numbers that the bogie lacks keep their prior.
    """
    prior, known = generator.distribution, bogie.generator.distribution
    assert prior is not None
    assert known is not None
    mean, covariance = np.array(prior.mean), np.array(prior.covariance)
    shared = [name for name in prior.names if name in known.names]
    own = [prior.names.index(name) for name in shared]
    of_bogie = [known.names.index(name) for name in shared]
    covariance[own], covariance[:, own] = 0.0, 0.0
    covariance[np.ix_(own, own)] = np.array(known.covariance)[np.ix_(of_bogie, of_bogie)]
    mean[own] = np.array(known.mean)[of_bogie]
    posterior = LogNormal(prior.names, tuple(mean), tuple(map(tuple, covariance)))
    masses = torch.as_tensor(np.log(bogie.masses))[None]
    medians = torch.zeros(1, len(posterior.names), dtype=torch.float64)
    frequencies_hz = settings.frequencies_hz().numpy()
    misfits: tuple[float, ...] = ()
    if groups:
        of_median = HealthyMisfit(replace(generator, distribution=posterior), settings, groups)
        plain = HealthyMisfit(replace(generator, distribution=None), settings, groups)
        of_laws = torch.zeros(1, of_median.n_of_damping, dtype=torch.float64)
        theta = torch.cat([medians, masses, of_laws], dim=1)
        observed, fitted, deviations = of_median.curves(theta)
        nominal = plain.curves(theta[:, medians.shape[1] :])[1]
        misfits = tuple(of_median.misfits(theta))
    else:
        none = np.zeros((0, 2, len(frequencies_hz)))
        observed = fitted = nominal = none.astype(np.complex128)
        deviations = none
    return Commissioned(
        generator=_simplest(generator, posterior),
        prior=prior,
        posterior=posterior,
        masses=bogie.masses,
        misfit=bogie.misfit,
        misfits=misfits,
        frequencies_hz=frequencies_hz,
        observed=observed,
        nominal=nominal,
        fitted=fitted,
        deviations=deviations,
        n_agree=0,
        n_starts=0,
        converged=bogie.converged,
        laws=Laws(bogie.law),
    )


def _simplest(generator: VerticalVehicle, posterior: LogNormal) -> VerticalVehicle:
    """Return the generator with the posterior, without wheelsets that are not excited alone."""
    if SHARE in posterior.names:
        (usual,) = (quantity.nominal for quantity in QUANTITIES if quantity.name == SHARE)
        share = float((generator.nominal or {}).get(SHARE, usual or 0.0))
        most = share * float(posterior.quantile(2.0)[posterior.names.index(SHARE)])
        if most < NEGLIGIBLE_SHARE:
            parts = tuple(part for part in generator.parts if part != "wheelsets")
            posterior = posterior.without((SHARE,))
            generator = replace(generator, parts=parts, distribution=None)
    return replace(generator, distribution=posterior.renewed(OF_THE_TRIP))
