"""Noise, sensitivity and delay of a sensor as one trip shows them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from vehicles import AM96

from suspnet.curves.welch import Welch
from suspnet.trains.recordings.cleaning import Fault
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.sensors.sensor_health import sensor_health
from suspnet.trains.simulation.signals import profile_length_m, simulate_trip, steady_journey
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.track import cross_level_spectrum, make_profile, track_spectrum

RATE_HZ, SPEED, MINUTES = 100.0, 60.0, 10
MANIFEST = TripManifest(
    path=Path("trip.yaml"),
    name="trip",
    vehicle="",
    suspension="",
    mileage_km=0,
    speed=1,
    channels={},
)
PAIRED = VerticalVehicle(
    AM96, speed_m_per_s=SPEED, parts=("bending", "roll"), sensor_lateral_m=(1.0, 1.0, 1.0)
)
SINGLE = VerticalVehicle(AM96, speed_m_per_s=SPEED)
NOISE = {"axle_box": 0.1, "bogie": 0.05, "body": 0.01}
"""Standard deviation of each sensor's noise, [m/s^2]."""


def recorded(generator, ratios=(1.0,) * 5):
    """Return the recording of one trip, made once for each vehicle."""
    system = generator.motion_system(torch.tensor(ratios))
    journey = steady_journey(SPEED, 60.0 * MINUTES)
    mean = track_spectrum("german_low")
    spectra = [mean, cross_level_spectrum(mean)] if system.roll_per_m else [mean]
    length_m, step_m = profile_length_m(system, journey), SPEED / RATE_HZ / 2
    tracks = [make_profile(one, length_m, step_m, seed) for seed, one in enumerate(spectra)]
    signals = simulate_trip(system, tracks[0], journey, RATE_HZ, *tracks[1:])
    rng = np.random.default_rng(0)
    for i, one in enumerate(signals):
        one += NOISE[CHANNELS[i % 3]] * rng.standard_normal(len(one))
    return with_sensors(signals)


def with_sensors(signals):
    """Return a recording of three sensors, or of six: those on the left, then on the right."""
    n, sides = signals.shape[1], ("left", "right") if len(signals) > 3 else ("",)
    names = [f"{name} {side}".strip() for side in sides for name in CHANNELS]
    values = {name: signals[names.index(name)] for name in sorted(names)}
    usable, speed = np.ones(n, dtype=bool), np.full(n, SPEED)
    return Recording(MANIFEST, RATE_HZ, values, usable, speed, (), n / RATE_HZ)


@pytest.fixture(scope="module", params=[PAIRED, SINGLE], ids=["pairs", "single"])
def trip(request):
    """A healthy trip with its vehicle, and what its sensors show."""
    recording = recorded(request.param)
    return recording, request.param, sensor_health(recording, request.param, Welch())


def changed(recording, sensor, change):
    """Return a recording with one sensor's signal changed."""
    found = recording.sensors()
    found[sensor] = change(found[sensor])
    rows = list(found.values())
    return with_sensors(np.stack(rows[::2] + rows[1::2] if len(rows) > 3 else rows))


def test_noise_is_that_of_the_sensor(trip):
    recording, generator, healthy = trip
    for name, one in healthy.items():
        place = name.split()[0]
        density = NOISE[place] / np.sqrt(RATE_HZ / 2)
        assert one.noise > 0.8 * density
        if name == "body":  # elsewhere motion that the others do not share, as leakage, is more
            assert one.noise < 1.5 * density
        rng = np.random.default_rng(1)
        more = 4 * one.noise * np.sqrt(RATE_HZ / 2)
        noisy = changed(recording, name, lambda x, m=more, r=rng: x + m * r.standard_normal(len(x)))
        found = sensor_health(noisy, generator, Welch())
        share = found[name].noise / (np.sqrt(17) * one.noise)
        # where the floor was unshared motion, the noise is measured in other bins than that
        assert (0.85 if name == "body" else 0.65) < share < 1.15
        others = [found[n].noise / healthy[n].noise for n in healthy if n != name]
        assert 0.5 < min(others) < max(others) < 1.6  # no other seems to fail


@pytest.mark.parametrize(
    ("number", "change", "size", "tolerance"),
    [
        ("gain", lambda x: 1.1 * x, np.log(1.1), 0.02),
        ("delay_s", lambda x: np.roll(x, 1), 0.01, 5e-3),
    ],
    ids=["gain", "delay"],
)
def test_gain_and_delay_are_those_against_the_others(trip, number, change, size, tolerance):
    recording, generator, healthy = trip
    for name in healthy:
        found = sensor_health(changed(recording, name, change), generator, Welch())
        away = {n: getattr(found[n], number) - getattr(healthy[n], number) for n in healthy}
        if name == "body":  # nothing to compare it with
            assert np.isnan(away[name])
            continue
        fellows = [n for n in away if n != name and (n[:4] == "body") == (name[:4] == "body")]
        apart = [away[name] - away[n] for n in fellows]
        np.testing.assert_allclose(apart, size, atol=tolerance)
        if number == "gain":
            assert all(abs(found[n].tilt - healthy[n].tilt) < 0.02 for n in (name, *fellows))


def test_a_worn_part_is_no_gain(trip):
    _, generator, healthy = trip
    worn = sensor_health(recorded(generator, (0.7, 0.5, 1.3, 0.6, 1.2)), generator, Welch())
    for name, one in healthy.items():
        if name != "body":
            assert abs(worn[name].gain - one.gain) < 0.05


def test_dropouts_are_counted_for_their_sensor(trip):
    recording, generator, healthy = trip
    name = next(iter(healthy))
    lost = Fault(name, "gap", 600, 6.0, 0.0, False), Fault(name, "offset", 9, 600.0, 0.0, True)
    found = sensor_health(replace(recording, faults=lost), generator, Welch())
    assert {n: one.faulty for n, one in found.items()} == {
        n: 0.01 if n == name else 0.0 for n in healthy
    }


def test_a_trip_too_short_has_drop_outs_alone(trip):
    recording, generator, _ = trip
    short = replace(recording, usable=np.arange(recording.signals.shape[1]) < 5000)
    for one in sensor_health(short, generator, Welch()).values():
        assert np.isnan([one.noise, one.gain]).all()
        assert one.faulty == 0.0
