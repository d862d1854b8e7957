"""Sensors that come loose during a trip are named with the time; intact ones never are."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from trip_fixtures import RATES_HZ, changed, signal, write_trips
from vehicles import AM96

from suspnet.trains.recordings import dead_sensors
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import load_recording
from suspnet.trains.simulation.fleet import Fleet, Scenario
from suspnet.trains.simulation.writing import Simulation, write_fleet
from suspnet.vehicle import VerticalVehicle

ROLLING = ("bushings", "rubber", "guidance", "longitudinal", "bending", "roll")
RATE = dict(zip(CHANNELS, RATES_HZ, strict=True))
COMMON_HZ = 100.0
KINDS = ("noise", "nearly constant", "hum", "traction hum", "loud noise")


def find_loose(*known):
    """Return the faults, where any sensor is loose, and where motion is too weak."""
    faults, loose, silent = dead_sensors.find_loose(*known)
    return faults, loose.any(axis=0), silent


def nothing(kind, values, rate_hz, seed=0):
    """Return what a sensor shows whose cable is loose, in place of its values."""
    rng, rms, n = np.random.default_rng([seed, KINDS.index(kind)]), values.std(), len(values)
    white, at_s = rng.standard_normal(n), np.arange(n) / rate_hz
    return {
        "noise": 0.02 * rms * white,  # the 34 dB of the simulated sensors
        "nearly constant": 0.3 * rms + 1e-4 * rms * white,
        "hum": 0.5 * rms * np.sin(2 * np.pi * 50 * at_s) + 1e-3 * rms * white,
        "traction hum": 0.2 * rms * np.sin(2 * np.pi * 16.7 * at_s) + 1e-3 * rms * white,
        "loud noise": rms * white,
    }[kind]


def loosened(values, kind, rate_hz, *stretches):
    """Return a signal that shows nothing in some stretches, [s]."""
    values = values.astype(float)
    for seed, (start_s, stop_s) in enumerate(stretches):
        part = slice(round(start_s * rate_hz), round(stop_s * rate_hz))
        values[part] = nothing(kind, values[part], rate_hz, seed)
    return values


@pytest.fixture(scope="module")
def ten_minutes(tmp_path_factory):
    """A healthy trip of 10 minutes with three sensors."""
    return write_trips(tmp_path_factory.mktemp("ten_minutes"), minutes=10.0)[0]


@cache
def loaded(manifest):
    return load_recording(read_manifest(manifest))


def at_s(recording):
    return recording.start_s + np.arange(len(recording.usable)) / COMMON_HZ


@pytest.mark.parametrize(
    ("channel", "kind", "stretches"),
    [
        ("body", "hum", [(0, 300)]),
        ("bogie", "noise", [(200, 230), (380, 420)]),
        pytest.param("axle_box", "nearly constant", [(180, 600)], marks=pytest.mark.slow),
    ],
)
def test_loose_sensor_is_named_with_its_times(ten_minutes, tmp_path, channel, kind, stretches):
    values = loosened(signal(ten_minutes, channel), kind, RATE[channel], *stretches)
    recording = loaded(changed(ten_minutes, tmp_path, signals={channel: values}))
    (fault,) = (fault for fault in recording.faults if not fault.repaired)
    assert (fault.channel, fault.kind) == (channel, "loose")
    seen = [fault.words.values[key] for key in ("first", "last")]
    assert seen == pytest.approx([stretches[0][0], stretches[-1][1]], abs=10)
    at, inside, near = at_s(recording), False, False
    for start, stop in stretches:
        inside = inside | ((at >= start) & (at < stop))
        near = near | ((at > start - 20) & (at < stop + 20))
    assert not recording.usable[inside].any()
    assert recording.usable[~near].all()


@pytest.mark.representatives(3)
@pytest.mark.every_value
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("channel", CHANNELS)
def test_whatever_a_loose_sensor_shows(ten_minutes, channel, kind):
    recording = loaded(ten_minutes)
    signals = dict(zip(CHANNELS, recording.signals, strict=True))
    signals[channel] = loosened(signals[channel], kind, COMMON_HZ, (180, 600))
    known = recording.usable, recording.speed_m_per_s, COMMON_HZ
    (fault,), loose, silent = find_loose(signals, *known)
    assert fault.channel == channel
    assert "manifest" not in fault.words  # a single sensor cannot be spared
    assert fault.words.values["first"] == pytest.approx(180, abs=10)
    assert loose[18_000:].all()
    assert not loose[:16_000].any()
    assert not silent.any()


def test_sensor_whose_clock_jumps_is_left_out_from_there_on(ten_minutes, tmp_path):
    body, rate_hz = signal(ten_minutes, "body"), RATE["body"]
    kept = np.delete(body, slice(round(250 * rate_hz), round(290 * rate_hz)))
    values = np.concatenate([kept, body[: len(body) - len(kept)]])
    recording = loaded(changed(ten_minutes, tmp_path, signals={"body": values}))
    assert "body: loose between 2" in "; ".join(map(str, recording.faults))
    assert recording.usable[:23_000].all()
    assert not recording.usable[26_000:].any()


def simulated(folder, seed=0, sides=None, vehicle=AM96, **options):
    """Return sensors of a simulated trip on the common clock, what is usable, and the speed."""
    options = {"n_trips": 1, "minutes": 10.0, "speed_m_per_s": 70.0} | options
    options["sensors"] = {name: {"rate_hz": 250.0} for name in CHANNELS}
    speed = options["speed_m_per_s"]
    generator = VerticalVehicle(vehicle, speed_m_per_s=speed)
    if sides:
        places = (1.0, 1.0, 1.0)
        generator = VerticalVehicle(
            vehicle, speed_m_per_s=speed, parts=ROLLING, sensor_lateral_m=places
        )
    fleet = Fleet(sides=sides, **options)
    scenario = Scenario("random", spread=0.3)
    (path,) = write_fleet(folder, Simulation(fleet, scenario, generator, seed=seed))
    recording = loaded(path)
    signals = dict(zip(CHANNELS, recording.signals, strict=True))
    if all(recording.paired):
        half = recording.differences
        signals = {
            f"{name} {side}": recording.signals[i] + sign * half[i]
            for i, name in enumerate(CHANNELS)
            for side, sign in (("left", 1), ("right", -1))
        }
    return signals, recording.usable, recording.speed_m_per_s, recording.faults


@pytest.fixture(scope="module")
def six_sensors(tmp_path_factory):
    """Sensors left and right of a steady trip."""
    return simulated(tmp_path_factory.mktemp("six"), sides="both")


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "which", [0, 4, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3, 5))]
)
def test_one_of_six_sensors(six_sensors, which):
    signals, usable, speed, faults = six_sensors
    assert faults == ()
    name = list(signals)[which]
    kind = KINDS[which % len(KINDS)]
    values = signals | {name: loosened(signals[name], kind, COMMON_HZ, (180, 600))}
    (fault,), loose, silent = find_loose(values, usable, speed, COMMON_HZ)
    assert fault.channel == name
    assert fault.words.endswith("by the other sensors, delete its line in the manifest")
    assert loose[18_000:].all()
    assert not loose[:16_000].any()
    assert not silent.any()


def test_sensor_of_a_pair_that_never_shows_the_motion(six_sensors):
    signals, usable, speed, _ = six_sensors
    name = "bogie right"
    values = signals | {name: loosened(signals[name], "noise", COMMON_HZ, (0, 600))}
    (fault,), loose, _ = find_loose(values, usable, speed, COMMON_HZ)
    assert (fault.channel, fault.kind) == (name, "loose")
    assert loose.all()


def test_two_sensors_of_three_at_once(ten_minutes):
    recording = loaded(ten_minutes)
    signals = dict(zip(CHANNELS, recording.signals, strict=True))
    for name, kind in (("bogie", "traction hum"), ("body", "noise")):
        signals[name] = loosened(signals[name], kind, COMMON_HZ, (180, 600))
    known = recording.usable, recording.speed_m_per_s, COMMON_HZ
    faults, loose, _ = find_loose(signals, *known)
    assert [fault.channel for fault in faults] == ["bogie", "body"]
    assert loose[18_000:].all()


def quieter(signals, factor, start_s, stop_s):
    """Return signals on track that is smoother between two times, with the noise of the sensors."""
    rng, found = np.random.default_rng(0), {}
    for name, values in signals.items():
        smooth = np.ones(len(values))
        smooth[round(start_s * COMMON_HZ) : round(stop_s * COMMON_HZ)] = factor
        noise = 0.02 * values.std() * rng.standard_normal(len(values))
        found[name] = smooth * values + noise
    return found


@pytest.mark.parametrize(
    "factor",
    [0.1, 0.0, *(pytest.param(f, marks=pytest.mark.slow) for f in (0.3, 0.03, 0.01, 0.001))],
)
def test_smoother_track_and_standstill_are_no_fault(six_sensors, factor):
    """All sensors become quiet together, at last quieter than their own noise."""
    signals, usable, speed, _ = six_sensors
    three = {name: signals[f"{name} left"] for name in CHANNELS}
    for some in (signals, three):
        faults, loose, silent = find_loose(
            quieter(some, factor, 180, 400), usable, speed, COMMON_HZ
        )
        assert faults == ()
        assert not loose.any()
        if factor <= 0.01:
            assert silent[19_000:39_000].all()
        elif factor >= 0.1:
            assert not silent.any()
        assert not silent[:17_000].any()


HEALTHY = [
    (0, None, "service", "german_low", 45.0),
    pytest.param(1, "both", "steady", "chinese_ballastless", 20.0, marks=pytest.mark.slow),
    pytest.param(2, "left", "service", "chinese_ballastless", 70.0, marks=pytest.mark.slow),
]
"""Seed, sides, journey, track and speed of healthy trips."""


@pytest.mark.parametrize(("seed", "sides", "journey", "track", "speed"), HEALTHY)
def test_healthy_trips_have_no_loose_sensor(tmp_path, seed, sides, journey, track, speed):
    minutes = 10.0 if journey == "steady" else 16.0
    options = {"journey": journey, "track": track, "speed_m_per_s": speed, "minutes": minutes}
    signals, usable, known_speed, faults = simulated(tmp_path, seed, sides, **options)
    assert faults == ()
    found, loose, _ = find_loose(signals, usable, known_speed, COMMON_HZ)
    assert found == ()
    assert not loose.any()


@cache
def drawn(seed):
    rng = np.random.default_rng([13, seed])
    journey = rng.choice(["steady", "service"])
    return {
        "sides": rng.choice([None, "left", "both"]),
        "journey": str(journey),
        "track": str(rng.choice(["german_low", "german_high", "chinese_ballastless"])),
        "speed_m_per_s": float(rng.uniform(25, 80 if journey == "steady" else 70)),
        "minutes": float(rng.choice([10.0, 20.0])) if journey == "steady" else 20.0,
    }


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_forty_trips_sound_and_loose(tmp_path, seed):
    """None of the sound ones has a finding; each loose sensor is found, on 10 and 20 minutes."""
    signals, usable, speed, faults = simulated(tmp_path, seed, **drawn(seed))
    assert faults == ()
    assert find_loose(signals, usable, speed, COMMON_HZ)[0] == ()
    rng = np.random.default_rng([14, seed])
    moving = binary_erosion(speed > 15, iterations=1000)
    for kind in KINDS:
        name = list(signals)[int(rng.integers(len(signals)))]
        worse = signals | {name: loosened(signals[name], kind, COMMON_HZ, (180, 1200))}
        found, loose, _ = find_loose(worse, usable, speed, COMMON_HZ)
        assert [fault.channel for fault in found] == [name], kind
        assert loose[18_000:][moving[18_000:]].all()
        assert float(found[0].words.split()[2]) == pytest.approx(180, abs=45)
