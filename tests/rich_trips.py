"""Trips of rich vehicles on disk: what suspnet reads without having been trained for it."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from rich_motion import simulate
from rich_vehicle import RichVehicle
from scipy.signal import resample_poly
from vehicles import AM96

from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_files import write_manifest
from suspnet.trains.recordings.manifest_sources import SensorSource, SpeedSource
from suspnet.trains.simulation import Scenario
from suspnet.trains.simulation.fleet import FIRST_DAY
from suspnet.trains.simulation.signals import LEAD_IN_S, MARGIN_M, Journey, profile_length_m
from suspnet.trains.simulation.writing import ANTI_ALIAS, time_between
from suspnet.vehicle import PARAMETERS, VerticalVehicle
from suspnet.vehicle.quantities import UNMEASURED
from suspnet.vehicle.track import make_profile, track_spectrum

PARTS = ("bending", "dampers", "rubber", "contact")
OFF = {  # of a vehicle that is not as its drawings say; signs as in README where it gives them
    "inertias": {"body_gyration": 1.1, "bogie_gyration": 0.9, "bogie_mass": 1.1},
    "geometry": {"half_wheelbase": 1.1, "half_pivot_distance": 0.9},
}
EFFECTS = (*PARTS, "drift", *OFF)
DRIFT = 0.03
SENSORS = dict(zip(CHANNELS, ({"rate_hz": rate} for rate in (1000.0, 500.0, 500.0)), strict=True))


def rich_vehicle(effects):
    """Return the vehicle with some of ``EFFECTS``."""
    return RichVehicle(**{name: name in effects for name in PARTS})


def drawn_ratios(n_healthy, fleet, seed):
    """Return k and c at 60 to 140 %, M_s at 90 to 120 % of nominal, (n_trips, 5), [-].

    The first trips are healthy, but for the payload.
    """
    ratios = Scenario("random", spread=0.4).ratios(fleet.mileage_km(), seed)
    ratios[:n_healthy, :4] = 1.0
    return ratios


def off_ratios(ratios, effects):
    """Return ratios with the columns ``UNMEASURED``, (n_trips, 15), [-]."""
    factors = {name: value for key in OFF if key in effects for name, value in OFF[key].items()}
    rest = [factors.get(name, 1.0) for name in UNMEASURED]
    return np.hstack([ratios, np.tile(rest, (len(ratios), 1))])


def write_rich_trips(folder, effects, ratios, fleet, seed, rate_hz=1000.0):
    """Simulate trips together, write each as ``write_fleet`` does, and return the manifests.

    Parameters
    ----------
    folder : Path
    effects : collection of str
        Some of ``EFFECTS``.
    ratios : array of shape (n_trips, 5), [-]
        ``PARAMETERS`` of each trip.
    fleet : Fleet
    seed : int
        Trip i draws track, noise and the sign of its drift from (seed, i) alone.
    rate_hz : float, [Hz]
        Of the steps.
    """
    rows = off_ratios(ratios, effects)
    sources = [np.random.SeedSequence([seed, i]).spawn(3) for i in range(len(rows))]
    journeys = [_journey(fleet, "drift" in effects, speeds) for *_, speeds in sources]
    tracks = [
        _track(row, fleet, journey, rate_hz, track)
        for row, journey, (track, *_) in zip(rows, journeys, sources, strict=True)
    ]
    n_samples = math.floor(60 * fleet.minutes * rate_hz + 1e-6)
    n_lead = round(LEAD_IN_S * rate_hz)
    signals = simulate(rows, rich_vehicle(effects), tracks, rate_hz, n_samples, n_lead)
    return [
        _write(folder, fleet, i, ratios[i], journeys[i], signals[i], rate_hz, noise)
        for i, (_, noise, _) in enumerate(sources)
    ]


def _journey(fleet, drifts, source):
    """Return a journey at the fleet's speed, or from there up or down by 3 %."""
    drift = DRIFT * np.random.default_rng(source).choice([-1.0, 1.0]) * drifts
    speeds = fleet.speed_m_per_s * np.array([1.0, 1.0 + drift])
    return Journey(np.array([0.0, 60 * fleet.minutes]), speeds)


def _track(ratios, fleet, journey, rate_hz, source):
    """Return what gives elevation, velocity and acceleration under each wheelset at any times."""
    system = VerticalVehicle(AM96).motion_system(torch.as_tensor(ratios))
    behind_m = np.array(system.behind_m)
    start_m = behind_m.max() + LEAD_IN_S * journey.speeds_m_per_s[0] + MARGIN_M
    profile = make_profile(
        track_spectrum(fleet.track),
        profile_length_m(system, journey),
        float(journey.speeds_m_per_s.max()) / rate_hz,
        int(source.generate_state(1)[0]),
    )

    def under_wheels(times):
        position, speed, acceleration = journey.at(times)
        r, slope, curvature = profile.at(start_m + position - behind_m[:, None])
        return np.stack([r, slope * speed, curvature * speed**2 + slope * acceleration])

    return under_wheels


def _write(folder, fleet, index, ratios, journey, signals, rate_hz, noise):
    """Write the files of one trip and return its manifest."""
    rng, name = np.random.default_rng(noise), f"trip_{index + 1:03d}"
    (folder / name).mkdir(parents=True)
    channels = {}
    for (channel, sensor), signal in zip(fleet.loggers().items(), signals, strict=True):
        ratio = Fraction(sensor.rate_hz / rate_hz).limit_denominator(1000)
        resampled = resample_poly(signal, ratio.numerator, ratio.denominator, window=ANTI_ALIAS)
        _write_column(folder, file := f"{name}/{channel}.parquet", sensor.record(resampled, rng))
        channels[channel] = SensorSource(file, "m/s2", column="value", rate_hz=sensor.rate_hz)
    seconds = np.arange(math.floor(journey.duration_s) + 1.0)
    _write_column(folder, file := f"{name}/speed.parquet", journey.at(seconds)[1])
    return write_manifest(
        TripManifest(
            path=folder / f"{name}.yaml",
            name=name,
            vehicle=AM96.name,
            suspension=fleet.suspension,
            mileage_km=float(fleet.mileage_km()[index]),
            start=FIRST_DAY + time_between(fleet) * index,
            speed=SpeedSource(file, "m/s", column="value", rate_hz=1.0),
            channels=channels,
            truth=dict(zip(PARAMETERS, ratios.tolist(), strict=True)),
        )
    )


def _write_column(folder, file, values):
    pq.write_table(pa.table({"value": values.astype(np.float32)}), folder / file)
