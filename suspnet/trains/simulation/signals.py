"""The signals of one simulated trip: its journey, the vehicle's motion, and the recordings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.ndimage import shift

from suspnet.ground.settings import Setting, check_settings, setting
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.manifest_sources import ACCELERATION_UNITS
from suspnet.vehicle.motion import LinearSystem, SampledMotion
from suspnet.vehicle.track import TrackProfile

BLOCK = 1 << 18  # number of samples simulated at once
LEAD_IN_S = 20.0
"""Time simulated before a trip that starts at speed [s], in which the transient decays."""
MARGIN_M = 50.0  # length of track ahead of the first and behind the last wheelset [m]


def simulate_trip(
    system: LinearSystem,
    profile: TrackProfile,
    journey: Journey,
    rate_hz: float,
    cross: TrackProfile | None = None,
    alignment: TrackProfile | None = None,
) -> FloatArray:
    """Return accelerations of axle box, frame and body along a trip, shape (3, n_samples), [m/s^2].

    With sensors on both sides three more rows follow, those of the other side. The acceleration of
    a wheelset is v^2 r'' + a r' of the track r at its position. The vehicle's response is exact for
    inputs that are linear between samples, which makes sinc^2(f / rate) of each of them: a twelfth
    of their second difference is taken off beforehand, so that 2e-5 is missing at rate / 30.

    `profile` must be at least `profile_length_m` long. With roll, `cross` is an independent profile
    of `cross_level_spectrum`; the angle of the track is the system's `roll_per_m` times it. With
    lateral motion, the track's lateral place is the system's `alignment` times another profile.
    """
    motion = SampledMotion(system, rate_hz)
    n_lead = round(_lead_in_s(journey) * rate_hz)
    n_samples = math.floor(journey.duration_s * rate_hz + 1e-6)
    start_m = _start_m(system, journey)
    n_places = 3 if len(system.sensors) % 3 == 0 else 2  # 3: with the axle box
    n_sides = len(system.sensors) // n_places
    signals = np.empty((n_sides, 3, n_samples))
    measured = system.behind_m.index(min(system.behind_m, key=abs))
    possible = (profile, 1.0), (cross, system.roll_per_m), (alignment, system.alignment)
    tracks = [(track, scale) for track, scale in possible if track is not None]
    for first in range(-n_lead, n_samples, BLOCK):
        # with the samples before and after the block
        times = np.arange(first - 1, min(first + BLOCK, n_samples) + 1) / rate_hz
        position, speed, acceleration = journey.at(times)
        # Every wheelset follows the same track at its own position; its vertical acceleration, and
        # with roll its angular acceleration, drive the system.
        wheels = []
        for track, scale in tracks:
            squared, scaled = scale * speed**2, scale * acceleration
            for behind in system.behind_m:
                _, slope, curvature = track.at(start_m + position - behind)
                wheels.append(squared * curvature + scaled * slope)
        drives = [wheel[1:-1] - np.diff(wheel, 2) / 12 for wheel in wheels]
        wheels = [wheel[1:-1] for wheel in wheels]
        outputs = motion.advance(drives) + motion.direct @ np.subtract(wheels, drives)
        outputs = outputs.reshape(n_sides, n_places, len(wheels[0]))
        # The lead-in is not part of the trip.
        of_trip = slice(max(0, -first), None)
        place = slice(max(0, first), max(0, first + len(wheels[0])))
        signals[:, 3 - n_places :, place] = outputs[:, :, of_trip]
        if n_places == 3:
            continue
        signals[:, 0, place] = wheels[measured][of_trip]
        if cross is not None:
            angle = wheels[len(system.behind_m) + measured][of_trip]
            for side, sign in enumerate((1.0, -1.0)[:n_sides]):
                signals[side, 0, place] += sign * system.lateral_m[0] * angle
    return signals.reshape(3 * n_sides, n_samples)


def profile_length_m(system: LinearSystem, journey: Journey) -> float:
    """Return the length of track that a trip needs, [m]."""
    ahead = -min(system.behind_m)
    return _start_m(system, journey) + journey.distance_m + ahead + MARGIN_M


def _lead_in_s(journey: Journey) -> float:
    return LEAD_IN_S if journey.speeds_m_per_s[0] > 0 else 0.0


def _start_m(system: LinearSystem, journey: Journey) -> float:
    """Return the position of the measured wheelset on the track when the trip starts, [m]."""
    lead_m = _lead_in_s(journey) * float(journey.speeds_m_per_s[0])
    return max(system.behind_m) + lead_m + MARGIN_M


@dataclass(frozen=True, eq=False)
class Journey:
    """Speed, linear between instants, with its exact position and acceleration.

    `times_s`: ascending from 0 (n_instants,), `speeds_m_per_s`: (n_instants,), >= 0.
    """

    times_s: FloatArray
    speeds_m_per_s: FloatArray

    def __post_init__(self) -> None:
        times, speeds = self.times_s, self.speeds_m_per_s
        if times.ndim != 1 or times.shape != speeds.shape or len(times) < 2:
            raise ValueError("a journey needs at least two instants, each with a speed")
        if times[0] != 0 or not (np.diff(times) > 0).all():
            raise ValueError("the instants of a journey must ascend from 0")
        if not (np.isfinite(speeds).all() and (speeds >= 0).all() and speeds.max() > 0):
            raise ValueError("the speeds of a journey must be >= 0 and finite, one of them > 0")

    @property
    def duration_s(self) -> float:
        """Length of the journey, [s]."""
        return float(self.times_s[-1])

    @property
    def distance_m(self) -> float:
        """Distance covered, [m]."""
        return float(self.at(self.times_s[-1:])[0][0])

    def at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position [m], speed [m/s] and acceleration [m/s^2] at given times.

        The speed is constant before the first and after the last instant.
        """
        knots, speeds = self.times_s, self.speeds_m_per_s
        slopes = np.concatenate([[0.0], np.diff(speeds) / np.diff(knots), [0.0]])
        covered = np.cumsum(np.diff(knots) * 0.5 * (speeds[1:] + speeds[:-1]))
        positions = np.concatenate([[0.0, 0.0], covered])
        piece = np.searchsorted(knots, times_s, side="right")
        start = np.maximum(piece - 1, 0)
        elapsed = times_s - knots[start]
        acceleration = slopes[piece]
        speed = speeds[start] + acceleration * elapsed
        position = positions[start + 1] + (speeds[start] + 0.5 * acceleration * elapsed) * elapsed
        return position, speed, acceleration


def steady_journey(speed_m_per_s: float, duration_s: float) -> Journey:
    """Return a journey at constant speed."""
    return Journey(np.array([0.0, duration_s]), np.full(2, speed_m_per_s))


def service_journey(
    cruise_m_per_s: float, duration_s: float, n_stops: int, seed: int, ripple: float = 0.01
) -> Journey:
    """Return a journey from one station to another with `n_stops` stops between them.

    The train accelerates at 0.4 m/s^2, brakes at 0.6 m/s^2 and waits 2 minutes at each stop. At
    cruising speed the speed varies by the fraction `ripple` (rms, a new value every minute). About
    one section in five has 60 to 90 % of the cruising speed. Raises ValueError if the sections are
    too short to reach the cruising speed.
    """
    rng = np.random.default_rng(seed)
    stretch_s = (duration_s - 120.0 * n_stops) / (n_stops + 1)
    ramp_s = cruise_m_per_s / 0.4 + cruise_m_per_s / 0.6
    if stretch_s < ramp_s + 120:
        raise ValueError(
            f"{n_stops} stops in {duration_s:g} s leave {stretch_s:.0f} s between them; speeding "
            f"up to {cruise_m_per_s:g} m/s and braking take {ramp_s:.0f} s"
        )
    times, speeds = [0.0], [0.0]
    for stop in range(n_stops + 1):
        top = cruise_m_per_s * (rng.uniform(0.6, 0.9) if rng.random() < 0.2 else 1.0)
        start = times[-1]
        cruise = np.arange(start + top / 0.4, start + stretch_s - top / 0.6, 60.0)
        times += [*cruise, start + stretch_s]
        wander = 1 + ripple * rng.standard_normal(len(cruise))
        speeds += [*np.minimum(top * wander, cruise_m_per_s), 0.0]
        # Hold the last cruising speed until braking has to start.
        times.insert(-1, start + stretch_s - speeds[-2] / 0.6)
        speeds.insert(-1, speeds[-2])
        if stop < n_stops:
            times.append(times[-1] + 120.0)
            speeds.append(0.0)
    # instants that coincide have no slope between them
    ascending = np.concatenate([[True], np.diff(times) > 1e-6])
    return Journey(np.array(times)[ascending], np.array(speeds)[ascending])


@dataclass(frozen=True)
class Sensor:
    """One accelerometer and its data logger."""

    rate_hz: Annotated[
        float, Setting("Sampling rate of the axle box's sensor", "Hz", above=0, most=1e6)
    ]
    snr_db: float | None = setting(
        34.0, "White noise relative to the signal; null is none", "dB", low=-20, high=200
    )
    range_g: float | None = setting(
        None,
        "Acceleration beyond which the signal is cut off, 2 in Table VII; null is no limit",
        "g",
        above=0,
        most=1e6,
    )
    precision: float = setting(
        0.0, "White noise relative to range_g, 0.001 in Table VII", low=0, most=100000
    )
    gain: float = setting(
        1.0,
        "What is recorded of an acceleration of 1, 1.02 for a sensitivity that is 2 % too high",
        above=0,
        most=1000,
    )
    clock_offset_s: float = setting(
        0.0,
        "Delay of the sensor or its clock, which the manifest does not state",
        "s",
        low=-1e6,
        most=1e6,
    )

    def __post_init__(self) -> None:
        check_settings(self, "sensor")
        if self.precision > 0 and self.range_g is None:
            raise ValueError("sensor `precision` is relative to `range_g`, which is not given")

    @property
    def range_m_per_s2(self) -> float | None:
        """The largest acceleration that can be recorded, [m/s^2]."""
        return None if self.range_g is None else self.range_g * ACCELERATION_UNITS["g"]

    def record(self, signal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the recording of an acceleration [m/s^2] sampled at `rate_hz`, (n_samples,)."""
        signal, noise = self.gain * signal, 0.0
        if self.snr_db is not None:
            noise = float(np.sqrt(np.mean(signal**2))) * 10 ** (-self.snr_db / 20)
        full_scale = self.range_m_per_s2 or math.inf
        if self.precision > 0:
            noise = math.hypot(noise, self.precision * full_scale)
        delay = self.clock_offset_s * self.rate_hz
        late = np.arange(len(signal)) - round(delay)
        recorded: FloatArray = signal[late.clip(0, len(signal) - 1)]
        if delay != round(delay):  # the rest of a sample, by cubic splines
            recorded = shift(recorded, delay - round(delay), mode="nearest")
        recorded += noise * rng.standard_normal(len(signal))
        np.clip(recorded, -full_scale, full_scale, out=recorded)
        return recorded
