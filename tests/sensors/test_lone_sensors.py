"""A trip of which sensors of pairs are dead is read by the others, with wider intervals."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from trip_fixtures import SENSORS, SPEED, model_at
from vehicles import AM96

from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.sensors.lone_sensors import placed
from suspnet.trains.simulation.fleet import Fleet, Scenario
from suspnet.trains.simulation.writing import Simulation, write_fleet
from suspnet.trains.trips.trip import evaluate_trip
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.quantities import LogNormal

UNCERTAIN = {"healthy_k_s": 0.02, "healthy_c_s": 0.02}
ON_SIDES = (1.0, 1.0, 1.0)
ROLLING = VerticalVehicle(AM96, speed_m_per_s=SPEED, parts=("roll",), sensor_lateral_m=ON_SIDES)
RIGHT = ("axle_box right", "bogie right", "body right")


@pytest.fixture(scope="module")
def model():
    """A model of the means of pairs, of a vehicle that is known almost exactly."""
    nominal = model_at(n_train=500, n_calibrate=100)
    return replace(nominal, generator=replace(nominal.generator, distribution=UNCERTAIN))


@pytest.fixture(scope="module")
def trip(tmp_path_factory):
    """The manifest of a healthy trip with sensors on both sides."""
    fleet = Fleet(n_trips=1, minutes=6.0, speed_m_per_s=SPEED, sensors=SENSORS, sides="both")
    folder = tmp_path_factory.mktemp("pairs")
    return write_fleet(folder, Simulation(fleet, Scenario("healthy"), ROLLING, seed=0))[0]


@pytest.fixture(scope="module")
def whole(model, trip):
    """What the trip with all sensors gives."""
    return evaluate_trip(trip, [model], TripSettings())


@pytest.fixture
def read(model, trip, tmp_path):
    """Read the trip with the signals of some sensors multiplied by factors."""

    def result(factors=None):
        shutil.copytree(trip.parent, tmp_path, dirs_exist_ok=True)
        for name, factor in (factors or {}).items():
            place, side = name.split()
            file = tmp_path / trip.stem / f"{place}.parquet"
            table = pq.read_table(file)
            columns = {name: table[name].to_numpy() for name in table.column_names}
            pq.write_table(pa.table(columns | {side: factor * columns[side]}), file)
        return evaluate_trip(tmp_path / trip.name, [model], TripSettings())

    return result


def errors(result):
    """Return the errors of logarithms over half widths, and the half widths."""
    half = np.array(list(result.half_widths.values()))
    ratios = [result.estimates[name] / result.truth[name] for name in result.half_widths]
    return np.abs(np.log(ratios)) / half, half


def recording(*sides):
    return SimpleNamespace(sides=sides)


@pytest.mark.parametrize("place", ["axle_box", "bogie", "body"])
def test_dead_sensor_is_named_and_its_trip_read_with_wider_intervals(read, whole, place):
    one = read({f"{place} right": 0.0})
    assert (whole.status, one.status, one.flags) == ("ok", "ok", "")
    assert f"{place} right: dead and left out, {place} is read by its left" in one.quality.faults
    assert f"one sensor alone stands for both sides: {place} left" in one.quality.warnings
    assert (errors(one)[0] < 1.5).all()
    assert (errors(one)[1] > errors(whole)[1]).all()
    assert f'"{place} right"' in one.quality.sensors


def test_sensors_of_one_side_alone_are_read_with_roll(read):
    result = read(dict.fromkeys(RIGHT, 0.0))
    assert (result.status, result.flags) == ("ok", "")
    assert "body left; whether the sides are equal is not checked" in result.quality.warnings
    assert (errors(result)[0] < 1.5).all()


def test_sides_that_differ_flag_a_trip_of_a_lone_sensor(read):
    result = read({"axle_box right": 0.0, "body left": 1.1, "body right": 0.9})
    assert "left and right differ; one sensor alone stands for both sides: axle" in result.flags


def test_two_single_sensors_have_roll_at_its_prior(model):
    found = placed(model, recording("left", None, "right")).generator
    assert found.sensor_lateral_m == (1.0, 0.0, -1.0)
    assert found.rolls
    numbers, prior = found.distribution, LogNormal.prior(("roll",))
    assert numbers.names[:2] == tuple(UNCERTAIN)
    row = numbers.names.index("cross_level")
    assert numbers.deviations[row] == prior.deviations[prior.names.index("cross_level")]
    np.testing.assert_allclose(numbers.deviations[:2], 0.02)


def test_a_dead_sensor_of_a_pair_beside_single_ones_keeps_the_numbers_of_roll(model):
    generator = replace(ROLLING, sensor_lateral_m=(0.0, 1.0, 1.0), distribution="prior")
    found = placed(
        replace(model, generator=generator), recording("right", "left", "left")
    ).generator
    assert found.sensor_lateral_m == (-1.0, 1.0, 1.0)
    assert found.distribution == generator.distribution


def test_known_places_and_single_noise_change_nothing(model):
    assert placed(model, recording(None, "left", None)) is model
    assert placed(model, recording(None, None, None)) is model
    sided = replace(model, generator=replace(ROLLING, distribution=UNCERTAIN))
    assert placed(sided, recording("left", "left", "left")) is sided


def test_healthy_trip_with_a_dead_sensor_is_left_out(read, model, tmp_path):
    read({"bogie right": 0.0})
    with pytest.raises(
        TripError, match=r"0 healthy trips .*\(trip_001: bogie right: dead and left"
    ):
        read_healthy(tmp_path, model.generator, model.settings, TripSettings())
