"""The motion of one simulated trip: track and journey -> what the places of the sensors feel."""

from __future__ import annotations

import math

import numpy as np

from suspnet.dynamics.journey import Journey
from suspnet.dynamics.motion import LinearSystem, SampledMotion
from suspnet.dynamics.track import TrackProfile
from suspnet.ground.types import FloatArray

BLOCK = 1 << 18
"""Number of samples simulated at once."""
LEAD_IN_S = 20.0
"""Time simulated before a trip that starts at speed [s], in which the transient decays."""
MARGIN_M = 50.0
"""Length of track before the first and behind the last wheelset [m]."""


def simulate_trip(
    system: LinearSystem,
    profile: TrackProfile,
    journey: Journey,
    rate_hz: float,
    cross: TrackProfile | None = None,
) -> FloatArray:
    """Return accelerations of axle box, frame and body along a trip, shape (3, n_samples), [m/s^2].

    With sensors on both sides three more rows follow, those of the other side.

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
    cross : TrackProfile, optional
        With roll: an independent profile of `cross_level_spectrum`, which times the system's
        `roll_per_m` is the angle of the track.
    """
    motion = SampledMotion(system, rate_hz)
    n_lead = round(_lead_in_s(journey) * rate_hz)
    n_samples = math.floor(journey.duration_s * rate_hz + 1e-6)
    start_m = _start_m(system, journey)
    n_sides = len(system.sensors) // 2
    signals = np.empty((n_sides, 3, n_samples))
    measured = system.behind_m.index(min(system.behind_m, key=abs))
    tracks = [(profile, 1.0)] + ([] if cross is None else [(cross, system.roll_per_m)])
    for first in range(-n_lead, n_samples, BLOCK):
        times = np.arange(first, min(first + BLOCK, n_samples)) / rate_hz
        position, speed, acceleration = journey.at(times)
        wheels = []
        for track, scale in tracks:
            squared, scaled = scale * speed**2, scale * acceleration
            for behind in system.behind_m:
                _, slope, curvature = track.at(start_m + position - behind)
                wheels.append(squared * curvature + scaled * slope)
        outputs = motion.advance(wheels).reshape(n_sides, 2, len(times))
        kept = slice(max(0, -first), None)
        place = slice(max(0, first), max(0, first + len(times)))
        signals[:, 0, place] = wheels[measured][kept]
        if cross is not None:
            angle = wheels[len(system.behind_m) + measured][kept]
            for side, sign in enumerate((1.0, -1.0)[:n_sides]):
                signals[side, 0, place] += sign * system.lateral_m[0] * angle
        signals[:, 1:, place] = outputs[:, :, kept]
    return signals.reshape(3 * n_sides, n_samples)


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
