"""A bogie with known numbers, its three drawn healthy trips, made once for all tests."""

from functools import cache
from pathlib import Path

import numpy as np
import torch
from vehicles import AM96

from suspnet.curves.cross_spectra import CrossSpectra, moving_average_with, sample_spectra
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import Speeds
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.trains.fits.commissioning import as_bogie
from suspnet.trains.fits.healthy_misfit import HealthySpectra
from suspnet.trains.identification.healthy_trips import HealthyTrips
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_sources import SensorSource
from suspnet.vehicle import SpatialVehicle, VerticalVehicle
from suspnet.vehicle.quantities import LogNormal

SETTINGS = EstimateSettings(
    segment_s=5.0, rates_hz=(1000.0, 500.0, 500.0), high_hz=9.9, body_high_hz=9.0
).bound(AM96)
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


def trip(name, mileage_km, **changes):
    channels = {channel: SensorSource(f"{channel}.csv", "g") for channel in CHANNELS}
    path = Path(f"/trips/{mileage_km:.0f}.yaml")
    fields = {"vehicle": "am96", "suspension": "S1", "start": None, "speed": 70.0} | changes
    return TripManifest(path=path, name=name, mileage_km=mileage_km, channels=channels, **fields)


@cache
def commissioned_example():
    """Return healthy trips, drawn from a known vehicle, and the vehicle of a bogie like it."""
    generator = VerticalVehicle(AM96, parts=("bushings",), distribution=UNCERTAIN)
    source, groups = torch.Generator().manual_seed(0), []
    taps = moving_average_with(SETTINGS.welch.correlation().numpy())
    for i, (mass, speed) in enumerate(zip(MASSES, SPEEDS, strict=True)):
        rows = torch.ones(1, 5, dtype=torch.float64)
        rows[0, 4] = mass
        rows = generator.with_uncertain(rows, torch.tensor([TRUE], dtype=torch.float64))
        at = Speeds((speed,), (1.0,))
        drawn = sample_spectra(SETTINGS.observer(generator).at(at).expected(rows), taps, source)
        spectra = CrossSpectra(drawn.auto[0], drawn.cross[0], drawn.n_averages)
        groups.append(HealthySpectra(i, f"trip_{i}", at, spectra))
    manifests = tuple(trip(f"trip_{i}", 12345.0 * (i + 1)) for i in range(3))
    left_out = ("trip_9: no stretch at one speed",)
    found = HealthyTrips(manifests, tuple(groups), (True, True, True), left_out)
    names = tuple(UNCERTAIN)[:-1]
    covariance = tuple(map(tuple, DEVIATION**2 * np.eye(len(names))))
    known = LogNormal(names, tuple(np.log(TRUE[:-1]).tolist()), covariance)
    vehicle = SpatialVehicle(AM96, parts=("bushings",), distribution=known)
    noise = torch.ones(len(vehicle.sensors), dtype=torch.float64)
    bogie = CommissionedBogie(vehicle, noise, np.array(MASSES), 1.02, True)
    return found, as_bogie(generator, SETTINGS, groups, bogie)
