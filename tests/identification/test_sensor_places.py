"""A frame's sensor that is not where it is supposed to be: named, and right places not doubted."""

from pathlib import Path

import numpy as np
import pytest
import torch
from rich_effects import FAMILY, OF_THE_TRIP
from rich_spectra import drawn_estimates
from rich_train import RichTrain
from vehicles import AM96

from suspnet import VerticalVehicle, read_vehicles
from suspnet.curves.cross_spectra import CrossSpectra, moving_average_with, sample_spectra
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import Speeds
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.fits.healthy_misfit import HealthySpectra
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.jobs.check import CheckSettings, check_trip
from suspnet.trains.sensors.swapped_sensors import elsewhere

SETTINGS = EstimateSettings(minutes=10.0).bound(AM96)
TTB2D = Path(__file__).parents[2].parent / "shared" / "ttb2d" / "healthy"
needs_ttb2d = pytest.mark.skipif(not TTB2D.is_dir(), reason="no trips of TTB-2D here")
CENTRE = "the frame's sensor looks to be at the frame's centre: misfit "


def drawn(vehicle, seed=0):
    """Return a trip of a vehicle of rigid bodies whose springs and dampers are off the drawing."""
    wear = np.random.default_rng(seed).uniform(0.8, 1.2, (1, 5))
    expected = SETTINGS.observer(vehicle).expected(torch.as_tensor(wear))
    taps = moving_average_with(SETTINGS.welch.correlation().numpy())
    found = sample_spectra(expected, taps, torch.Generator().manual_seed(seed))
    spectra = CrossSpectra(found.auto[0], found.cross[0], found.n_averages)
    return HealthySpectra(Speeds((vehicle.speed_m_per_s,), (1.0,)), spectra)


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("frame_sensor", ["axle", "centre"])
@pytest.mark.parametrize(("axle", "direction"), [("leading", "forward"), ("trailing", "reverse")])
def test_place_of_the_frames_sensor_is_found_whatever_is_given(
    frame_sensor, axle, direction, stated
):
    place = {"speed_m_per_s": 50.0, "axle": axle}
    true = VerticalVehicle(AM96, frame_sensor=frame_sensor, direction=direction, **place)
    one, way = drawn(true), direction if stated else None
    for given in ("axle", "centre"):
        found = elsewhere(VerticalVehicle(AM96, frame_sensor=given, **place), SETTINGS, one, way)
        if given == frame_sensor:
            assert found is None
            continue
        assert found.change == (frame_sensor, axle, direction)
        assert found.best.misfit < found.stated.misfit / 5
        assert f"say generator.frame_sensor={frame_sensor}" in str(found)


def test_another_axle_and_direction_are_named():
    one = drawn(VerticalVehicle(AM96, speed_m_per_s=50.0, direction="reverse"))
    said = str(elsewhere(VerticalVehicle(AM96, speed_m_per_s=50.0), SETTINGS, one, "forward"))
    assert said.startswith("the train looks to run in reverse: misfit ")
    assert said.endswith("correct `direction`, or `bogie`, in the manifests")


@pytest.mark.every_value
@pytest.mark.parametrize("side", ["mean", "left"])
@pytest.mark.parametrize("effects", [(), FAMILY, (*FAMILY, *OF_THE_TRIP, "second_bending")])
def test_trips_of_richer_trains_are_not_doubted(effects, side):
    for seed, (speed, direction) in enumerate([(25.0, "forward"), (70.0, "reverse")]):
        train = RichTrain.scattered(seed, effects, reverse=direction == "reverse").at(speed)
        wear = np.array([[0.6, 1.2, 0.8, 0.9, 1.1]]) if seed else np.ones((1, 5))
        found = drawn_estimates(train, wear, SETTINGS, seed, side)
        spectra = CrossSpectra(found.auto[0], found.cross[0], found.n_averages)
        one = HealthySpectra(Speeds((speed,), (1.0,)), spectra)
        given = VerticalVehicle(AM96, speed_m_per_s=speed)
        assert elsewhere(given, SETTINGS, one, (None, direction)[seed]) is None


@needs_ttb2d
@pytest.mark.parametrize("frame_sensor", ["axle", "centre"])
def test_healthy_trips_of_a_foreign_train_name_the_place(frame_sensor):
    vehicle = read_vehicles()["manchester"]
    settings = EstimateSettings(minutes=10.0).bound(vehicle)
    generator = VerticalVehicle(vehicle, frame_sensor=frame_sensor)
    found = read_healthy(TTB2D, generator, settings, TripSettings(), n_first=3)
    assert [one.direction for one in found.of_parts] == ["forward"] * 3  # not "in reverse"
    if frame_sensor == "centre":
        assert not found.doubts
        return
    (said,) = found.doubts
    assert said.startswith(f"On 3 of 3 healthy trips {CENTRE}2.")
    assert "instead of 88, with rigid bodies alone; say generator.frame_sensor=centre" in said


@needs_ttb2d
def test_check_of_a_foreign_trip_names_the_place_and_no_other_order():
    found = check_trip(TTB2D / "trip_001.yaml", CheckSettings(read_vehicles()))
    assert found.state == "ready"
    assert found.frame_sensor == "centre"
    assert sum(CENTRE in remark for remark in found.remarks) == 1
    assert not any("order of the channels" in remark for remark in found.remarks)
