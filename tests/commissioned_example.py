"""A bogie with known numbers, its three drawn healthy trips, made once for all tests."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from vehicles import AM96

from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter
from suspnet.ground.parameters import COMPONENTS
from suspnet.trains.fits.commissioning import as_bogie
from suspnet.trains.identification.healthy_trips import HealthyTrips
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_sources import SensorSource
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.subspace import SpectralMatrix
from suspnet.vehicle import SpatialVehicle, VerticalVehicle
from suspnet.vehicle.quantities import LogNormal

UNCERTAIN = {
    "healthy_k_p": 0.2,
    "healthy_c_p": 0.4,
    "healthy_k_s": 0.2,
    "healthy_c_s": 0.3,
    "primary_bushing": 1.0,
    "cross_level": 0.7,  # the bogie does not have it: it keeps its prior
}
TRUE = (1.15, 0.8, 0.9, 1.2, 1.5, 1.0)
MASSES = (0.95, 1.05, 1.15)
SPEEDS = (60.0, 70.0, 60.0)
DEVIATION = 0.01
"""Standard deviation of the logarithm of each number that the bogie knows."""
BINS = torch.arange(1.0, 18.0, 0.5, dtype=torch.float64)
N_AVERAGES = 200
NOISE = 1e-6
"""Noise of each sensor, of inputs of about 1."""
NO_SCATTER = HealthyScatter((0.0,) * 4, (0.0,) * 4, 3, ((0.0,) * 12,) * 12)
"""That of trips which show all parts alike, without noise."""


def trip(name, mileage_km, **changes):
    channels = {channel: SensorSource(f"{channel}.csv", "g") for channel in CHANNELS}
    path = Path(f"/trips/{mileage_km:.0f}.yaml")
    fields = {"vehicle": "am96", "suspension": "S1", "start": None, "speed": 70.0} | changes
    return TripManifest(path=path, name=name, mileage_km=mileage_km, channels=channels, **fields)


def drawn_trip(vehicle, numbers, mass, speed_m_per_s, seed):
    """Return a trip of a vehicle with these numbers, its inputs of any spectra and coherence."""
    rng = np.random.default_rng(seed)
    parts = torch.ones(1, len(COMPONENTS), dtype=torch.float64)
    parts[0, -1] = mass
    vehicle = replace(vehicle, speed_m_per_s=speed_m_per_s)
    rows = vehicle.with_uncertain(parts, torch.tensor([numbers], dtype=torch.float64))
    responses = vehicle.channels(rows, BINS)[0].permute(2, 1, 0).numpy()
    n_freq, n_sensors, n_inputs = responses.shape

    def normal(*shape):
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)

    inputs = normal(n_freq, n_inputs, n_inputs)
    signals = responses @ inputs @ normal(n_freq, n_inputs, N_AVERAGES)
    signals += np.sqrt(NOISE) * normal(n_freq, n_sensors, N_AVERAGES)
    values = signals @ signals.conj().swapaxes(1, 2) / N_AVERAGES
    return BogieTrip(BINS, SpectralMatrix(torch.as_tensor(values), N_AVERAGES), speed_m_per_s)


@cache
def commissioned_example():
    """Return healthy trips, drawn from a known vehicle, and the vehicle of a bogie like it."""
    names, covariance = tuple(UNCERTAIN)[:-1], DEVIATION**2 * np.eye(len(UNCERTAIN) - 1)
    known = LogNormal(
        names, tuple(np.log(TRUE[:-1]).tolist()), tuple(map(tuple, covariance.tolist()))
    )
    vehicle = SpatialVehicle(AM96, parts=("bushings",), distribution=known)
    trips = tuple(
        drawn_trip(vehicle, TRUE[:-1], mass, speed, i)
        for i, (mass, speed) in enumerate(zip(MASSES, SPEEDS, strict=True))
    )
    before = SpatialVehicle(
        AM96,
        parts=("bushings",),
        distribution={name: UNCERTAIN[name] for name in names},
    )
    found = HealthyTrips(
        tuple(trip(f"trip_{i}", 12345.0 * (i + 1)) for i in range(3)),
        before,
        trips,
        (True, True, True),
        left_out=("trip_9: no stretch at one speed",),
    )
    noise = torch.full((len(vehicle.sensors),), NOISE, dtype=torch.float64)
    bogie = CommissionedBogie(vehicle, noise, np.array(MASSES), 1.02, True, NO_SCATTER)
    generator = VerticalVehicle(AM96, parts=("bushings",), distribution=UNCERTAIN)
    return found, as_bogie(generator, bogie)
