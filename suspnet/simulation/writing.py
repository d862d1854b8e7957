"""Simulated trips: track and journey -> motion of a vehicle -> sensors -> files with a manifest."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from joblib import Parallel, delayed
from numpy.typing import NDArray
from scipy.signal import resample_poly
from tqdm import tqdm

from suspnet.checks import check_choice, check_number
from suspnet.dynamics import PARAMETERS, Vehicle
from suspnet.dynamics.journey import Journey, service_journey, steady_journey
from suspnet.dynamics.motion import LinearSystem, SampledMotion
from suspnet.dynamics.track import TrackProfile, make_profile, track_spectrum
from suspnet.recordings.manifest import CHANNELS, Channel, SpeedSource, TripManifest, write_manifest
from suspnet.simulation.scenarios import Scenario
from suspnet.simulation.sensors import Sensor
from suspnet.storage import write_atomically
from suspnet.types import FloatArray

BLOCK = 1 << 18
"""Number of samples simulated at once."""
LEAD_IN_S = 20.0
"""Time simulated before a trip that starts at speed [s], in which the transient decays."""
MARGIN_M = 50.0
ROW_GROUP = 1 << 20
ANTI_ALIAS = ("kaiser", 12.0)
FIRST_DAY = datetime(2015, 8, 3, 6, tzinfo=UTC)


class SimulatedVehicle(Protocol):
    """The interface of generators that can simulate trips."""

    @property
    def vehicle(self) -> Vehicle:
        """The healthy vehicle."""
        ...

    def motion_system(self, ratios: torch.Tensor) -> LinearSystem:
        """Return the equations of motion of one vehicle."""
        ...


@dataclass(frozen=True)
class Fleet:
    """Trips of one suspension over its mileage.

    Parameters
    ----------
    n_trips : int
    last_mileage_km : float, [km]
        Of the last trip; the others lie evenly before it.
    minutes : float, [min]
        Length of a trip.
    speed_m_per_s : float, [m/s]
        Steady or cruising speed.
    journey : {"steady", "service"}
        At one speed throughout, or with start, stops and slower stretches.
    n_stops : int
        Of a service journey.
    track : str
        A name of ``suspnet.dynamics.track.TRACKS``.
    short_waves : bool
    sensors : mapping
        A `Sensor`'s arguments for each of axle_box, bogie and body.
    suspension : str
        Free text for the manifests.

    Raises
    ------
    TypeError, ValueError
        If a setting is out of range.
    """

    n_trips: int = 30
    last_mileage_km: float = 308_000.0
    minutes: float = 20.0
    speed_m_per_s: float = 70.0
    journey: Literal["steady", "service"] = "steady"
    n_stops: int = 1
    track: str = "german_low"
    short_waves: bool = False
    sensors: Mapping[str, Mapping[str, Any]] | None = None
    suspension: str = "simulated"

    def __post_init__(self) -> None:
        check_number("n_trips", self.n_trips, low=1, whole=True)
        for name in ("last_mileage_km", "minutes", "speed_m_per_s"):
            check_number(name, getattr(self, name), above=0)
        check_choice("journey", self.journey, ("steady", "service"))
        track_spectrum(self.track, self.short_waves)
        self.loggers()

    def loggers(self) -> dict[str, Sensor]:
        """Return each channel's sensor; those of Table II with 34 dB where none is given."""
        given = dict(self.sensors or {})
        if set(given) - set(CHANNELS):
            raise ValueError(f"`sensors` must be named as in {CHANNELS}, got {sorted(given)}")
        rates = dict(zip(CHANNELS, (5000.0, 2000.0, 2000.0), strict=True))
        return {
            name: Sensor(**({"rate_hz": rates[name]} | dict(given.get(name, {}))))
            for name in CHANNELS
        }

    def mileage_km(self) -> FloatArray:
        """Return the mileage of each trip, shape (n_trips,), [km]."""
        return self.last_mileage_km * np.arange(1, self.n_trips + 1) / self.n_trips

    def journey_of(self, seed: int) -> Journey:
        """Return the speed along one trip."""
        duration_s = 60 * self.minutes
        if self.journey == "steady":
            return steady_journey(self.speed_m_per_s, duration_s)
        return service_journey(self.speed_m_per_s, duration_s, self.n_stops, seed)


def write_fleet(
    folder: Path,
    fleet: Fleet,
    scenario: Scenario,
    generator: SimulatedVehicle,
    *,
    seed: int = 0,
    n_jobs: int = 1,
    progress: bool = False,
) -> list[Path]:
    """Simulate trips and write each as a manifest with a folder of Parquet files.

    Parameters
    ----------
    folder : Path
    fleet : Fleet
    scenario : Scenario
    generator : SimulatedVehicle
        ``QuarterCar`` or ``VerticalVehicle``.
    seed : int
        Trip i draws track, noise and journey from (seed, i) alone.
    n_jobs : int
        Trips at the same time.
    progress : bool

    Returns
    -------
    list of Path
        The manifests.
    """
    mileage = fleet.mileage_km()
    ratios = scenario.ratios(mileage, seed)
    jobs = (
        delayed(_write_trip)(folder, fleet, generator, i, float(mileage[i]), ratios[i], seed)
        for i in range(fleet.n_trips)
    )
    done = Parallel(n_jobs=n_jobs, return_as="generator")(jobs)
    bar = tqdm(done, total=fleet.n_trips, unit="trip", disable=None if progress else True)
    return list(bar)


def simulate_trip(
    system: LinearSystem, profile: TrackProfile, journey: Journey, rate_hz: float
) -> FloatArray:
    """Return accelerations of axle box, frame and body along a trip, shape (3, n_samples), [m/s^2].

    The axle box feels v^2 r'' + a r' of the track r at its place; the other wheelsets feel the
    same track where they are. The vehicle's response is exact for an acceleration of the wheels
    that is linear between samples.

    Parameters
    ----------
    system : LinearSystem
    profile : TrackProfile
        As long as the journey with its lead-in, and the train, ask for (`profile_length_m`).
    journey : Journey
    rate_hz : float, [Hz]
    """
    motion = SampledMotion(system, rate_hz)
    n_lead = round(_lead_in_s(journey) * rate_hz)
    n_samples = math.floor(journey.duration_s * rate_hz + 1e-6)
    start_m = _start_m(system, journey)
    signals = np.empty((3, n_samples))
    for first in range(-n_lead, n_samples, BLOCK):
        times = np.arange(first, min(first + BLOCK, n_samples)) / rate_hz
        position, speed, acceleration = journey.at(times)
        wheels = []
        for behind in system.behind_m:
            _, slope, curvature = profile.at(start_m + position - behind)
            wheels.append(speed**2 * curvature + acceleration * slope)
        outputs = motion.advance(wheels)
        kept = slice(max(0, -first), None)
        place = slice(max(0, first), max(0, first + len(times)))
        measured = system.behind_m.index(min(system.behind_m, key=abs))
        signals[0, place] = wheels[measured][kept]
        signals[1:, place] = outputs[:, kept]
    return signals


def profile_length_m(system: LinearSystem, journey: Journey) -> float:
    """Return the length of track that a trip needs, [m]."""
    ahead = -min(system.behind_m)
    return _start_m(system, journey) + journey.distance_m + ahead + MARGIN_M


def _lead_in_s(journey: Journey) -> float:
    """Return the time simulated before the trip begins, [s]."""
    return LEAD_IN_S if journey.speeds_m_per_s[0] > 0 else 0.0


def _start_m(system: LinearSystem, journey: Journey) -> float:
    """Return the position of the measured wheelset on the track when the trip begins, [m]."""
    lead_m = _lead_in_s(journey) * float(journey.speeds_m_per_s[0])
    return max(system.behind_m) + lead_m + MARGIN_M


def _write_trip(
    folder: Path,
    fleet: Fleet,
    generator: SimulatedVehicle,
    index: int,
    mileage_km: float,
    ratios: FloatArray,
    seed: int,
) -> Path:
    """Simulate one trip, write its manifest and files, and return the manifest's path."""
    track, noise, speeds = np.random.SeedSequence([seed, index]).spawn(3)
    journey = fleet.journey_of(int(speeds.generate_state(1)[0]))
    sensors = fleet.loggers()
    rate_hz = max(sensor.rate_hz for sensor in sensors.values())
    system = generator.motion_system(torch.as_tensor(ratios))
    profile = make_profile(
        track_spectrum(fleet.track, fleet.short_waves),
        profile_length_m(system, journey),
        float(journey.speeds_m_per_s.max()) / rate_hz,
        int(track.generate_state(1)[0]),
    )
    signals = simulate_trip(system, profile, journey, rate_hz)
    del profile
    rng = np.random.default_rng(noise)
    name = f"trip_{index + 1:03d}"
    channels = {}
    for channel, signal in zip(CHANNELS, signals, strict=True):
        sensor = sensors[channel]
        recorded = sensor.record(_resampled(signal, rate_hz, sensor.rate_hz), rng)
        file = f"{name}/{channel}.parquet"
        _write_column(folder / file, "acceleration", recorded.astype(np.float32))
        channels[channel] = Channel(
            file, "m/s2", column="acceleration", rate_hz=sensor.rate_hz, range=sensor.range_m_per_s2
        )
    whole_s = np.arange(math.floor(journey.duration_s) + 1, dtype=np.float64)
    _write_column(folder / name / "speed.parquet", "speed", journey.at(whole_s)[1])
    manifest = TripManifest(
        path=folder / f"{name}.yaml",
        name=name,
        vehicle=generator.vehicle.name,
        suspension=fleet.suspension,
        mileage_km=mileage_km,
        start=FIRST_DAY + timedelta(days=10 * index),
        speed=SpeedSource(f"{name}/speed.parquet", "m/s", column="speed", rate_hz=1.0),
        channels=channels,
        truth=dict(zip(PARAMETERS, ratios.tolist(), strict=True)),
    )
    return write_manifest(manifest)


def _resampled(signal: FloatArray, from_hz: float, to_hz: float) -> FloatArray:
    """Return a signal at another rate, low-passed."""
    ratio = Fraction(to_hz / from_hz).limit_denominator(1000)
    if ratio == 1:
        return signal.copy()
    return np.asarray(resample_poly(signal, ratio.numerator, ratio.denominator, window=ANTI_ALIAS))


def _write_column(path: Path, name: str, values: NDArray[Any]) -> None:
    """Write one array as a Parquet file, atomically."""
    stream = io.BytesIO()
    pq.write_table(pa.table({name: values}), stream, row_group_size=ROW_GROUP)
    write_atomically(path, stream.getvalue())
