"""Trips run in reverse: read by models of their direction, found by their phases, or asked for."""

import numpy as np
import pytest
import torch
from trip_fixtures import RATES_HZ, changed, model_at, recalled_trip, write_trips
from vehicles import AM96

from suspnet.curves.cross_spectra import PAIRS, CrossSpectra
from suspnet.curves.estimates import EstimateSettings
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.sensors.plausibility import DIRECTION_MARGIN, shown_direction
from suspnet.trains.simulation import Scenario
from suspnet.trains.trips.trip import evaluate_trip
from suspnet.vehicle import PARAMETERS, VerticalVehicle

SETTINGS = TripSettings()
PARTS = ("bushings", "rubber", "guidance", "longitudinal", "bending")
FREQUENCIES = torch.arange(0.05, 20, 0.05, dtype=torch.float64)


@pytest.fixture(scope="module")
def both_ways(tmp_path_factory):
    """Return the manifests of four worn trips, the second and the fourth run in reverse."""
    folder, wear = tmp_path_factory.mktemp("both"), Scenario("worn", spread=0.3)
    return write_trips(folder / "trips", 4, wear, seed=2, direction="both")


@pytest.fixture(scope="module")
def models():
    return [model_at(), model_at(n_train=400, n_calibrate=100, direction="reverse")]


def exact(generator, ratios):
    """Return the spectra of a noiseless trip of a vehicle."""
    channels = generator.channels(ratios, FREQUENCIES)[0]
    auto = channels.abs().square().sum(dim=0)
    cross = torch.stack([(channels[:, x].conj() * channels[:, y]).sum(dim=0) for x, y in PAIRS])
    return CrossSpectra(auto, cross, 100.0)


# reference


def test_manifests_alternate(both_ways):
    found = [read_manifest(path).direction for path in both_ways]
    assert found == ["forward", "reverse", "forward", "reverse"]


@pytest.mark.parametrize("i", [1, *(pytest.param(i, marks=pytest.mark.slow) for i in (0, 2, 3))])
def test_trips_of_both_directions_are_as_close_to_the_truth(both_ways, models, i):
    result = recalled_trip(both_ways[i], models, SETTINGS)
    assert result.status == "ok", result.reason
    truth = read_manifest(both_ways[i]).truth
    for name in PARAMETERS[:4]:
        half = result.half_widths[name]
        assert abs(np.log(result.estimates[name] / truth[name])) < 2.5 * half
    assert not result.flags
    assert (" in reverse: " in result.quality.speed_bins) == bool(i % 2)
    assert result.quality.direction == ("forward", "reverse")[i % 2]


@pytest.mark.parametrize("i", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_direction_that_is_not_said_is_found(both_ways, models, tmp_path, i):
    silent = changed(both_ways[i], tmp_path, direction=None)
    assert read_manifest(silent).direction is None
    found, said = (
        evaluate(path, models, SETTINGS)
        for path, evaluate in ((silent, evaluate_trip), (both_ways[i], recalled_trip))
    )
    assert found.estimates == said.estimates
    assert found.quality.speed_bins == said.quality.speed_bins


@pytest.mark.representatives(2)
@pytest.mark.parametrize("speed", [20.0, 45.0, 83.0])
@pytest.mark.parametrize("bogie", ["leading", "trailing"])
def test_phases_show_the_direction_of_worn_vehicles(speed, bogie):
    generator = VerticalVehicle(AM96, speed_m_per_s=speed, bogie=bogie, parts=PARTS)
    rng = np.random.default_rng(int(speed))
    for direction in ("forward", "reverse"):
        for _ in range(5):
            ratios = torch.ones(1, 5, dtype=torch.float64)
            ratios[0, :4] = torch.as_tensor(np.exp(rng.uniform(np.log(0.5), np.log(1.6), 4)))
            ratios[0, 4] = rng.uniform(0.9, 1.25)
            spectra = exact(generator.running(direction), ratios)
            found, factor = shown_direction(spectra, FREQUENCIES, generator)
            assert found == direction
            assert factor > DIRECTION_MARGIN


@pytest.mark.slow
def test_healthy_trips_have_their_direction_said_or_not(both_ways, tmp_path):
    settings = EstimateSettings(rates_hz=RATES_HZ, minutes=5.0).bound(AM96)
    said = read_healthy(both_ways[0].parent, VerticalVehicle(AM96), settings, SETTINGS)
    expected = ["forward", "reverse", "forward", "reverse"]
    assert [trip.direction for trip in said.of_parts] == expected
    for i, path in enumerate(both_ways):
        changed(path, tmp_path, f"trip_{i}", direction=None)
    found = read_healthy(tmp_path, VerticalVehicle(AM96), settings, SETTINGS)
    assert [trip.direction for trip in found.of_parts] == expected


# failure


def test_wrong_direction_is_refused(both_ways, models, tmp_path):
    wrong = changed(both_ways[1], tmp_path, direction="forward")
    found = evaluate_trip(wrong, models, SETTINGS)
    assert found.status == "error"
    assert "phases fit a train that runs in reverse" in found.reason
    assert "check `direction`, `bogie` and `axle`" in found.reason
    # likewise where nothing is said and all models are of the other direction
    silent = changed(both_ways[1], tmp_path, "silent", direction=None)
    assert "runs in reverse" in evaluate_trip(silent, models[:1], SETTINGS).reason


def test_models_of_the_other_direction_are_refused(both_ways, models):
    found = evaluate_trip(both_ways[1], models[:1], SETTINGS)
    assert found.status == "error"
    assert found.reason == (
        "the trip was run in reverse, the models are for trips forward: "
        "train with -m generator.direction=forward,reverse"
    )


def test_direction_is_asked_for_where_the_phases_do_not_show_it(
    both_ways, models, tmp_path, monkeypatch
):
    monkeypatch.setattr("suspnet.trains.identification.direction.DIRECTION_MARGIN", 1e6)
    silent = changed(both_ways[0], tmp_path, direction=None)
    found = evaluate_trip(silent, models, SETTINGS)
    assert found.status == "error"
    assert "forward or in reverse" in found.reason
    assert "give `direction: forward` or `direction: reverse`" in found.reason


def test_manifest_with_another_word_is_refused(both_ways, tmp_path):
    found = evaluate_trip(changed(both_ways[0], tmp_path, direction="back"), [model_at()], SETTINGS)
    assert found.status == "error"
    assert "`direction` must be" in found.reason
