"""Simulated trips: what vehicle, track and journey make of them, and the files they leave."""

import math
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from recording_files import contents
from reference import phasors
from vehicles import AM96

from suspnet.curves.welch import Welch, tfestimate
from suspnet.ground.storage import read_json
from suspnet.trains.recordings.dates import date_problem
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.manifest_sources import SensorSource, SpeedSource
from suspnet.trains.simulation.fleet import FIRST_DAY, Scenario
from suspnet.trains.simulation.signals import (
    BLOCK,
    Journey,
    profile_length_m,
    simulate_trip,
    steady_journey,
)
from suspnet.trains.simulation.true_vehicle import scattered, true_numbers
from suspnet.trains.simulation.writing import Fleet, Simulation, time_between, write_fleet
from suspnet.vehicle import PARAMETERS, QuarterCar, VerticalVehicle
from suspnet.vehicle.quantities import UNMEASURED
from suspnet.vehicle.track import TrackProfile, make_profile, track_spectrum

DEGRADED = torch.tensor([0.8, 1.4, 1.2, 0.9, 1.1], dtype=torch.float64)
GENERATORS = {
    "quarter_car": QuarterCar(AM96),
    "leading": VerticalVehicle(AM96, speed_m_per_s=50.0),
    "trailing": VerticalVehicle(
        AM96, speed_m_per_s=50.0, bogie="trailing", axle="trailing", body_sensor_m=2.0
    ),
}
FAMILY = VerticalVehicle(
    AM96,
    speed_m_per_s=50.0,
    parts=("bushings", "rubber", "guidance", "longitudinal", "bending", "roll"),
    sensor_lateral_m=(1.0, 0.9, 1.1),
)
COARSE = {name: {"rate_hz": 200.0} for name in CHANNELS}
ONE_LOAD = Scenario("one load", mass_low=1.0, mass_high=1.0)


def waves(length_m, speed, frequencies_hz, step_m=0.02):
    """A track of a few cosine waves, each met at its frequency at that speed."""
    x = np.arange(0, length_m + step_m, step_m)
    elevation, slope, curvature = np.zeros((3, len(x)))
    for i, f in enumerate(frequencies_hz):
        k = 2 * math.pi * f / speed
        elevation += 1e-3 * np.cos(k * x + i)
        slope -= 1e-3 * k * np.sin(k * x + i)
        curvature -= 1e-3 * k**2 * np.cos(k * x + i)
    return TrackProfile(step_m, elevation, slope, curvature)


def fleet(**changes):
    options = {"n_trips": 2, "minutes": 0.2, "last_mileage_km": 1000.0, "sensors": COARSE}
    return Fleet(**(options | changes))


def column(path):
    table = pq.read_table(path)
    assert table.num_columns == 1
    return table.column(0).to_numpy()


# reference


@pytest.mark.parametrize("name", GENERATORS)
def test_trip_over_waves_shows_the_transfer_functions(name):
    generator, speed, rate_hz = GENERATORS[name], 50.0, 500.0
    frequencies = np.array([0.8, 1.3, 2.1, 5.4, 18.0])
    journey = steady_journey(speed, 10.0)
    system = generator.motion_system(DEGRADED)
    profile = waves(profile_length_m(system, journey), speed, frequencies)
    signals = simulate_trip(system, profile, journey, rate_hz)
    assert signals.shape == (3, 5000)
    times = np.arange(5000) / rate_hz
    columns = [f(2 * math.pi * w * times) for w in frequencies for f in (np.cos, np.sin)]
    fits, *_ = np.linalg.lstsq(np.array(columns).T, signals.T)
    residual = signals.T - np.array(columns).T @ fits
    # settled from the very first sample: nothing but the waves is there
    assert np.abs(residual).max() < 1e-3 * np.abs(signals).max()
    phasors = fits[0::2] - 1j * fits[1::2]
    g_p, g_s = generator.responses(DEGRADED[None], torch.as_tensor(frequencies))
    # what is left of the start after 20 s is exp(-0.35 * 20) or less
    tolerance = {"rtol": 1e-3, "atol": 0}
    np.testing.assert_allclose(phasors[:, 1] / phasors[:, 0], g_p[0].numpy(), **tolerance)
    np.testing.assert_allclose(phasors[:, 2] / phasors[:, 1], g_s[0].numpy(), **tolerance)
    # the axle box feels v^2 r''
    amplitude = 1e-3 * (2 * math.pi * frequencies) ** 2
    np.testing.assert_allclose(np.abs(phasors[:, 0]), amplitude, rtol=1e-4)


def test_trip_over_mean_and_cross_level_shows_the_channels_of_both_sides():
    speed, rate_hz = 50.0, 500.0
    waved, tilted = np.array([1.3, 5.4, 9.0]), np.array([0.8, 2.1, 7.0])
    names = (*PARAMETERS, *UNMEASURED)
    ratios = torch.ones(len(names), dtype=torch.float64)
    ratios[:5] = DEGRADED
    ratios[names.index("rubber_loss")] = 1e-9
    journey = steady_journey(speed, 80.0)
    system = FAMILY.motion_system(ratios)
    length_m = profile_length_m(system, journey)
    profile, cross = (waves(length_m, speed, f) for f in (waved, tilted))
    signals = simulate_trip(system, profile, journey, rate_hz, cross)[:, -5000:]
    times = np.arange(35_000, 40_000) / rate_hz
    frequencies = np.concatenate([waved, tilted])
    found = phasors(signals, times, frequencies).reshape(6, 2, 3)  # frequency, side, place
    mean, roll = FAMILY.channels(ratios[None], torch.as_tensor(frequencies))[0].numpy()
    height = found[:3, :, 0].mean(axis=1)
    expected = np.stack([mean[:, :3], mean[:, :3]]) * height
    tolerance = {"rtol": 3e-3, "atol": 0}  # straight lines between samples; see above
    np.testing.assert_allclose(np.moveaxis(found[:3], 0, -1), expected, **tolerance)
    scaled = found[3:, 0, 0] / roll[0, 3:]  # the axle box has no dynamics of its own
    expected = np.stack([roll[:, 3:], -roll[:, 3:]]) * scaled
    np.testing.assert_allclose(np.moveaxis(found[3:], 0, -1), expected, **tolerance)
    # the colour of the cross level is the track's, not the vehicle's
    amplitude = 1e-3 * (2 * math.pi * tilted) ** 2 * math.sqrt(0.5) / 0.75
    np.testing.assert_allclose(np.abs(found[3:, 0, 0]), amplitude, rtol=1e-4)


def test_trip_over_a_random_track_has_the_transfer_function_of_the_vehicle():
    generator, speed, rate_hz = GENERATORS["leading"], 50.0, 200.0
    journey = steady_journey(speed, 600.0)
    system = generator.motion_system(DEGRADED)
    length_m = profile_length_m(system, journey)
    profile = make_profile(track_spectrum("german_low"), length_m, speed / rate_hz, seed=1)
    axle_box, bogie, body = simulate_trip(system, profile, journey, rate_hz)
    welch = Welch(20.0)
    band = slice(14, 160)  # 0.7 to 8 Hz
    for x, y, z, response in ((axle_box, bogie, body, 0), (bogie, body, axle_box, 1)):
        found = tfestimate(x, y, rate_hz, welch, "IV", instrument=z)
        bins = found.frequencies_hz[band]
        g_p, g_s = generator.responses(DEGRADED[None], bins)
        expected = (g_p, g_s)[response][0].numpy()
        ratio = found.response[band].numpy() / expected
        # no noise, but leakage: some per cent, most of it where the response dips
        assert np.median(np.abs(ratio - 1)) < 0.02
        assert np.quantile(np.abs(ratio - 1), 0.9) < 0.1
        assert np.ptp(np.abs(expected)) > 1


@pytest.mark.parametrize("name", GENERATORS)
def test_axle_box_feels_curvature_and_slope_of_the_track_at_its_place(name):
    journey = Journey(np.array([0.0, 4.0, 8.0]), np.array([10.0, 30.0, 5.0]))
    system = GENERATORS[name].motion_system(DEGRADED)
    profile = waves(profile_length_m(system, journey), 30.0, [0.7, 3.0])
    axle_box = simulate_trip(system, profile, journey, 100.0)[0]
    times = np.arange(800) / 100.0
    position, speed, acceleration = journey.at(times)
    # 20 s at 10 m/s before the start, the last wheelset at 50 m
    start_m = 50.0 + 20 * 10 + max(system.behind_m)
    _, slope, curvature = profile.at(start_m + position)
    expected = speed**2 * curvature + acceleration * slope
    np.testing.assert_allclose(axle_box, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert np.abs(acceleration * slope).max() > 1e-3 * np.abs(expected).max()
    # it is the second derivative of the track's height under the wheel
    height = profile.at(start_m + journey.at(np.arange(4000) / 1000.0)[0])[0]
    second = np.diff(height, 2) * 1e6
    here = np.interp(np.arange(1, 3999) / 1000.0, times, axle_box)
    assert np.abs(second - here)[:3900].max() < 0.03 * np.abs(here).max()


# limit


def test_train_that_stands_feels_nothing():
    journey = Journey(np.array([0.0, 5.0, 10.0]), np.array([0.0, 0.0, 2.0]))
    system = GENERATORS["leading"].motion_system(DEGRADED)
    profile = waves(profile_length_m(system, journey), 2.0, [1.0])
    signals = simulate_trip(system, profile, journey, 100.0)
    assert not signals[:, :499].any()  # what starts at a sample bends the line to it
    assert np.abs(signals[:, 600:]).max(axis=1).min() > 0


# property


def test_longer_trip_is_the_same_in_its_first_part(monkeypatch):
    system = GENERATORS["trailing"].motion_system(DEGRADED)
    long, short = steady_journey(40.0, 12.0), steady_journey(40.0, 6.0)
    profile = waves(profile_length_m(system, long), 40.0, [1.1, 3.3])
    whole = simulate_trip(system, profile, long, 100.0)
    first = simulate_trip(system, profile, short, 100.0)
    np.testing.assert_allclose(whole[:, :600], first, rtol=0, atol=1e-9)
    assert BLOCK > 3200
    monkeypatch.setattr("suspnet.trains.simulation.signals.BLOCK", 2111)
    pieces = simulate_trip(system, profile, long, 100.0)
    np.testing.assert_allclose(pieces, whole, rtol=0, atol=1e-9 * np.abs(whole).max())


def test_same_seed_writes_the_same_bytes(tmp_path):
    scenario = Scenario("some", spread=0.1)
    for folder, seed in (("a", 1), ("b", 1), ("c", 2)):
        write_fleet(
            tmp_path / folder, Simulation(fleet(), scenario, GENERATORS["leading"], seed=seed)
        )
    first, again, other = (contents(tmp_path / folder) for folder in "abc")
    assert len(first) == 2 * (1 + 4) + 1  # truth.json
    assert first == again
    assert set(first) == set(other)
    changed = {name for name in first if first[name] != other[name]}
    assert changed == {name for name in first if not name.endswith("speed.parquet")}
    assert first["trip_001/bogie.parquet"] != first["trip_002/bogie.parquet"]


def test_files_are_those_of_the_manifest(tmp_path):
    scenario = Scenario("fading", {"c_s": {"from_km": 0.0, "to_km": 1000.0, "ratio": 0.5}})
    sensors = {
        "axle_box": {"rate_hz": 400.0, "range_g": 30.0},
        "bogie": {"rate_hz": 200.0, "snr_db": None},
        "body": {"rate_hz": 160.0},
    }
    trips = fleet(n_trips=3, sensors=sensors, speed_m_per_s=40.0, suspension="left")
    paths = write_fleet(tmp_path, Simulation(trips, scenario, GENERATORS["leading"], seed=3))
    assert [path.name for path in paths] == ["trip_001.yaml", "trip_002.yaml", "trip_003.yaml"]
    ratios = scenario.ratios(trips.mileage_km(), 3)
    for i, path in enumerate(paths):
        manifest = read_manifest(path)
        assert manifest.name == path.stem
        assert (manifest.vehicle, manifest.suspension) == ("am96", "left")
        assert manifest.mileage_km == pytest.approx(1000.0 * (i + 1) / 3)
        assert manifest.truth == pytest.approx(dict(zip(PARAMETERS, ratios[i], strict=True)))
        for name, rate_hz in zip(CHANNELS, (400.0, 200.0, 160.0), strict=True):
            channel = manifest.channels[name]
            assert isinstance(channel, SensorSource)
            assert (channel.unit, channel.column, channel.sign) == ("m/s2", "acceleration", 1)
            assert channel.rate_hz == rate_hz
            values = column(manifest.file_of(channel))
            assert values.dtype == np.float32
            assert len(values) == 12 * rate_hz
            assert np.isfinite(values).all()
            assert values.std() > 0
        assert manifest.channels["axle_box"].range == pytest.approx(30 * 9.80665)
        assert manifest.channels["bogie"].range is None
        assert isinstance(manifest.speed, SpeedSource)
        speed = column(manifest.file_of(manifest.speed))
        assert (manifest.speed.unit, manifest.speed.rate_hz) == ("m/s", 1.0)
        np.testing.assert_allclose(speed, np.full(13, 40.0))
    starts = [read_manifest(path).start for path in paths]
    assert starts[2] - starts[1] == starts[1] - starts[0]
    assert starts[0].isoformat() == "2015-08-03T06:00:00+00:00"


@pytest.mark.parametrize(
    ("changes", "km_per_day"),
    [
        ({}, 5 * 252),
        ({"speed_m_per_s": 20.0}, 5 * 72),
        ({"n_trips": 400}, 5 * 252),
        ({"last_mileage_km": 2e7}, 2e7 / 3650),  # else the last trips were in the future
        ({"n_trips": 100_000}, 308_000 / 100_000 * 72),  # these trips overlap if closer
    ],
)
def test_dates_follow_from_mileage_and_speed(changes, km_per_day):
    trips = Fleet(**changes)
    between = time_between(trips)
    km = trips.mileage_km()[0]
    assert km / (between.total_seconds() / 86400) == pytest.approx(km_per_day, rel=0.02)
    assert date_problem(FIRST_DAY + trips.n_trips * between) == ""
    assert between.total_seconds() % 1200 == 0


def test_channels_of_other_rates_are_resampled_with_their_content(tmp_path):
    """The bogie at 200 Hz holds what it holds at the 400 Hz of the axle box."""
    for rate_hz in (400.0, 200.0):
        sensors = {name: {"rate_hz": 400.0, "snr_db": None} for name in CHANNELS}
        sensors["bogie"]["rate_hz"] = rate_hz
        write_fleet(
            tmp_path / f"{rate_hz:g}",
            Simulation(fleet(n_trips=1, sensors=sensors), ONE_LOAD, GENERATORS["leading"]),
        )
    fine, coarse = (column(tmp_path / rate / "trip_001/bogie.parquet") for rate in ("400", "200"))
    transforms = [np.fft.rfft(x * np.hanning(len(x))) / len(x) for x in (fine, coarse)]
    band = slice(12, 12 * 50)  # up to 50 Hz, half of the coarse one's band
    fine_band, coarse_band = (transform[band] for transform in transforms)
    assert np.abs(fine_band - coarse_band).max() < 0.01 * np.abs(fine_band).max()
    axle_box = (tmp_path / rate / "trip_001/axle_box.parquet" for rate in ("400", "200"))
    np.testing.assert_array_equal(*(column(path) for path in axle_box))


def test_sensors_add_their_own_noise_on_each_trip(tmp_path):
    records = {}
    for snr_db in (None, 20.0):
        sensors = {name: {"rate_hz": 200.0, "snr_db": snr_db} for name in CHANNELS}
        for seed in (0, 1):
            folder = tmp_path / f"{snr_db}-{seed}"
            write_fleet(
                folder,
                Simulation(fleet(sensors=sensors), ONE_LOAD, GENERATORS["leading"], seed=seed),
            )
            for trip in ("trip_001", "trip_002"):
                for name in CHANNELS:
                    signal = column(folder / trip / f"{name}.parquet")
                    records[snr_db, seed, trip, name] = signal
    clean = {key[1:]: signal for key, signal in records.items() if key[0] is None}
    noises = {key: records[20.0, *key] - signal for key, signal in clean.items()}
    for key, noise in noises.items():
        # 2400 samples: 1.4 %
        assert noise.std() / np.sqrt(np.mean(clean[key] ** 2)) == pytest.approx(0.1, rel=0.07)
    # no two of three sensors, two trips and two seeds share their noise
    correlation = np.corrcoef(list(noises.values())) - np.eye(12)
    assert np.abs(correlation).max() < 0.1
    # nor do the tracks
    tracks = [signal for key, signal in clean.items() if key[2] == "axle_box"]
    assert np.abs(np.corrcoef(tracks) - np.eye(4)).max() < 0.3


def test_service_journey_is_written_with_its_speed(tmp_path):
    trips = fleet(n_trips=1, journey="service", n_stops=1, minutes=10.0, speed_m_per_s=20.0)
    (path,) = write_fleet(tmp_path, Simulation(trips, ONE_LOAD, GENERATORS["quarter_car"], seed=2))
    manifest = read_manifest(path)
    speed = column(manifest.file_of(manifest.speed))
    assert len(speed) == 601
    assert speed[[0, -1]].tolist() == [0.0, 0.0]
    assert 0.5 * 20 < speed.max() <= 20.0
    assert np.count_nonzero(speed == 0) == pytest.approx(120 + 1 + 2, abs=2)
    signals = np.array([column(manifest.file_of(c)) for c in manifest.channels.values()])
    assert signals.shape == (3, 120_000)
    standing = np.abs(signals[:, 270 * 200 : 330 * 200]).max(axis=1)
    moving = np.abs(signals[:, 100 * 200 : 200 * 200]).max(axis=1)
    # what is left while it stands is the sensors' noise of 2 % and the last swings
    assert (standing < 0.2 * moving).all()


def test_loggers_are_those_of_table_2_unless_given():
    given = {"body": {"range_g": 2.0}, "bogie": {"rate_hz": 500.0, "snr_db": None}}
    loggers = fleet(sensors=given).loggers()
    assert [loggers[name].rate_hz for name in CHANNELS] == [5000.0, 500.0, 2000.0]
    assert [loggers[name].snr_db for name in CHANNELS] == [34.0, None, 34.0]
    assert loggers["body"].range_g == 2.0
    assert [s.rate_hz for s in Fleet().loggers().values()] == [5000.0, 2000.0, 2000.0]
    given = {"axle_box": {"rate_hz": 5000.0, "snr_db": 20.0}}
    loggers = Fleet(sensors=given, rate_hz=500.0).loggers()
    assert [s.rate_hz for s in loggers.values()] == [500.0] * 3
    assert loggers["axle_box"].snr_db == 20.0


def pair(folder, trip, place):
    """Return what the sensors on the left and on the right recorded."""
    table = pq.read_table(folder / trip / f"{place}.parquet")
    assert table.column_names == ["left", "right"]
    return [table[side].to_numpy() for side in table.column_names]


def test_vehicle_that_rolls_is_written_with_sensors_on_both_sides(tmp_path):
    silent = {name: {"rate_hz": 200.0, "snr_db": None} for name in CHANNELS}
    (path,) = write_fleet(
        tmp_path / "a", Simulation(fleet(n_trips=1, sensors=silent), ONE_LOAD, FAMILY)
    )
    channels = read_manifest(path).channels
    assert [[one.side for one in channels[name]] for name in CHANNELS] == 3 * [["left", "right"]]
    write_fleet(tmp_path / "b", Simulation(fleet(n_trips=1), ONE_LOAD, FAMILY))
    off = replace(FAMILY, sensor_lateral_m=(0.0, 0.0, 0.0))
    write_fleet(tmp_path / "middle", Simulation(fleet(n_trips=1, sensors=silent), ONE_LOAD, off))
    for name in CHANNELS:
        clean, noisy = (pair(tmp_path / folder, "trip_001", name) for folder in "ab")
        middle = column(tmp_path / "middle" / "trip_001" / f"{name}.parquet")
        # the average of both has no roll
        largest = np.abs(middle).max()
        np.testing.assert_allclose(sum(clean) / 2, middle, rtol=0, atol=1e-5 * largest)
        assert (clean[0] - clean[1]).std() > 0.1 * middle.std()
        noise = [b - a for a, b in zip(clean, noisy, strict=True)]
        assert abs(np.corrcoef(noise)[0, 1]) < 0.1  # 2400 samples: 0.02
        assert min(one.std() for one in noise) > 0


def test_one_sensor_alone_is_the_left_one_of_both(tmp_path):
    sensors = {name: {"rate_hz": 200.0, "snr_db": None} for name in CHANNELS}
    trips = fleet(n_trips=1, sensors=sensors)
    other = replace(FAMILY, sensor_lateral_m=(1.0, -0.9, 1.1))
    for generator, side in ((FAMILY, "left"), (other, "right")):
        both, one = tmp_path / f"both {side}", tmp_path / f"one {side}"
        write_fleet(both, Simulation(trips, ONE_LOAD, generator))
        (path,) = write_fleet(one, Simulation(replace(trips, sides="left"), ONE_LOAD, generator))
        sides = [read_manifest(path).channels[name].side for name in CHANNELS]
        assert sides == ["left", side, "left"]
        for name, where in zip(CHANNELS, sides, strict=True):
            alone = column(one / "trip_001" / f"{name}.parquet")
            placed = dict(zip(("left", "right"), pair(both, "trip_001", name), strict=True))
            np.testing.assert_allclose(alone, placed[where], rtol=1e-5, atol=1e-6)


def test_scattered_fleet_says_what_it_was_and_wears_relative_to_it(tmp_path):
    for folder, trips in (("two", 2), ("three", 3)):
        write_fleet(
            tmp_path / folder,
            Simulation(fleet(n_trips=trips), ONE_LOAD, FAMILY, seed=7, scatter=1.0),
        )
    truth, same = (read_json(tmp_path / folder / "truth.json") for folder in ("two", "three"))
    assert truth == same
    assert (truth["vehicle"], truth["scatter"], truth["seed"]) == ("am96", 1.0, 7)
    assert truth["numbers"] == true_numbers(scattered(FAMILY, 1.0, 7))
    assert read_manifest(tmp_path / "two" / "trip_001.yaml").truth["k_p"] == 1.0
    for name in CHANNELS:
        two, three = (pair(tmp_path / folder, "trip_001", name) for folder in ("two", "three"))
        np.testing.assert_array_equal(two, three)
    write_fleet(tmp_path / "none", Simulation(fleet(n_trips=1), ONE_LOAD, FAMILY, seed=7))
    numbers = read_json(tmp_path / "none" / "truth.json")["numbers"]
    assert {one["ratio"] for one in numbers.values()} == {1.0}


# failure


def test_both_sides_of_a_vehicle_without_roll_are_rejected(tmp_path):
    middle = replace(FAMILY, sensor_lateral_m=(0.0, 0.0, 0.0))
    for generator in (*GENERATORS.values(), middle):
        with pytest.raises(ValueError, match="`sides`=both needs a vehicle with roll"):
            write_fleet(tmp_path, Simulation(fleet(sides="both"), ONE_LOAD, generator))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"track": "moon"}, "`track` must be one of .*'moon'"),
        ({"sensors": {"roof": {}}}, r"`sensors` must be named as in .*\['roof'\]"),
        ({"sensors": {"body": {"rate_hz": 0.0}}}, "`sensor.rate_hz` must be a finite number > 0"),
    ],
)
def test_settings_out_of_range_are_rejected(changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        fleet(**changes)


def test_service_journey_too_short_for_its_stops_is_rejected(tmp_path):
    trips = fleet(journey="service", n_stops=3, minutes=5.0)
    with pytest.raises(ValueError, match="3 stops in 300 s leave"):
        write_fleet(tmp_path, Simulation(trips, ONE_LOAD, GENERATORS["quarter_car"]))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("end", ["leading", "trailing"])
def test_trailing_bogie_and_axle_are_stated(tmp_path, end):
    (path,) = write_fleet(tmp_path, Simulation(fleet(n_trips=1), ONE_LOAD, GENERATORS[end], seed=2))
    manifest = read_manifest(path)
    assert (manifest.bogie, manifest.axle) == ((end, end) if end == "trailing" else (None, None))
