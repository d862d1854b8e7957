"""suspnet check and evaluate agree on which trips are read, at every speed of a range."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cli_runner import typed
from speed_ranges import speed_ranges
from trip_fixtures import changed, model_at, write_trips
from vehicles import AM96

from suspnet.cli import check
from suspnet.cli.kinds import read_vehicles
from suspnet.curves.estimates import SPEED_HALF_WIDTH, EstimateSettings
from suspnet.estimation.checkpoint import save_model
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.records import OK
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.jobs.check import CheckSettings, check_trip
from suspnet.trains.pages.check_page import READY, TOO_LITTLE
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.simulation.fleet import Fleet, Scenario
from suspnet.trains.simulation.writing import Simulation, write_fleet
from suspnet.trains.trips.trip import evaluate_trip
from suspnet.vehicle import VerticalVehicle

LOW, HIGH = 61.0, 78.0


@pytest.fixture(scope="module")
def trip(tmp_path_factory):
    """Return the manifest of one healthy trip."""
    return write_trips(tmp_path_factory.mktemp("trip"), speed=70.0)[0]


def models_between(low, high):
    """Return a model for each bin of a range, as precise as one at 70 m/s for reading at all."""
    model = model_at()
    found = []
    for _, speed, half_width in speed_ranges(low, high, SPEED_HALF_WIDTH):
        settings = replace(model.settings, speed_m_per_s=speed, speed_half_width=half_width)
        generator = replace(model.generator, speed_m_per_s=speed)
        found.append(replace(model, settings=settings, generator=generator))
    return found


def run_at(trip, folder, speed, spread):
    """Write a copy of a trip that runs about a speed, a little faster and slower in turn."""
    seconds = np.arange(301.0)
    along = speed * (1 + spread * np.sin(2 * np.pi * seconds / 100))
    name = f"trip_{speed:.3f}_{spread}".replace(".", "_")
    source = {"column": "v", "time": "t", "rate_hz": None}
    return changed(trip, folder, name, {"speed": {"t": seconds, "v": along}}, {"speed": source})


def read_and_checked(trip, folder, models, speed, spread):
    """Return a trip as it is read, and as it is checked with the models and without."""
    path = run_at(trip, folder, speed, spread)
    vehicles = {vehicle.name: vehicle for vehicle in read_vehicles().values()}
    result = evaluate_trip(path, models, TripSettings())
    plain = CheckSettings(vehicles)
    return result, check_trip(path, replace(plain, models=models)), check_trip(path, plain)


@pytest.mark.parametrize(
    ("speed", "spread"),
    [
        (69.1, 0.004),  # where the bins of two models meet
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in ((78.8, 0.004), (69.05, 0.004), (LOW, 0.0), (HIGH, 0.0), (60.4, 0.004))
        ),
    ],
)
def test_check_and_evaluate_agree_at_the_ends_of_bins(tmp_path, speed, spread):
    trip, models = write_trips(tmp_path, speed=speed)[0], models_between(LOW, HIGH)
    result, checked, alone = read_and_checked(trip, tmp_path, models, speed, spread)
    inside = LOW <= speed <= HIGH
    assert (result.status == OK) == inside, result.reason
    assert checked.state == (READY if inside else TOO_LITTLE)
    assert checked.read_by == "the models read 61.0 to 78.0 m/s"
    if inside:
        assert result.quality.segments_used == 28
        assert len(result.quality.speed_bins.split(";")) == 1  # all of it by one model
    else:
        assert result.reason in checked.remarks
        assert f"the trip is run at {speed:.1f} m/s, {checked.read_by}" in result.reason
    assert alone.state == READY
    (part,) = alone.parts
    assert part.speed_m_per_s == pytest.approx(speed, rel=2e-3)


@pytest.fixture(scope="module")
def of_parts(tmp_path_factory):
    """Return folders of two trips each with sensors on both sides, by their length in minutes."""
    folders = {}
    for minutes in (3.0, 5.0):
        fleet = Fleet(n_trips=2, minutes=minutes, rate_hz=200.0, direction="forward")
        parts = ("bushings", "rubber", "guidance", "longitudinal", "bending", "roll")
        family = VerticalVehicle(AM96, parts=parts, sensor_lateral_m=(1.0, 1.0, 1.0))
        simulated = Simulation(fleet, Scenario("healthy", by_part=True), family, scatter=1.0)
        folders[minutes] = tmp_path_factory.mktemp("parts")
        write_fleet(folders[minutes], simulated)
    return folders


def test_check_finds_too_little_where_training_leaves_a_trip_out(of_parts):
    generator, settings = VerticalVehicle(AM96), EstimateSettings().bound(AM96)
    with pytest.raises(TripError, match="for 6 sensors") as left_out:
        read_healthy(of_parts[3.0], generator, settings, TripSettings())
    found = check_trip(of_parts[3.0] / "trip_001.yaml", CheckSettings({"am96": AM96}))
    assert found.state == TOO_LITTLE
    assert found.remarks[-1] in str(left_out.value)
    assert (found.shows_parts, dict(found.least_losses)) == (False, {})


@pytest.mark.slow
def test_losses_that_would_be_named_are_computed_of_the_first_trips_only(
    of_parts, tmp_path, monkeypatch
):
    monkeypatch.setattr(check, "LEAST_TRIPS", 1)
    done = typed(check, of_parts[5.0], "-o", tmp_path / "o", "--no-pictures", cwd=tmp_path)
    trips = json.loads((tmp_path / "o" / "check.json").read_text())["trips"]
    assert [(one["state"], one["shows_parts"]) for one in trips] == [(READY, True)] * 2
    assert [len(one["least_losses"]) for one in trips] == [12, 0]
    assert done.stdout.count("would name") == 1


def test_check_with_a_run_shows_which_trips_its_models_read(trip, tmp_path):
    save_model(tmp_path / "run", model_at())
    trips = tmp_path / "trips"
    trips.mkdir()
    run_at(trip, trips, 71.0, 0.0)
    run_at(trip, trips, 90.0, 0.0)
    options = ["--run", tmp_path / "run", "-o", tmp_path / "o", "--no-pictures"]
    done = typed(check, trips, *options, cwd=tmp_path)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("trips: ")]
    assert (done.returncode, lines) == (0, [])
    assert "1 of 2 trips ready" in done.stdout
    assert "at 71.0 m/s: the model reads 64.4 to 75.6 m/s" in done.stdout
    assert "the trip is run at 90.0 m/s, the model reads 64.4 to 75.6 m/s" in done.stdout
    states = [one["state"] for one in json.loads((tmp_path / "o/check.json").read_text())["trips"]]
    assert states == [READY, TOO_LITTLE]
    missing = typed(check, trips, "--run", tmp_path / "none", cwd=tmp_path)
    assert missing.returncode == 1
    assert "run=" in missing.stderr
    assert "Traceback" not in missing.stderr
