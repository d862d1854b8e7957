"""Simulated trips: track and journey -> motion of a vehicle -> sensors -> files with a manifest."""

import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import timedelta
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from joblib import effective_n_jobs
from numpy.typing import NDArray
from scipy.signal import resample_poly

from suspnet._version import __version__
from suspnet.ground.parameters import SIDES
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.storage import content_hash, write_atomically, write_json
from suspnet.ground.types import FloatArray
from suspnet.ground.workers import LostWorkerError, each, workers_for
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_files import write_manifest
from suspnet.trains.recordings.manifest_sources import Pair, SensorSource, SpeedSource
from suspnet.trains.simulation.fleet import FIRST_DAY, Fleet, Scenario, SimulatedSuspension, Trains
from suspnet.trains.simulation.folders import TRUTH, is_finished, is_whole, own_folder, unfinished
from suspnet.trains.simulation.signals import Journey, profile_length_m, simulate_trip
from suspnet.trains.simulation.true_vehicle import scattered, true_numbers, with_separate_parts
from suspnet.vehicle import PARAMETERS, ResponseGenerator, VerticalVehicle
from suspnet.vehicle.motion import LinearSystem
from suspnet.vehicle.quantities import ADDITIONS, IN_MOTION
from suspnet.vehicle.track import TrackProfile, cross_level_spectrum, make_profile, track_spectrum

ROW_GROUP = 1 << 20  # rows per row group of the Parquet files
ANTI_ALIAS = ("kaiser", 12.0)  # window of the resampling filter
HOURS_A_DAY = 5.0
"""Hours a day that a simulated train runs at its speed: at 70 m/s 1,260 km a day, or 460,000 km a
year, which is what high-speed trains run."""
LONGEST = timedelta(days=3650)
"""Longest time from the first trip to the last, so that none of many trips is in the future."""
STEP = timedelta(minutes=20)
"""Times between trips are whole multiples of this, so that each trip starts a section of the
monitor."""


def time_between(fleet: Fleet) -> timedelta:
    """Return the time from one trip to the next, in which the train runs the mileage between them.

    It runs ``HOURS_A_DAY`` at its speed. Trips do not overlap, and all lie within ``LONGEST``: a
    mileage that would take longer is run faster.
    """
    km_per_day = 3.6 * fleet.speed_m_per_s * HOURS_A_DAY
    days = min(fleet.last_mileage_km / fleet.n_trips / km_per_day, LONGEST.days)
    steps = max(round(timedelta(days=days) / STEP), -(-timedelta(minutes=fleet.minutes) // STEP))
    return min(steps * STEP, LONGEST // fleet.n_trips // STEP * STEP)


@dataclass(frozen=True)
class Simulation:
    """Settings of a simulation: trips of suspensions that follow a scenario.

    Trip i draws track, noise and journey from (seed, i) only, and the suspension its true numbers
    from the seed only. `scatter` scales the deviation of these from nominal: 1 is that of the
    priors.
    """

    fleet: Fleet
    scenario: Scenario
    generator: ResponseGenerator
    seed: int = 0
    scatter: float = 0.0

    def made_from(self, place: Trains | SimulatedSuspension | None) -> str:
        """Return a hash of all that the trips depend on."""
        parts: list[Any] = [asdict(self.fleet), asdict(self.scenario)]
        parts += [type(self.generator).__name__, asdict(self.generator)]
        parts += [self.seed, self.scatter, __version__]
        if place is not None:
            parts.append(asdict(place))
        return content_hash(json.loads(json.dumps(parts, default=str)))


def write_fleet(
    folder: Path,
    simulation: Simulation,
    *,
    aboard: SimulatedSuspension | None = None,
    n_jobs: int | None = 1,
    progress: bool = False,
) -> list[Path]:
    """Simulate trips, write each as a manifest and Parquet files, and return the manifests.

    The true numbers of the healthy vehicle are stored in ``truth.json``. An unfinished simulation
    continues with the missing trips. `aboard` is None for a suspension without a train; `n_jobs`
    trips are simulated in parallel (None: see `workers_for`). Raises ValueError if no physical
    vehicle can be drawn, if both sides are required of a vehicle without roll, or if the folder
    holds other trips or is written to; LostWorkerError if a writing process was killed.
    """
    fleet, scenario, seed = simulation.fleet, simulation.scenario, simulation.seed
    made_from = simulation.made_from(aboard)
    generator: Any = simulation.generator
    # separate parts first, so that each has its own scatter
    if scenario.by_part:
        generator = with_separate_parts(generator, scenario.effects)
    generator = scattered(generator, simulation.scatter, seed)
    _check_sides(fleet, generator)
    mileage = fleet.mileage_km()
    ratios = scenario.ratios(mileage, seed)
    truth = {
        "vehicle": generator.vehicle.name,
        "generator": type(generator).__name__,
        "parts": list(getattr(generator, "parts", ())),
        "scatter": simulation.scatter,
        "seed": seed,
        "numbers": true_numbers(generator),
    }
    if aboard is not None:
        truth |= {"place": asdict(aboard.place(fleet.suspension)), "scenario": scenario.name}
    write = partial(_write_trip, fleet=fleet, generator=generator, seed=seed, aboard=aboard)
    with own_folder(folder):
        paths = [folder / f"{_name(i)}.yaml" for i in range(fleet.n_trips)]
        # a trip that lost a file is written again, as is one that was interrupted
        missing = [i for i, path in enumerate(paths) if not is_whole(path)]
        with unfinished(folder, made_from, fleet.n_trips, len(missing)):
            jobs = [(folder, i, float(mileage[i]), ratios[i]) for i in missing]
            _write_all(write, jobs, "trip", n_jobs, len(jobs), progress)
            write_json(folder / TRUTH, truth)
    return paths


def write_trains(
    folder: Path,
    trains: Trains,
    simulation: Simulation,
    *,
    n_jobs: int | None = 1,
    progress: bool = False,
) -> list[Path]:
    """Simulate the trips of every suspension of some trains, and return the suspensions' folders.

    Each has a subfolder, e.g. train_1_car_2_leading, written by `write_fleet`. Its own vehicle,
    payload and noise depend only on the seed and its place, so that adding a train changes none of
    them; those of a train share start, mileage, track and speed of each trip. ``truth.json`` lists
    those that wear; the others have the scenario's payload and spread only. A ``VerticalVehicle``
    is measured at the bogie of each suspension.
    """
    suspensions = trains.suspensions(simulation.seed)
    made_from = simulation.made_from(trains)
    write = partial(_write_suspension, simulation=simulation)
    truth = {
        **asdict(trains),
        "seed": simulation.seed,
        "scenario": simulation.scenario.name,
        "wearing": [suspension.name for suspension in suspensions if suspension.wears],
        "suspensions": [suspension.name for suspension in suspensions],
    }
    with own_folder(folder):
        missing = [own for own in suspensions if not is_finished(folder / own.name)]
        with unfinished(folder, made_from, trains.n_all, len(missing), "suspensions"):
            jobs = [(folder, suspension) for suspension in missing]
            n_trips = len(jobs) * simulation.fleet.n_trips
            _write_all(write, jobs, "suspension", n_jobs, n_trips, progress)
            write_json(folder / TRUTH, truth)
        return [folder / suspension.name for suspension in suspensions]


def _write_all(
    write: Callable[[Any], object],
    jobs: Sequence[Any],
    unit: str,
    n_jobs: int | None,
    n_trips: int,
    progress: bool,
) -> None:
    done = each(write, jobs, effective_n_jobs(workers_for(n_trips, n_jobs)))
    for _, outcome in progress_bar(f"{unit}s", len(jobs), items=done, unit=unit, shown=progress):
        if isinstance(outcome, LostWorkerError):
            raise outcome


def _write_suspension(work: tuple[Path, SimulatedSuspension], simulation: Simulation) -> None:
    folder, suspension = work
    # payload and spread remain, only the changes go
    if not suspension.wears:
        healthy = replace(simulation.scenario, name="healthy", changes={})
        simulation = replace(simulation, scenario=healthy)
    if isinstance(simulation.generator, VerticalVehicle):
        measured = replace(simulation.generator, bogie=suspension.bogie)
        simulation = replace(simulation, generator=measured)
    simulation = replace(simulation, seed=suspension.seed)
    write_fleet(folder / suspension.name, simulation, aboard=suspension)


def _name(index: int) -> str:
    return f"trip_{index + 1:03d}"


def _write_trip(
    trip: tuple[Path, int, float, FloatArray],
    fleet: Fleet,
    generator: ResponseGenerator,
    seed: int,
    aboard: SimulatedSuspension | None,
) -> Path:
    """Simulate one trip, write its manifest and files, and return the manifest's path.

    `trip`: folder, index, mileage [km] and the parameters relative to healthy.
    """
    folder, index, mileage_km, ratios = trip
    # Suspensions of a train share track and speed, drawn from the train's seed; noise is their own.
    track, noise, speeds, cross = np.random.SeedSequence([seed, index]).spawn(4)
    if aboard is not None:
        track, _, speeds, cross = np.random.SeedSequence([aboard.train_seed, index]).spawn(4)
    journey = fleet.journey_of(int(speeds.generate_state(1)[0]))
    # Simulate at the highest rate of the sensors; each signal is then resampled to its own rate.
    rate_hz = max(sensor.rate_hz for sensor in fleet.loggers().values())
    direction = fleet.direction_of(index)
    system = generator.running(direction).motion_system(torch.as_tensor(ratios))
    if fleet.sides == "left":
        system = _of_left_sensors(system)
    tracks = _profiles(fleet, system, journey, rate_hz, (track, cross, *cross.spawn(1)))
    mean = tracks.pop(0)
    cross_level, alignment = (*tracks, None, None)[:2]
    signals = simulate_trip(system, mean, journey, rate_hz, cross_level, alignment=alignment)
    del tracks, mean, cross_level, alignment  # as large as the signals
    name = _name(index)
    channels = _write_channels(folder, name, fleet, system, signals, rate_hz, noise)
    whole_s = np.arange(math.floor(journey.duration_s) + 1, dtype=np.float64)
    _write_columns(folder / name / "speed.parquet", {"speed": journey.at(whole_s)[1]})
    ends = {key: getattr(generator, key, None) for key in ("bogie", "axle")}
    manifest = TripManifest(
        path=folder / f"{name}.yaml",
        name=name,
        vehicle=generator.vehicle.name,
        suspension=fleet.suspension,
        direction=direction,
        # without a word they are taken as leading
        **{key: end for key, end in ends.items() if end == "trailing"},
        mileage_km=mileage_km,
        start=(aboard.first_start if aboard else FIRST_DAY) + time_between(fleet) * index,
        speed=SpeedSource(f"{name}/speed.parquet", "m/s", column="speed", rate_hz=1.0),
        channels=channels,
        truth=dict(zip(_outputs(generator), ratios.tolist(), strict=True)),
    )
    if aboard is not None:
        manifest = replace(manifest, train=aboard.train, car=aboard.car, bogie=aboard.bogie)
    return write_manifest(manifest)


def _profiles(
    fleet: Fleet,
    system: LinearSystem,
    journey: Journey,
    rate_hz: float,
    seeds: Sequence[np.random.SeedSequence],
) -> list[TrackProfile]:
    """Return the profile of the mean of both rails, and those of what else drives the system."""
    mean = track_spectrum(fleet.track)
    spectra = [mean]
    if system.roll_per_m:
        spectra.append(cross_level_spectrum(mean))
    if system.alignment:
        spectra.append(mean)
    length_m = profile_length_m(system, journey)
    step_m = float(journey.speeds_m_per_s.max()) / rate_hz
    return [
        make_profile(spectrum, length_m, step_m, int(seed.generate_state(1)[0]))
        for spectrum, seed in zip(spectra, seeds, strict=False)
    ]


def _write_channels(
    folder: Path,
    name: str,
    fleet: Fleet,
    system: LinearSystem,
    signals: FloatArray,
    rate_hz: float,
    noise: np.random.SeedSequence,
) -> dict[str, SensorSource | Pair]:
    """Write the sensors' recordings of signals (3 or 6, n_samples), and return their channels."""
    rng = np.random.default_rng(noise)
    sensors = fleet.loggers()
    channels: dict[str, SensorSource | Pair] = {}
    for i, channel in enumerate(CHANNELS):
        sensor, file = sensors[channel], f"{name}/{channel}.parquet"
        recorded = [
            sensor.record(_resampled(signal, rate_hz, sensor.rate_hz), rng).astype(np.float32)
            for signal in signals[i::3]
        ]
        source = SensorSource(file, "m/s2", rate_hz=sensor.rate_hz, range=sensor.range_m_per_s2)
        if len(recorded) == 1:
            columns = {"acceleration": recorded[0]}
            side = SIDES[0 if system.lateral_m[i] > 0 else 1] if system.lateral_m[i] else None
            channels[channel] = replace(source, column="acceleration", side=side)
        else:
            # at a negative position the first signal is that of the right side
            placed = recorded if system.lateral_m[i] >= 0 else recorded[::-1]
            columns = dict(zip(SIDES, placed, strict=True))
            left, right = (replace(source, column=side, side=side) for side in SIDES)
            channels[channel] = left, right
        _write_columns(folder / file, columns)
    return channels


def _check_sides(fleet: Fleet, generator: ResponseGenerator) -> None:
    moving = (*IN_MOTION, *ADDITIONS)
    outside = [part for part in getattr(generator, "parts", ()) if part not in moving]
    if outside:
        raise ValueError(
            f"`generator.parts` of simulated trips cannot be {' or '.join(outside)}: these are for "
            "reading trips"
        )
    healthy = torch.ones(len(_outputs(generator)))
    if fleet.sides == "both" and not generator.motion_system(healthy).roll_per_m:
        raise ValueError(
            "`sides`=both needs a vehicle with roll and sensors off the middle (generator=family "
            "sensor_lateral_m=[1,1,1]); leave `sides` out for one sensor at each place"
        )


def _outputs(generator: ResponseGenerator) -> tuple[str, ...]:
    names: tuple[str, ...] = getattr(generator, "outputs", PARAMETERS)
    return names


def _of_left_sensors(system: LinearSystem) -> LinearSystem:
    n = 3 if len(system.sensors) == 6 else 2
    direct = None if system.feedthrough is None else system.feedthrough[:n]
    return replace(system, sensors=system.sensors[:n], feedthrough=direct)


def _resampled(signal: FloatArray, from_hz: float, to_hz: float) -> FloatArray:
    ratio = Fraction(to_hz / from_hz).limit_denominator(1000)
    if ratio == 1:
        return signal.copy()
    return np.asarray(resample_poly(signal, ratio.numerator, ratio.denominator, window=ANTI_ALIAS))


def _write_columns(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    stream = io.BytesIO()
    options = {"row_group_size": ROW_GROUP, "use_dictionary": False}  # no value comes twice
    table = pa.table({name: _arrow_array(values) for name, values in columns.items()})
    pq.write_table(table, stream, **options)
    write_atomically(path, stream.getvalue())


def _arrow_array(values: NDArray[Any]) -> pa.Array:
    """Return numbers as an array of Arrow; `pa.array` imports pandas, which takes 0.3 s."""
    kind, buffer = pa.from_numpy_dtype(values.dtype), pa.py_buffer(np.ascontiguousarray(values))
    return pa.Array.from_buffers(kind, len(values), [None, buffer])
