"""Trips of the three-dimensional train on disk: the same as suspnet's where they can be."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from rich_effects import BASE
from rich_structure import SEVEN
from rich_train import RichTrain
from rich_train_trips import write_train_trips
from vehicles import AM96

from suspnet.trains.identification.bogie_trips import sensor_places
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.simulation import Fleet, Scenario, Simulation, write_fleet
from suspnet.vehicle import PARAMETERS, VerticalVehicle

RATES = dict(zip(CHANNELS, (1000.0, 500.0, 500.0), strict=True))
SILENT = {name: {"rate_hz": rate, "snr_db": None} for name, rate in RATES.items()}
NOISY = {name: {"rate_hz": rate} for name, rate in RATES.items()}
WORN = np.array([0.8, 1.3, 1.2, 0.7, 1.1])


def fleet_of(n_trips=1, **changes):
    return Fleet(**({"n_trips": n_trips, "minutes": 0.2, "sensors": SILENT} | changes))


def columns(manifest, name):
    table = pq.read_table(manifest.with_suffix("") / f"{name}.parquet")
    return {column: table[column].to_numpy().astype(float) for column in table.column_names}


# reference


def test_trips_without_effects_are_those_of_suspnet(tmp_path):
    fleet, scenario = fleet_of(2, speed_m_per_s=55.0), Scenario("random", spread=0.4)
    ratios = scenario.ratios(fleet.mileage_km(), 5)
    found = write_train_trips(tmp_path / "rich", RichTrain(), ratios, fleet, 5, sides="left")
    expected = write_fleet(
        tmp_path / "plain",
        Simulation(fleet, scenario, VerticalVehicle(AM96, speed_m_per_s=55.0), seed=5),
    )
    for mine, theirs in zip(found, expected, strict=True):
        a, b = read_manifest(mine), read_manifest(theirs)
        assert (a.truth, a.mileage_km, a.start, a.vehicle) == (
            b.truth,
            b.mileage_km,
            b.start,
            b.vehicle,
        )
        for channel in CHANNELS:
            left, plain = columns(mine, channel)["left"], columns(theirs, channel)["acceleration"]
            # of straight lines between samples, as suspnet has them, (2 pi 30 / 1000)^2 / 12 = 3e-3
            np.testing.assert_allclose(left, plain, rtol=0, atol=3e-3 * np.abs(plain).max())


# property


def test_a_pair_has_a_list_of_sensors_for_each_channel(tmp_path):
    train, fleet = RichTrain.scattered(1), fleet_of(sensors=NOISY)
    (pair,) = write_train_trips(tmp_path / "pair", train, [WORN], fleet, 2)
    content = yaml.safe_load(pair.read_text())
    assert content["truth"] == dict(zip(PARAMETERS, WORN.tolist(), strict=True))
    for channel in CHANNELS:
        sensors = content["channels"][channel]
        assert [one["column"] for one in sensors] == ["left", "right"]
        assert {one["rate_hz"] for one in sensors} == {RATES[channel]}
        assert all((tmp_path / "pair" / one["file"]).is_file() for one in sensors)
        found = columns(pair, channel)
        assert abs(np.corrcoef(*found.values())[0, 1]) < 0.99
        assert len(found["left"]) == 12 * RATES[channel]
    for sides in ("mean", "left", "right"):
        (one,) = write_train_trips(tmp_path / sides, train, [WORN], fleet, 2, sides=sides)
        assert read_manifest(one).truth == content["truth"]
        for channel, source in read_manifest(one).channels.items():
            assert source.column == sides
            both = columns(pair, channel)
            expected = both.get(sides, (both["left"] + both["right"]) / 2)
            found = columns(one, channel)[sides]
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(found).max())


def test_seven_sensors_are_at_their_places_and_those_that_six_have_read_the_same(tmp_path):
    train, fleet = RichTrain.scattered(1, (*BASE, "sensors", "cross_axis")), fleet_of()
    paths = [
        write_train_trips(tmp_path / name, one, np.ones((1, 13)), fleet, 2)[0]
        for name, one in (("six", train), ("seven", replace(train, sensors=SEVEN)))
    ]
    six, seven = ({name: columns(path, name) for name in CHANNELS} for path in paths)
    for channel, sides in six.items():
        for side in sides:
            if channel != "body":
                np.testing.assert_array_equal(seven[channel][side], sides[side])
    # axle 2 passes each place of the track 2 a / v later
    behind_s = 2 * train.half_wheelbase_m / fleet.speed_m_per_s
    axle1, axle2 = (seven["axle_box"][column] for column in ("left", "2 left"))
    late = np.argmax(np.correlate(axle2, axle1, "full")) - (len(axle1) - 1)
    assert late / RATES["axle_box"] == pytest.approx(behind_s, abs=2e-3)
    places = sensor_places(read_manifest(paths[1]), "axle")
    assert places == (
        *("axle_box_axle1_left", "axle_box_axle1_right"),
        *("axle_box_axle2_left", "axle_box_axle2_right"),
        *("frame_axle1_left", "frame_axle1_right", "body_middle"),
    )


def test_sensor_in_the_middle_of_a_rigid_body_reads_the_mean_of_both_sides():
    train = RichTrain.scattered(1)
    rows = train.matrices(np.ones(13)).sensors
    middle = replace(train, sensors=SEVEN).matrices(np.ones(13)).sensors[-1]
    np.testing.assert_allclose(middle, rows[4:].mean(axis=0), atol=1e-15)
