"""Trips of rich trains on disk, with sensors on both sides."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from fractions import Fraction

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from joblib import Parallel, delayed
from rich_line import Wheels, of_the_trip, rough_profiles, wandering_journey
from rich_modes import simulate_modes
from rich_motion import simulate
from rich_sensors import own_sensor, recorded
from rich_spectra import process_spectra
from rich_structure import ALL_SENSORS
from rich_trips import DRIFT
from scipy.signal import resample_poly
from vehicles import AM96

from suspnet.ground.parameters import FORWARD, REVERSE
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_files import write_manifest
from suspnet.trains.recordings.manifest_sources import SensorSource, SpeedSource
from suspnet.trains.simulation.fleet import FIRST_DAY
from suspnet.trains.simulation.signals import LEAD_IN_S, MARGIN_M, Journey
from suspnet.trains.simulation.writing import ANTI_ALIAS, time_between
from suspnet.vehicle import PARAMETERS
from suspnet.vehicle.track import make_profile

SIDES = ("left", "right")
WRITTEN = ("pair", "mean", *SIDES)
TOGETHER = 24
"""Trips stepped at once: 350 MB of 20 minutes at 250 Hz."""


def write_train_trips(
    folder,
    train,
    ratios,
    fleet,
    seed,
    sides="pair",
    speeds_m_per_s=None,
    rate_hz=None,
    n_jobs=1,
    roughness=None,
):
    """Simulate trips, write each as ``write_fleet`` does, and return the manifests.

    Parameters
    ----------
    folder : Path
    train : RichTrain
        Of all trips; its speed is replaced by that of each, and it runs as the fleet says.
    ratios : array of shape (n_trips, 5) or (n_trips, 13), [-]
        ``PARAMETERS``, or each of rich_structure.PARTS and M_s, relative to the train's own, M_s to
        nominal.
    fleet : Fleet
    seed : int
        Trip i draws track, noise, journey and its rough effects from (seed, i) alone.
    sides : {"pair", "mean", "left", "right"}
        "pair" has lists of two sensors as channels, "mean" writes their average as one sensor's.
    speeds_m_per_s : sequence of float, optional, [m/s]
        Of each trip, in place of the fleet's.
    rate_hz : float, optional, [Hz]
        Of the steps; the fastest sensor's if not given.
    n_jobs : int
        Trips at the same time. Trains with nonlinear laws are stepped together.
    roughness : sequence of float, optional, [-]
        Amplitude of the track of each trip over the fleet's.
    """
    if sides not in WRITTEN:
        raise ValueError(f"`sides` must be one of {WRITTEN}, got {sides!r}")
    if "wheelsets" in train.effects:
        raise ValueError("`wheelsets` are for spectra (rich_spectra.py): ask for out_of_round")
    ratios = np.asarray(ratios, dtype=float)
    rate_hz = rate_hz or max(sensor.rate_hz for sensor in fleet.loggers().values())
    speeds = [fleet.speed_m_per_s] * len(ratios) if speeds_m_per_s is None else speeds_m_per_s
    sources = [np.random.SeedSequence([seed, i]).spawn(4) for i in range(len(ratios))]
    trains, warm = zip(*(of_the_trip(train, _rng(own[3])) for own in sources), strict=True)
    rough = [1.0] * len(ratios) if roughness is None else roughness
    if fleet.direction != FORWARD:
        ways = [fleet.direction_of(i) == REVERSE for i in range(len(trains))]
        trains = [replace(own, reverse=way) for own, way in zip(trains, ways, strict=True)]
    drives = [
        Drive(own.at(v), replace(fleet, speed_m_per_s=float(v)), rate_hz, track, journey, by)
        for own, v, by, (track, _, journey, _) in zip(trains, speeds, rough, sources, strict=True)
    ]

    def write(i, signals):
        rngs = _rng(sources[i][1]), _rng(sources[i][3]).spawn(len(ALL_SENSORS))
        return _write(folder, fleet, i, ratios[i], drives[i], signals, sides, rngs, warm[i])

    if train.is_linear:
        jobs = (
            delayed(lambda i: write(i, drives[i].motion(ratios[i])))(i) for i in range(len(ratios))
        )
        return Parallel(n_jobs=n_jobs)(jobs)
    manifests = []
    for first in range(0, len(ratios), TOGETHER):
        some = slice(first, first + TOGETHER)
        trains, tracks = zip(*((one.train, one.track()) for one in drives[some]), strict=True)
        n_samples, n_lead = drives[0].n_samples, max(one.n_lead for one in drives)
        found = simulate(ratios[some], trains, tracks, rate_hz, n_samples, n_lead)
        manifests += [write(first + i, signals) for i, signals in enumerate(found)]
    return manifests


class Drive:
    """A train on its way: the journey, and the track under all wheelsets.

    Parameters
    ----------
    train : RichTrain
        At the speed of the journey; creep keeps this speed throughout.
    fleet : Fleet
        With the speed of this trip.
    rate_hz : float, [Hz]
    track, journey : SeedSequence
    roughness : float, [-]
        Amplitude of the track over the fleet's.
    """

    def __init__(self, train, fleet, rate_hz, track, journey, roughness=1.0):
        self.roughness = roughness
        self.train, self.fleet, self.rate_hz = train, fleet, rate_hz
        self.journey, self._source = self._journey(journey), track
        moving = self.journey.speeds_m_per_s[0] > 0
        self.n_samples = math.floor(self.journey.duration_s * rate_hz + 1e-6)
        self.n_lead = round(LEAD_IN_S * rate_hz) if moving else 0

    def motion(self, ratios):
        """Return the accelerations under all sensors, (6, n_samples), of a linear train."""
        matrices = self.train.matrices(ratios)
        return simulate_modes(matrices, self.track(), self.rate_hz, self.n_samples, self.n_lead)

    def track(self):
        """Return what gives elevation, velocity and acceleration of all inputs at any times."""
        behind_m = self.train.behind_m
        top = float(self.journey.speeds_m_per_s.max())
        start_m = max(behind_m.max(), 0.0) + LEAD_IN_S * top + MARGIN_M
        length_m = start_m + self.journey.distance_m - min(behind_m.min(), 0.0) + MARGIN_M
        densities = process_spectra(self.train, self.fleet.track)
        seeds = self._source.generate_state(len(densities))
        profiles = [
            make_profile(density, length_m, top / self.rate_hz, int(seed))
            for density, seed in zip(densities, seeds, strict=True)
        ]
        effects = self.train.effects
        if effects & {"changing_roughness", "welds", "crossings"}:
            profiles = rough_profiles(profiles, effects, _rng([*seeds, 1]))
        wheels = None
        if "out_of_round" in effects:
            wheels = Wheels(self.train.wheel_radius_m, _rng(self.train.wheels_seed))

        def inputs(times):
            position, speed, acceleration = self.journey.at(times)
            places = start_m + position - behind_m[:, None]
            profile = [p.at(places) for p in profiles]
            if wheels is not None:
                turned = np.broadcast_to(position, behind_m.shape + position.shape)
                added = wheels.at(turned)
                added /= self.roughness  # it is of the track alone
                profile[:2] = [p + own for p, own in zip(profile, added, strict=False)]
            r, slope, curvature = np.concatenate(profile, axis=1)
            motion = np.stack([r, slope * speed, curvature * speed**2 + slope * acceleration])
            return self.roughness * motion

        return inputs

    def _journey(self, source):
        """Return the fleet's journey, or one whose speed drifts up or down."""
        if "wander" in self.train.effects:
            duration_s = 60 * self.fleet.minutes
            return wandering_journey(self.fleet.speed_m_per_s, duration_s, _rng(source))
        if "drift" not in self.train.effects:
            return self.fleet.journey_of(int(source.generate_state(1)[0]))
        drift = DRIFT * np.random.default_rng(source).choice([-1.0, 1.0])
        speeds = self.fleet.speed_m_per_s * np.array([1.0, 1.0 + drift])
        return Journey(np.array([0.0, 60 * self.fleet.minutes]), speeds)


def true_ratios(train, ratios, sides):
    """Return what a trip's estimates should be, {name: ratio}.

    Where one side wears, the left, a pair sees the mean of both; of thirteen ratios the mean of
    each kind.
    """
    ratios = np.array(ratios, dtype=float)
    if len(ratios) > len(PARAMETERS):
        kinds = ratios[0:8:2], ratios[1:8:2], ratios[8:12:2], ratios[9:12:2], ratios[12]
        ratios = np.array([np.mean(kind) for kind in kinds])
    if "one_side" in train.effects:
        share = {"left": 1.0, "right": 0.0}.get(sides, 0.5)
        ratios[:4] = 1 + share * (ratios[:4] - 1)
    return dict(zip(PARAMETERS, ratios.tolist(), strict=True))


def _write(folder, fleet, index, ratios, drive, signals, sides, rngs, temperature_c):
    """Write the files of one trip and return its manifest."""
    name, channels = f"trip_{index + 1:03d}", {}
    (folder / name).mkdir(parents=True)
    loggers, train, (rng, own_rngs) = fleet.loggers(), drive.train, rngs
    for kind, (channel, sensor) in enumerate(loggers.items()):
        ratio = Fraction(sensor.rate_hz / drive.rate_hz).limit_denominator(1000)
        found = {}
        for place, signal in zip(train.sensors, signals, strict=True):
            if not place.startswith(channel):
                continue
            if ratio != 1:
                up, down = ratio.numerator, ratio.denominator
                signal = resample_poly(signal, up, down, window=ANTI_ALIAS)
            signal = own_sensor(train, sensor, place).record(signal, rng)
            own_rng = own_rngs[ALL_SENSORS.index(place)]
            signal = recorded(train.effects, kind, signal, sensor.rate_hz, own_rng)
            found[place.removeprefix(channel).strip()] = signal
        if sides == "mean":
            found = {"mean": sum(found.values()) / 2}
        file = f"{name}/{channel}.parquet"
        _write_columns(folder / file, found)
        channels[channel] = [_source(file, column, sensor.rate_hz) for column in found]
    seconds = np.arange(math.floor(drive.journey.duration_s) + 1.0)
    _write_columns(folder / name / "speed.parquet", {"speed": drive.journey.at(seconds)[1]})
    chosen = {
        name: replace(found[sides == "right"], side=sides if sides in SIDES else None)
        for name, found in channels.items()
        if sides != "pair"
    }
    path = write_manifest(
        TripManifest(
            path=folder / f"{name}.yaml",
            name=name,
            vehicle=AM96.name,
            suspension=fleet.suspension,
            mileage_km=float(fleet.mileage_km()[index]),
            start=FIRST_DAY + time_between(fleet) * index,
            temperature_c=temperature_c,
            direction=REVERSE if train.reverse else None,
            speed=SpeedSource(f"{name}/speed.parquet", "m/s", column="speed", rate_hz=1.0),
            channels=chosen or {name: found[0] for name, found in channels.items()},
            truth=true_ratios(train, ratios, sides),
        )
    )
    if sides == "pair":
        content = yaml.safe_load(path.read_text())
        content["channels"] = {
            name: [{k: v for k, v in asdict(one).items() if v is not None} for one in found]
            for name, found in channels.items()
        }
        path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    return path


def _source(file, column, rate_hz):
    """Return where a sensor is stored, by the words of its place but for the channel."""
    *axle, side = column.split()
    place = {"side": side} if side in (*SIDES, "middle") else {}
    place |= {"axle": int(axle[0])} if axle else {}
    return SensorSource(file, "m/s2", column=column, rate_hz=rate_hz, **place)


def _rng(source):
    return np.random.default_rng(source)


def _write_columns(path, columns):
    pq.write_table(pa.table({k: v.astype(np.float32) for k, v in columns.items()}), path)
