"""Speed along a trip: steady, or a journey with a start, cruising and stops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspnet.ground.types import FloatArray


@dataclass(frozen=True, eq=False)
class Journey:
    """Speed as straight lines between instants; position and acceleration follow exactly.

    Attributes
    ----------
    times_s : array of shape (n_instants,), [s]
        Ascending, from 0.
    speeds_m_per_s : array of shape (n_instants,), [m/s]

    Raises
    ------
    ValueError
        If the instants do not ascend from 0 or a speed is negative.
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

        Before the first and after the last instant the speed stays what it is there.
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
    """Return a journey at one speed."""
    return Journey(np.array([0.0, duration_s]), np.full(2, speed_m_per_s))


def service_journey(
    cruise_m_per_s: float, duration_s: float, n_stops: int, seed: int, ripple: float = 0.01
) -> Journey:
    """Return a journey that starts from a station, cruises, calls at stops and ends at one.

    The train gathers speed at 0.4 m/s^2, brakes at 0.6 m/s^2, waits 2 minutes; while cruising the
    speed wanders by `ripple` (rms, a new value every minute). Every fifth stretch or so is run at
    60 to 90 % of the cruising speed.

    Parameters
    ----------
    cruise_m_per_s : float, [m/s]
    duration_s : float, [s]
    n_stops : int
        Between the first and the last station.
    seed : int
    ripple : float, [-]

    Raises
    ------
    ValueError
        If the stretches between stops are too short to reach the cruising speed.
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
        begin = times[-1]
        cruise = np.arange(begin + top / 0.4, begin + stretch_s - top / 0.6, 60.0)
        times += [*cruise, begin + stretch_s]
        wander = 1 + ripple * rng.standard_normal(len(cruise))
        speeds += [*np.minimum(top * wander, cruise_m_per_s), 0.0]
        # brake from the last cruising speed only where braking has to begin
        times.insert(-1, begin + stretch_s - speeds[-2] / 0.6)
        speeds.insert(-1, speeds[-2])
        if stop < n_stops:
            times.append(times[-1] + 120.0)
            speeds.append(0.0)
    ascending = np.concatenate([[True], np.diff(times) > 1e-6])
    return Journey(np.array(times)[ascending], np.array(speeds)[ascending])
