"""What a rough train meets on its way: unevenness that changes, welds, wheels, speed, weather.

Numbers without a source are assumed. Everything is drawn for each trip, but for the wheels, which
belong to the train.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from suspnet.trains.simulation.signals import Journey

ROUGHNESS_LOG, ROUGHNESS_M = 0.35, 600.0
"""Standard deviation of the logarithm of the unevenness, and the distance over which it changes."""
WELD_M, WELD_EVERY_M, WELD_HALF_M = 1.5e-4, 36.0, 0.35
"""Standard deviation of the height of rail welds, their distance, and sigma of their bell shape."""
CROSSING_M, CROSSING_EVERY_M, CROSSING_HALF_M = 1.5e-3, 3000.0, 0.6
"""Depth of crossings, on one of the rails, their distance and sigma of their bell shape."""
CROSSING_ASIDE = 0.5
"""How far the check rail pulls the wheelset aside, over the crossing's depth."""
ROUND_M, ORDERS = 5e-5, 5
"""Standard deviation of each order of a wheel's radius; orders of 1 to 5 are those of long waves in
the survey of Nielsen and Johansson, Proc. IMechE F 214, 2000."""
RAMP, WANDER, WANDER_S = 0.06, 0.006, 60.0
"""Largest change of the speed over a trip, its wandering, and how often it turns: an
automatic control keeps it within 1 to 2 km/h."""
TEMPERATURES_C, NORMAL_C, DAMPING_PER_C = (-5.0, 33.0), 15.0, 0.004
"""Outside temperatures, that of the train's own numbers, and what dampers lose by a degree."""
LOAD_SHARE, LOAD_ALONG_M, LOAD_ASIDE_M = 0.2, 1.25, 0.1
"""Share of passengers in the body's mass, and standard deviations of where their mean is: 80 seats
drawn independently have 0.8 and 0.1 m."""


def of_the_trip(train, rng):
    """Return the train with the load and the temperature of a trip, and the temperature [°C]."""
    warm, along, aside = rng.uniform(*TEMPERATURES_C), *rng.standard_normal(2)
    changes = {}
    if "load_shift" in train.effects:
        changes = {
            "load_x_m": LOAD_SHARE * LOAD_ALONG_M * along,
            "load_y_m": LOAD_SHARE * LOAD_ASIDE_M * aside,
        }
    if "heat" not in train.effects:
        return replace(train, **changes), None
    thin = 1 - DAMPING_PER_C * (warm - NORMAL_C)
    changes["c_p"] = thin * train.c_p
    if "air_spring" not in train.effects:  # a choke has no oil
        changes["c_s"] = thin * train.c_s
    return replace(train, **changes), round(warm, 1)


def wandering_journey(speed_m_per_s, duration_s, rng):
    """Return a journey whose speed ramps and wanders about its mean."""
    times = np.linspace(0.0, duration_s, max(2, round(duration_s / WANDER_S) + 1))
    ramp = rng.uniform(-RAMP, RAMP) * (times / duration_s - 0.5)
    return Journey(times, speed_m_per_s * (1 + ramp + WANDER * rng.standard_normal(len(times))))


def rough_profiles(profiles, effects, rng):
    """Return the profiles of the mean, or of mean, cross level and alignment, with line effects."""
    changing, welds, crossings = rng.spawn(3)
    x = profiles[0].step_m * np.arange(len(profiles[0].elevation_m))
    waves = np.array([[p.elevation_m, p.slope, p.curvature_per_m] for p in profiles])
    if "changing_roughness" in effects:
        knots = np.arange(0.0, x[-1] + 2 * ROUGHNESS_M, ROUGHNESS_M)
        level = CubicSpline(knots, ROUGHNESS_LOG * changing.standard_normal(len(knots)))
        size, rise = np.exp(level(x)), level(x, 1)
        bend = level(x, 2) + rise**2
        z, slope, curvature = waves.swapaxes(0, 1)
        products = [z, slope + rise * z, curvature + 2 * rise * slope + bend * z]
        waves = size * np.array(products).swapaxes(0, 1)
    if "welds" in effects:
        places = np.arange(WELD_EVERY_M, x[-1], WELD_EVERY_M)
        left, right = WELD_M * welds.standard_normal((2, len(places)))
        _add(waves, x, places, [(left + right) / 2, (left - right) / 2, 0 * left], WELD_HALF_M)
    if "crossings" in effects:
        n = crossings.poisson(x[-1] / CROSSING_EVERY_M)
        places, side = crossings.uniform(0, x[-1], n), crossings.choice([-1.0, 1.0], n)
        depth = CROSSING_M * crossings.uniform(0.5, 1.5, n)
        sizes = [-depth / 2, -side * depth / 2, CROSSING_ASIDE * side * depth]
        _add(waves, x, places, sizes, CROSSING_HALF_M)
    return [
        replace(profile, elevation_m=z, slope=slope, curvature_per_m=curvature)
        for profile, (z, slope, curvature) in zip(profiles, waves, strict=True)
    ]


def _add(waves, x, places, sizes, half_m):
    """Add bells of each process at places, in place."""
    step = x[1] - x[0]
    reach = math.ceil(6 * half_m / step)
    for i, place in enumerate(places):
        middle = round(place / step)
        here = slice(max(0, middle - reach), middle + reach + 1)
        u = (x[here] - place) / half_m
        bell = np.exp(-(u**2) / 2)
        shape = np.array([bell, -u / half_m * bell, (u**2 - 1) / half_m**2 * bell])
        for wave, size in zip(waves, sizes, strict=False):
            wave[:, here] += size[i] * shape


class Wheels:
    """Wheels out of round, each wheelset with its own: both of its wheels alike by two thirds."""

    def __init__(self, radius_m, rng):
        sides = ROUND_M * math.sqrt(2) * rng.standard_normal((2, 4, ORDERS))  # of a cosine: rms
        left, right = np.sqrt(2 / 3) * sides[0] + np.sqrt(1 / 3) * sides[1] * [[[1]], [[-1]]]
        self._sizes = (left + right) / 2, (left - right) / 2  # mean and cross level
        self._phases = rng.uniform(0, 2 * math.pi, (4, ORDERS))
        self._per_m = np.arange(1, ORDERS + 1) / radius_m

    def at(self, x):
        """Return what the wheels add at positions (4, n_times): (2 processes, 3, 4, n_times)."""
        turn = self._per_m[:, None] * x[:, None] + self._phases[..., None]
        k = self._per_m[:, None]
        waves = np.array([np.cos(turn), -k * np.sin(turn), -(k**2) * np.cos(turn)])
        return np.array([np.einsum("wo,dwon->dwn", size, waves) for size in self._sizes])
