"""Healthy trips as a vehicle explains them: what its sensors should read, and the misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.suspension_law import SuspensionLaw
from suspnet.trains.fits.bogie_misfit import BogieMisfit
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.subspace import SpectralMatrix
from suspnet.vehicle import SpatialVehicle


@dataclass(frozen=True)
class ExplainedTrip:
    """A trip as a vehicle explains it.

    `expected` are the spectra of the vehicle with the inputs that explain the trip best, `misfit`
    is the rms residual over that of the noise.
    """

    expected: SpectralMatrix
    misfit: float


def explained_trips(
    vehicle: SpatialVehicle,
    bogie: CommissionedBogie,
    trips: Sequence[BogieTrip],
    temperatures_c: Sequence[float | None],
) -> list[ExplainedTrip]:
    """Return the healthy trips of a bogie as a vehicle explains them, at the median of its numbers.

    `vehicle` is that of the bogie, or the one before its trips: masses, loads and what its
    suspension depends on are the bogie's. `trips` and `temperatures_c` are those it was
    commissioned on.
    """
    law = bogie.law or SuspensionLaw(None)
    speeds = [trip.damper_speeds(vehicle.places) for trip in trips]
    fit = BogieMisfit(
        *(vehicle, [bogie.noise] * len(trips), trips),
        are_healthy=True,
        conditions=np.array(
            [law.conditions(*of) for of in zip(temperatures_c, speeds, strict=True)]
        ),
        slopes=np.array(law.slopes),
    )
    own = np.zeros((len(trips), fit.n_own))
    own[:, fit.n_parts] = np.log(bogie.masses)
    if fit.n_load > 1 and bogie.loads_m is not None:
        own[:, fit.n_parts + 1 :] = np.log1p(bogie.loads_m)
    x = np.concatenate([np.zeros(fit.n_shared), own.ravel()])
    fit = fit.with_own_speeds(x)
    expected = fit.as_expected(x)
    measured = replace(expected, trips=trips).exact  # with the same noise
    squares = [float(np.square(residuals).mean()) for residuals in measured.of_trips(x)]
    return [
        ExplainedTrip(trip.spectra, float(np.sqrt(square / measured.subspaces[0].expected)))
        for trip, square in zip(expected.trips, squares, strict=True)
    ]
