"""Simulated trips of a vehicle with twelve separate springs and dampers."""

import math
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from scipy.signal import csd
from test_simulation import waves
from vehicles import AM96

from suspnet import COMPONENTS
from suspnet.ground.parameters import SIDES
from suspnet.ground.storage import read_json
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.simulation.fleet import EFFECTS, Fleet, Scenario, Trains
from suspnet.trains.simulation.signals import profile_length_m, simulate_trip, steady_journey
from suspnet.trains.simulation.true_vehicle import scattered, true_numbers, with_separate_parts
from suspnet.trains.simulation.writing import Simulation, write_fleet, write_trains
from suspnet.vehicle import QuarterCar, VerticalVehicle

SPEED, RATE_HZ = 60.0, 200.0
FAMILY = VerticalVehicle(
    AM96,
    speed_m_per_s=SPEED,
    parts=("bushings", "rubber", "longitudinal", "bending", "roll"),
    sensor_lateral_m=(1.0, 0.9, 1.1),
)
FADE = {"from_km": 0.0, "to_km": 1000.0, "ratio": 0.5}
CORNER = Scenario("corner", {"c_p_axle2_left": FADE}, mass_low=1.0, mass_high=1.0)
WORN = torch.linspace(0.6, 1.3, 13, dtype=torch.float64)


def fleet(**changes):
    sensors = {name: {"rate_hz": RATE_HZ, "snr_db": None} for name in CHANNELS}
    options = {"n_trips": 2, "last_mileage_km": 1000.0, "minutes": 0.1, "sensors": sensors}
    return Fleet(**(options | {"speed_m_per_s": SPEED} | changes))


def simulation(scenario=CORNER, **changes):
    return Simulation(fleet(**changes), scenario, FAMILY, scatter=1.0)


def signals_of(path):
    """Return the six recordings of a trip, left ones first, (6, n_samples)."""
    tables = [pq.read_table(path.with_suffix("") / f"{name}.parquet") for name in CHANNELS]
    return np.array([table[side].to_numpy() for side in SIDES for table in tables])


# reference


@pytest.mark.parametrize("effects", [(), EFFECTS])
@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_waves_of_each_input_reach_the_sensors_as_the_channels_say(direction, effects):
    vehicle = scattered(with_separate_parts(FAMILY, effects), 1.0, seed=3).running(direction)
    system, journey, rate_hz = vehicle.motion_system(WORN), steady_journey(SPEED, 40.0), 500.0
    met = np.array([[0.9, 3.1, 8.0], [1.2, 5.0, 9.1], [1.6, 4.2, 7.3]])  # mean, cross, alignment
    tracks = [waves(profile_length_m(system, journey), SPEED, f) for f in met]
    found = simulate_trip(system, tracks[0], journey, rate_hz, tracks[1], alignment=tracks[2])
    assert found.shape == (6, 20_000)
    times = np.arange(10_000, 20_000) / rate_hz
    columns = [f(2 * math.pi * w * times) for w in met.ravel() for f in (np.cos, np.sin)]
    fits, *_ = np.linalg.lstsq(np.array(columns).T, found[:, 10_000:].T)
    phasors = (fits[0::2] - 1j * fits[1::2]).reshape(3, 3, 6)
    boxes = [vehicle.sensors.index(f"axle_box_axle1_{side}") for side in SIDES]
    for i, frequencies in enumerate(met):
        expected = vehicle.channels(WORN[None], torch.as_tensor(frequencies))[0, i].numpy().T
        # the size and the phase of the wave under axle 1, which the track alone determines
        omega = 2 * math.pi * frequencies
        size = 1e-3 * omega**2
        if i == 1:
            size *= np.sqrt(1 + (0.4380 * SPEED / omega) ** 2)  # these waves are all of one height
        scaled = np.abs(phasors[i]) / size[:, None]
        np.testing.assert_allclose(scaled, np.abs(expected), rtol=5e-3, atol=1e-9)
        if i < 2:  # the alignment does not reach the axle boxes
            seen = phasors[i][:, boxes[:1]] / expected[:, boxes[:1]]
            np.testing.assert_allclose(phasors[i] / seen, expected, rtol=5e-3, atol=1e-9)


def test_written_trip_has_the_subspace_of_its_true_vehicle(tmp_path):
    (path,) = write_fleet(tmp_path, simulation(n_trips=1, minutes=6.0))
    truth = read_manifest(path).truth
    assert truth["c_p_axle2_left"] == 0.5
    vehicle = scattered(with_separate_parts(FAMILY), 1.0, seed=0)
    signals = signals_of(path)
    frequencies, matrix = csd(
        signals[:, None], signals[None], RATE_HZ, nperseg=8000, detrend=False, axis=-1
    )
    chosen = (frequencies > 0.8) & (frequencies < 9)
    spectra = np.moveaxis(matrix[..., chosen].conj(), -1, 0)  # E[X X^*]
    bins = torch.as_tensor(frequencies[chosen])

    def unexplained(ratios):
        """Return what the six sensors' spectra have outside of the three inputs' responses."""
        row = torch.tensor([[ratios[name] for name in COMPONENTS]], dtype=torch.float64)
        responses = np.moveaxis(vehicle.channels(row, bins)[0].numpy(), -1, 0).transpose(0, 2, 1)
        scale = np.sqrt(np.einsum("fii->fi", spectra).real)
        q, _ = np.linalg.qr(responses / scale[..., None])
        whitened = spectra / scale[:, :, None] / scale[:, None]
        rest = whitened - q @ (q.conj().transpose(0, 2, 1) @ whitened)
        return np.median(np.linalg.norm(rest, axis=(1, 2)) / np.linalg.norm(whitened, axis=(1, 2)))

    assert unexplained(truth) < 0.004
    other = truth | {"c_p_axle2_left": 1.0, "c_p_axle2_right": 0.5}
    assert unexplained(other) > 2 * unexplained(truth)


def test_change_of_a_parameter_is_that_of_each_of_its_parts():
    changes = {"c_p": FADE | {"ratio": 0.8}, "c_p_axle2_left": FADE, "M_s": FADE}
    scenario = Scenario("both", changes, mass_low=1.0, mass_high=1.0)
    found = scenario.ratios(np.array([0.0, 1000.0]), seed=0)
    expected = [1, 0.8, 1, 0.8, 1, 0.4, 1, 0.8, 1, 1, 1, 1, 0.5]
    np.testing.assert_allclose(found, [np.ones(13), expected], rtol=1e-12)


# property


def test_healthy_parts_of_a_kind_differ_by_5_percent():
    vehicle = with_separate_parts(FAMILY)
    drawn = [true_numbers(scattered(vehicle, 1.0, seed)) for seed in range(8)]
    logs = np.log([[one[f"healthy_{name}"]["ratio"] for name in COMPONENTS[:-1]] for one in drawn])
    # 96 draws: standard errors 0.0051 and 0.0036
    assert abs(logs.mean()) < 0.02
    assert logs.std() == pytest.approx(0.05, abs=0.0145)


def test_effects_of_a_scenario_are_among_the_true_numbers(tmp_path):
    flexible = Scenario("flexible", effects=EFFECTS, mass_low=1.0, mass_high=1.0)
    assert flexible.by_part
    (path,) = write_fleet(tmp_path, simulation(flexible, n_trips=1))
    assert set(read_manifest(path).truth) == set(COMPONENTS)
    truth = read_json(tmp_path / "truth.json")
    assert set(EFFECTS) <= set(truth["parts"])
    numbers = {name: number["value"] for name, number in truth["numbers"].items()}
    assert 0 < numbers["track_compliance"] < 4e-8
    assert 0 < abs(numbers["cross_axis_body_left"]) < 0.04
    assert 9 < numbers["second_frequency"] < 18
    assert 0 < numbers["equipment_share"] < 0.4
    other = signals_of(write_fleet(tmp_path / "plain", simulation(n_trips=1))[0])
    # the same track, though not on the same vehicle
    ratio = signals_of(path).std(axis=1) / other.std(axis=1)
    assert (abs(ratio - 1) > 0.01).all()
    assert ((ratio > 0.3) & (ratio < 3)).all()


def test_settings_of_a_fleet_hold_for_parts(tmp_path):
    sensors = {name: {"rate_hz": RATE_HZ, "snr_db": None, "gain": 2.0} for name in CHANNELS}
    scenario = replace(CORNER, mass_low=0.9, mass_high=1.2)
    plain = write_fleet(tmp_path / "plain", simulation(scenario))
    paths = write_fleet(tmp_path / "both", simulation(scenario, direction="both", sensors=sensors))
    manifests = [read_manifest(path) for path in paths]
    assert [one.direction for one in manifests] == ["forward", "reverse"]
    assert manifests[0].truth["M_s"] != manifests[1].truth["M_s"]
    np.testing.assert_allclose(signals_of(paths[0]), 2 * signals_of(plain[0]), rtol=1e-5)
    left, _ = write_fleet(tmp_path / "left", simulation(scenario, sides="left"))
    assert [one.side for one in read_manifest(left).channels.values()] == ["left"] * 3
    body = pq.read_table(left.with_suffix("") / "body.parquet")["acceleration"].to_numpy()
    np.testing.assert_allclose(body, signals_of(plain[0])[2], rtol=1e-3, atol=1e-6)


def test_suspensions_that_do_not_wear_have_healthy_parts(tmp_path):
    trains = Trains(trains=1, cars=1, n_wearing=1)
    folders = write_trains(tmp_path, trains, simulation(n_trips=1))
    wears = read_json(tmp_path / "truth.json")["wearing"]
    for folder in folders:
        truth = read_manifest(folder / "trip_001.yaml").truth
        assert set(truth) == set(COMPONENTS)
        assert truth["c_p_axle2_left"] == (0.5 if folder.name in wears else 1.0)


# failure


def test_vehicle_that_hunts_is_refused():
    fast = with_separate_parts(replace(FAMILY, speed_m_per_s=90.0))
    with pytest.raises(ValueError, match="the vehicle hunts at 90 m/s: its motion does not decay"):
        scattered(fast, 0.0, 0)


@pytest.mark.parametrize(
    ("generator", "message"),
    [
        (
            QuarterCar(AM96),
            "needs a vehicle of known geometry and generator=family, got QuarterCar",
        ),
        (VerticalVehicle(AM96), r"`sensor_lateral_m\[0\]` must be .* > 0"),
    ],
)
def test_vehicle_without_sides_has_no_parts(tmp_path, generator, message):
    with pytest.raises(ValueError, match=message):
        write_fleet(tmp_path, replace(simulation(), generator=generator))
