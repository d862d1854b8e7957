"""Recordings with sensors on both sides as spectral matrices: layouts, whole trips, bad input."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commissioned_example import NO_SCATTER
from rich_effects import FAMILY
from rich_train import RichTrain
from rich_train_trips import write_train_trips
from rich_trips import SENSORS
from vehicles import AM96

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import NoEstimateError
from suspnet.curves.welch import Welch
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding
from suspnet.ground.parameters import COMPONENTS
from suspnet.trains.fits.bogie_fit import PartsEstimate, commission_bogie, fit_parts
from suspnet.trains.identification import bogie_trips
from suspnet.trains.identification.bogie_trips import (
    SPACING_HZ,
    bogie_trip,
    bogie_vehicle,
    estimate_parts,
    sensor_places,
)
from suspnet.trains.identification.direction import direction_of
from suspnet.trains.identification.from_recording import read_trip
from suspnet.trains.identification.healthy_trips import HealthyTrips
from suspnet.trains.jobs import commissioning
from suspnet.trains.jobs.commissioning import commission_parts
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.manifest_sources import SensorSource
from suspnet.trains.recordings.recording import joined, load_recording
from suspnet.trains.recordings.sensor import SensorSignal
from suspnet.trains.sensors.sensor_health import sensor_health
from suspnet.trains.simulation import Fleet
from suspnet.trains.spectra.segments import recording_segments
from suspnet.trains.spectra.wheel_lines import WheelLine
from suspnet.vehicle import SpatialVehicle, VerticalVehicle
from suspnet.vehicle.quantities import show_parts

PARTS = (
    "bushings",
    "rubber",
    "guidance",
    "longitudinal",
    "bending",
    "payload",
    "sensors",
    "frame_sway",
    "frame_yaw",
    "body_yaw",
    "creep",
)
VEHICLE = SpatialVehicle(AM96, parts=PARTS, distribution="prior")
RATE_HZ = 100.0


def recordings(folder, ratios, minutes, effects=(*FAMILY, "unequal"), sides="pair"):
    """Return recordings of trips of a train whose parts differ, stepped in time."""
    fleet = Fleet(n_trips=len(ratios), minutes=minutes, sensors=SENSORS)
    train = RichTrain.scattered(0, effects)
    paths = write_train_trips(folder, train, ratios, fleet, 0, sides)
    return [load_recording(read_manifest(path), RATE_HZ) for path in paths]


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    return recordings(tmp_path_factory.mktemp("short"), np.ones((1, 13)), 12.0)[0]


def test_bins_averages_and_speed_are_those_of_the_recording(short):
    trip = bogie_trip(short, VEHICLE)
    spacing = trip.frequencies_hz.diff()
    torch.testing.assert_close(spacing, torch.full_like(spacing, SPACING_HZ))
    assert trip.spectra.values.shape == (len(trip.frequencies_hz), 6, 6)
    assert trip.spectra.n_averages == pytest.approx(27, abs=3)  # of 12 minutes in bands of .04 Hz
    assert trip.speed_m_per_s == pytest.approx(70.0, abs=0.5)
    usable = short.speed_m_per_s[short.usable]
    assert trip.speed_scatter == pytest.approx(usable.std() / usable.mean(), rel=0.2)
    assert trip.frequencies_hz[trip.left_out].tolist() == pytest.approx([16.5, 16.6, 16.7, 16.8])


def test_bins_with_lines_of_wheels_are_left_out(short, monkeypatch):
    line = WheelLine("axle_box left", 1, 10.0 / 70.0, 0.9, 0.1, 0.4, 70.0, 1e4)
    monkeypatch.setattr(bogie_trips, "wheel_lines", lambda recording: (line,))
    trip = bogie_trip(short, VEHICLE)
    held = trip.frequencies_hz[trip.left_out]
    held = held[held < 16.0]  # those above hold the hum of mains
    assert 0 < len(held) < 10
    assert float((held - 10.0).abs().max()) < 0.5
    kept = trip.frequencies_hz[trip.of(torch.arange(len(trip.frequencies_hz)))]
    assert float((kept - 10.0).abs().min()) > 0.02


def test_sensors_come_in_the_order_of_the_vehicle(short):
    turned = SpatialVehicle(
        AM96,
        parts=PARTS,
        sensors=("body_left", "axle_box_axle1_right", "frame_axle1_left", "body_right"),
    )
    found, every = bogie_trip(short, turned).spectra, bogie_trip(short, VEHICLE).spectra
    order = [VEHICLE.sensors.index(place) for place in turned.sensors]
    torch.testing.assert_close(found.values, every.values[:, order][:, :, order])


def test_sensors_of_other_places_are_missing(short):
    other = SpatialVehicle(AM96, parts=PARTS, sensors=("axle_box_axle2_left", "body_left"))
    with pytest.raises(NoEstimateError, match="no sensor at axle_box_axle2_left"):
        bogie_trip(short, other)


def test_single_sensors_name_no_part(tmp_path):
    (single,) = recordings(tmp_path, np.ones((1, 13)), 1.0, ("roll",), sides="mean")
    with pytest.raises(NoEstimateError, match="no sensor at axle_box_axle1_left"):
        bogie_trip(single, VEHICLE)


@pytest.mark.parametrize("converged", [True, False])
def test_search_that_did_not_end_is_told(short, monkeypatch, caplog, converged):
    bogie = CommissionedBogie(VEHICLE, torch.ones(6), np.ones(3), 1.0, converged, NO_SCATTER)
    monkeypatch.setattr(commissioning, "commission_bogie", lambda *_, **__: bogie)
    trips = (bogie_trip(short, VEHICLE),) * 3
    healthy = HealthyTrips((short.manifest,) * 3, VEHICLE, trips, (True,) * 3)
    with caplog.at_level("WARNING"):
        found = commission_parts(healthy, TripSettings())
    assert found is bogie
    assert ("wrong ones may be named" in caplog.text) == (not converged)


@pytest.mark.parametrize(
    ("converged", "misfit", "reason"),
    [
        (True, 15.1, ""),  # its errors are in the intervals
        (False, 1.0, Finding("healthy-search-unfinished")),
    ],
)
def test_parts_read_with_a_doubtful_bogie_are_flagged(
    short, monkeypatch, converged, misfit, reason
):
    trip = SimpleNamespace(lost=("frame_axle1_left", "axle_box_axle2_left"))
    monkeypatch.setattr(bogie_trips, "bogie_trip", lambda *_: trip)
    parts = PartsEstimate(np.ones(13), 1e-4 * np.eye(13), 1.0, True, 0.9)
    monkeypatch.setattr(bogie_trips, "fit_parts", lambda *_, **__: parts)
    bogie = CommissionedBogie(VEHICLE, torch.ones(6), np.ones(3), misfit, converged, NO_SCATTER)
    estimate = estimate_parts(bogie, short, TripSettings(check_channels=False))
    (found,) = estimate.flags.reasons
    assert found.startswith(reason)
    assert bool(found) == bool(reason)
    assert estimate.misfit == parts.misfit
    # as the manifest names them, or by the place where it has no sensor
    assert estimate.lost == ("bogie left", "axle_box_axle2_left")


@pytest.mark.parametrize(("misfit", "converged"), [(3.1, True), (np.nan, True), (1.0, False)])
def test_a_trip_unlike_the_healthy_ones_is_flagged_and_its_verdict_stands(
    short, monkeypatch, misfit, converged
):
    monkeypatch.setattr(bogie_trips, "bogie_trip", lambda *_: SimpleNamespace(lost=()))
    values = np.ones(13)
    values[COMPONENTS.index("c_s_left")] = 0.5
    parts = PartsEstimate(values, 1e-4 * np.eye(13), misfit, converged, 0.9)
    monkeypatch.setattr(bogie_trips, "fit_parts", lambda *_, **__: parts)
    bogie = CommissionedBogie(VEHICLE, torch.ones(6), np.ones(3), 1.0, True, NO_SCATTER)
    estimate = estimate_parts(bogie, short, TripSettings(check_channels=False))
    assert estimate.flags.has("misfit").all()
    assert ("unlike the healthy ones" in estimate.flags.reasons[0]) == converged
    assert ("secondary damper, left" in estimate.found) == np.isfinite(misfit)


def test_a_short_trip_is_read_from_shorter_segments(short):
    kept = round(5.5 * 60 * RATE_HZ)
    usable = short.usable & (np.arange(len(short.usable)) < kept)
    trip, whole = bogie_trip(replace(short, usable=usable), VEHICLE), bogie_trip(short, VEHICLE)
    np.testing.assert_allclose(trip.frequencies_hz, whole.frequencies_hz, rtol=1e-12)
    assert trip.spectra.n_averages > 10
    np.testing.assert_allclose(sizes(trip), sizes(whole), rtol=0.2)


@pytest.mark.parametrize("name", ["bogie left", "body right", "axle_box left"])
def test_a_sensor_that_breaks_the_trip_up_is_left_out(short, name):
    every = bogie_trip(short, VEHICLE)
    n, minute = len(short.usable), round(60 * RATE_HZ)
    loose, one_second = np.zeros((2, n), dtype=np.bool_)
    for start in range(0, n, minute):
        loose[start : start + 500] = True
    one_second[200:300] = True
    faulty = {name: loose, "bogie right": one_second}
    broken = replace(short, usable=short.usable & ~loose & ~one_second, faulty=faulty)
    trip = bogie_trip(broken, VEHICLE)
    channel, side = name.split()
    place = {"bogie": "frame_axle1", "body": "body", "axle_box": "axle_box_axle1"}[channel]
    assert trip.lost == (f"{place}_{side}",)
    assert every.lost == ()
    kept = [i for i, one in enumerate(VEHICLE.sensors) if one not in trip.lost]
    np.testing.assert_allclose(sizes(trip), sizes(every)[kept], rtol=0.1)
    # without it the trip is usable but for what is wrong with the other one
    rest = broken.without(name)
    np.testing.assert_array_equal(rest.usable, short.usable & ~one_second)
    assert rest.dead == (name,)
    assert list(rest.sensors()) == [one for one in short.sensors() if one != name]
    for one, signal in rest.sensors().items():
        np.testing.assert_allclose(signal, short.sensors()[one], rtol=1e-12, atol=1e-12)


def test_a_short_or_slow_trip_has_no_estimate(tmp_path, short):
    # shorter than two segments of 60 s, and than the five that give more than twelve averages
    for minutes, words in ((1.2, "at least 3.0 are needed"), (2.6, "3.0 are needed, 0.")):
        (one,) = recordings(tmp_path / f"{minutes}", np.ones((1, 13)), minutes, ("roll",))
        with pytest.raises(NoEstimateError, match=f"of 60 s or more .*{words}"):
            bogie_trip(one, VEHICLE)
    with pytest.raises(NoEstimateError, match=r"0\.0 minutes"):
        bogie_trip(short, VEHICLE, TripSettings(min_speed_m_per_s=90.0))


BOXES = [("left", 1), ("right", 1), ("left", 2), ("right", 2)]
SEVEN = {"axle_box": BOXES, "bogie": [("left", 1), ("right", 2)], "body": [("left", None)]}
PLACES_OF_SEVEN = (
    *("axle_box_axle1_left", "axle_box_axle1_right"),
    *("axle_box_axle2_left", "axle_box_axle2_right"),
    *("frame_axle1_left", "frame_axle2_right", "body_left"),
)
SEVEN_VEHICLE = SpatialVehicle(AM96, sensors=PLACES_OF_SEVEN)


def manifest_of(layout):
    """Return the manifest of a trip with sensors at these sides and axles."""
    channels = {
        name: tuple(SensorSource("all.mat", side=side, axle=axle) for side, axle in own)
        for name, own in layout.items()
    }
    names = {"vehicle": "am96", "suspension": "a", "mileage_km": 1.0, "speed": 70.0}
    return TripManifest(path=Path("trip.yaml"), name="trip", channels=channels, **names)


def noisy(layout, dead=()):
    """Return a recording of 30 minutes in which sensor i has noise of a standard deviation i."""
    manifest = manifest_of(layout)
    n, rng = round(1800 * RATE_HZ), np.random.default_rng(0)
    streams = [
        SensorSignal(name, 0.0, 1800.0, 0, i * rng.standard_normal(n), np.zeros(n, bool), ())
        for i, name in enumerate(manifest.sensors(), 1)
        if name not in dead
    ]
    return joined(manifest, streams, None, 0.0, RATE_HZ, dict.fromkeys(dead, "is constant"))


def sizes(trip):
    """Return the standard deviation of each sensor's noise, by the spectra of a trip."""
    return trip.spectra.densities.mean(dim=0).mul(RATE_HZ / 2).sqrt().numpy()


def test_sensors_of_any_layout_are_found_by_their_place():
    assert sensor_places(manifest_of(SEVEN), "axle") == PLACES_OF_SEVEN
    assert sensor_places(manifest_of({"bogie": [("left", 1), ("right", 2)]}), "centre") == (
        *("frame_axle2_right", "frame_centre_left"),
    )
    trip = bogie_trip(noisy(SEVEN), SEVEN_VEHICLE)
    np.testing.assert_allclose(sizes(trip), np.arange(1, 8), rtol=0.05)
    assert trip.lost == ()


@pytest.mark.representatives(2)
@pytest.mark.parametrize("lost", [0, 3, 5, 6])
def test_a_trip_whose_sensor_is_missing_or_dead_is_read_with_the_others(lost):
    names = list(manifest_of(SEVEN).sensors())
    kept = np.delete(np.arange(1, 8), lost)
    trip = bogie_trip(noisy(SEVEN, [names[lost]]), SEVEN_VEHICLE)
    assert trip.lost == (PLACES_OF_SEVEN[lost],)
    np.testing.assert_allclose(sizes(trip), kept, rtol=0.05)


def test_sensors_that_do_not_show_the_parts_name_none():
    assert not show_parts([*PLACES_OF_SEVEN[:2], "body_left"])
    assert not show_parts(["axle_box_axle1_left", "frame_axle1_middle", "body_left"])
    assert show_parts(["axle_box_axle1_left", "frame_axle1_left", "body_left"])
    with pytest.raises(NoEstimateError, match=r"no sensor at .*_axle2_left.* at least 4 of them"):
        bogie_trip(noisy(SEVEN, list(manifest_of(SEVEN).sensors())[2:6]), SEVEN_VEHICLE)


def test_without_a_channel_both_sides_as_equal_are_not_read():
    recording = noisy(SEVEN, ["body"])
    segments, settings = recording_segments(recording, Welch(20.0)), TripSettings()
    generator, estimates = VerticalVehicle(AM96), EstimateSettings()
    method = FittedMethod("none", None, None, generator, estimates, np.zeros(0))
    found = read_trip([(method, segments)], recording, settings)
    assert isinstance(found.estimate, NoEstimateError)
    assert "no sensor at axle 1 gives body; both sides as equal" in str(found.estimate)
    with pytest.raises(TripError, match="without a sensor on body the phases do not show"):
        direction_of(recording, segments, VerticalVehicle(AM96), settings)
    health = sensor_health(recording, VerticalVehicle(AM96), Welch(20.0))
    assert {name: one.faulty for name, one in health.items() if one.faulty} == {"body": 1.0}


def test_healthy_trips_show_the_parts_alike_or_none():
    few = {"axle_box": BOXES[:2], "bogie": [("middle", 1)], "body": SEVEN["body"]}
    of_kinds = bogie_vehicle([*map(manifest_of, [few] * 3)], VerticalVehicle(AM96))
    assert of_kinds.sensors == (*PLACES_OF_SEVEN[:2], "frame_axle1_middle", "body_left")
    assert not of_kinds.shows_parts
    assert not of_kinds.in_middle
    no_frame = {"axle_box": BOXES[:2], "body": SEVEN["body"]}
    assert bogie_vehicle([*map(manifest_of, [no_frame] * 3)], VerticalVehicle(AM96)) is None
    with pytest.raises(TripError, match="healthy trips differ in their sensors"):
        bogie_vehicle([*map(manifest_of, [SEVEN, SEVEN, few])], VerticalVehicle(AM96))


@pytest.mark.slow  # test_bogie_fit.py: drawn spectra of a smaller vehicle
def test_the_worn_part_of_an_unknown_train_is_found_from_recordings(tmp_path):
    ratios = np.ones((6, 13))
    ratios[:, -1] = (1.0, 1.1, 1.05, 1.12, 1.02, 1.07)
    ratios[5, COMPONENTS.index("c_p_axle2_left")] = 0.62
    trips = [bogie_trip(one, VEHICLE) for one in recordings(tmp_path, ratios, 20.0)]
    commissioned = commission_bogie(VEHICLE, trips[:5])
    assert commissioned.misfit < 1.2
    found = fit_parts(commissioned, trips[5])
    errors = found.values / ratios[5] - 1
    springs = np.array([name.startswith("k") for name in COMPONENTS])
    assert np.abs(errors[springs]).max() < 0.01
    assert np.abs(errors).max() < 0.06
