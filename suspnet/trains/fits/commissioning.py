"""A commissioned bogie as a vehicle with both sides and axles as equal.

Pages show its numbers, and models of a bogie check the channels of later trips with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.ground.wording import ShortRepr
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.quantities import OF_THE_TRIP, LogNormal


@dataclass(frozen=True, repr=False)
class Commissioned(ShortRepr):
    """The vehicle of equal sides that has the numbers of a commissioned bogie.

    Attributes
    ----------
    bogie : CommissionedBogie
    generator : VerticalVehicle
        With the posterior as its distribution.
    prior, posterior : LogNormal
        Of the same names.
    """

    bogie: CommissionedBogie
    generator: VerticalVehicle
    prior: LogNormal
    posterior: LogNormal


def as_bogie(generator: VerticalVehicle, bogie: CommissionedBogie) -> Commissioned:
    """Return the vehicle of equal sides with the numbers of a bogie.

    `generator` has the prior as its distribution; numbers that the bogie lacks keep it.
    """
    prior = generator.distribution
    assert prior is not None
    posterior = _posterior(prior, bogie)
    vehicle = replace(generator, distribution=posterior.renewed(OF_THE_TRIP))
    return Commissioned(bogie, vehicle, prior, posterior)


def _posterior(prior: LogNormal, bogie: CommissionedBogie) -> LogNormal:
    """Return the prior with mean and covariance of the bogie for the numbers that it has."""
    known = bogie.generator.distribution
    assert known is not None
    mean, covariance = np.array(prior.mean), np.array(prior.covariance)
    shared = [name for name in prior.names if name in known.names]
    own = [prior.names.index(name) for name in shared]
    of_bogie = [known.names.index(name) for name in shared]
    covariance[own], covariance[:, own] = 0.0, 0.0
    covariance[np.ix_(own, own)] = np.array(known.covariance)[np.ix_(of_bogie, of_bogie)]
    mean[own] = np.array(known.mean)[of_bogie]
    return LogNormal(prior.names, tuple(mean), tuple(map(tuple, covariance)))
