"""train.py healthy=DIR: a run on commissioned trips, and one clear line for each mistake."""

import json
import logging
from pathlib import Path

import pytest
from cli_runner import QUIET, run_program
from fitted_at_once import fitted_at_once
from trip_fixtures import changed, small_fleet
from vehicles import AM96

from suspnet.cli import train
from suspnet.estimation.checkpoint import load_model
from suspnet.ground.parameters import PARAMETERS
from suspnet.trains.identification import healthy_trips
from suspnet.trains.jobs import commissioning as run
from suspnet.trains.simulation.fleet import Fleet, Scenario
from suspnet.trains.simulation.writing import Simulation, write_fleet
from suspnet.vehicle import VerticalVehicle

pytestmark = pytest.mark.usefixtures("blank", "healthy_trips_read_once")
FEW = ["data.n_train=100", "data.n_test=20", "data.n_calibrate=null", *QUIET]
TRIPS = [*FEW, "experiment=trips", "data.minutes=5", "data.segment_s=5", "model=linear"]


@pytest.fixture(scope="module")
def fleet():
    """Return a folder of three trips of 5 minutes."""
    return small_fleet()[0].parent


@pytest.fixture
def folder(fleet, tmp_path):
    """Return a folder of three trips whose manifests may be changed."""
    trips = tmp_path / "trips"
    trips.mkdir()
    for path in sorted(fleet.glob("*.yaml"))[:3]:
        changed(path, trips, path.stem)
    return trips


@pytest.fixture(scope="module")
def separate(tmp_path_factory):
    """Return a folder of three trips with sensors on both sides."""
    folder = tmp_path_factory.mktemp("separate")
    parts = ("bushings", "rubber", "guidance", "longitudinal", "bending", "roll")
    family = VerticalVehicle(AM96, parts=parts, sensor_lateral_m=(1.0, 1.0, 1.0))
    healthy = Scenario("healthy", by_part=True)
    fleet = Fleet(n_trips=3, minutes=5.0, rate_hz=200.0)
    write_fleet(folder, Simulation(fleet, healthy, family, scatter=1.0))
    return folder


@pytest.fixture
def fitted(monkeypatch):
    """Put a bogie at its prior in the place of every fit, which would take long; return it."""

    def fit(vehicle, trips, *_, **__):
        return fitted_at_once(vehicle, trips, fit.converged)

    fit.converged = True
    monkeypatch.setattr(run, "commission_bogie", fit)
    return fit


def test_run_on_healthy_trips_has_page_posterior_and_notes(fitted, folder, tmp_path):
    assert run_program(train, tmp_path / "run", *TRIPS, f"healthy={folder}") == 0
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"commissioning.html", "commissioning.json", "model.json", "metrics.json"} <= names
    model = load_model(tmp_path / "run")
    vehicle = model.bogie.generator
    assert vehicle.sensors == ("axle_box_axle1_middle", "frame_axle1_middle", "body_middle")
    assert model.bogie.outputs == model.healthy.names == PARAMETERS
    assert len(model.bogie.scatter.noise) == 4
    notes = model.training["commissioned"]
    assert notes["trips"] == sorted(path.stem for path in folder.glob("*.yaml"))
    assert notes["n_trips"] == 3
    assert notes["misfit"] == 1.02
    assert notes["converged"] is True
    content = json.loads((tmp_path / "run" / "commissioning.json").read_text())
    assert content["verdict"][0].endswith("are read as one: the misfit is 1.02 times the noise.")
    assert {"healthy_k_p", "bogie_gyration"} <= {one["name"] for one in content["numbers"]}


def test_run_goes_on_with_a_warning_if_the_search_did_not_end(fitted, folder, tmp_path, caplog):
    fitted.converged = False
    with caplog.at_level(logging.WARNING):
        assert run_program(train, tmp_path / "run", *TRIPS, f"healthy={folder}") == 0
    assert "The search for the bogie did not end" in caplog.text
    assert load_model(tmp_path / "run").training["commissioned"]["converged"] is False
    assert 'class="result notice"' in (tmp_path / "run" / "commissioning.html").read_text()


def test_parts_that_are_named_are_the_vehicles(fitted, folder, tmp_path):
    given = [*TRIPS, f"healthy={folder}", "generator.parts=[bushings]"]
    assert run_program(train, tmp_path / "run", *given) == 0
    assert load_model(tmp_path / "run").bogie.generator.parts == ("bushings", "roll")


def test_settings_of_regressions_are_named_as_without_effect(fitted, folder, tmp_path, caplog):
    given = [*TRIPS, f"healthy={folder}", "model=svr", "speed_m_per_s=60"]
    with caplog.at_level(logging.WARNING):
        assert run_program(train, tmp_path / "run", *given) == 0
    assert "reads trips itself: model, speed_m_per_s" in caplog.text


@pytest.mark.parametrize("parts", [[], ["generator.parts=[air_spring]"]])
def test_parts_that_are_named_are_of_no_effect_where_each_is_read(
    fitted, separate, tmp_path, caplog, monkeypatch, parts
):
    # what takes longest: the page, and other places of the sensors
    monkeypatch.setattr(train, "write_outcome", lambda *_: None)
    monkeypatch.setattr(healthy_trips, "elsewhere", lambda *_: None)
    given = [*FEW, "experiment=trips", f"healthy={separate}", *parts]
    with caplog.at_level(logging.WARNING):
        assert run_program(train, tmp_path / "run", *given) == 0
    assert "air_spring" not in load_model(tmp_path / "run").bogie.generator.parts
    words = "without effect, as the sensors show each part: generator.parts=[air_spring]"
    assert (words in caplog.text) == bool(parts)


def test_no_speed_is_for_healthy_trips(folder, tmp_path):
    said = run_program(train, tmp_path / "none", *TRIPS, "speed_m_per_s=null")
    assert said == (
        "error: speed_m_per_s=null is for healthy=DIR, whose trips show the speeds; give a speed"
    )


@pytest.mark.representatives(3)
@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["experiment=trips", "healthy=nowhere"], "there is no folder nowhere"),
        (["experiment=trips", "generator=quarter_car"], "cannot be commissioned as a QuarterCar"),
        (["experiment=trips", "vehicle=sedan"], "cannot be commissioned as a QuarterCar"),
        ([], "healthy= is for models that read trips: leave experiment= out"),
        (["experiment=trips", "n_healthy=2"], "`n_healthy` must be a whole number >= 3 or null"),
        (["experiment=trips", "vehicle=ice3"], "the trip is of vehicle 'am96', vehicle=ice3"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(overrides, words, folder, tmp_path):
    given = [*FEW, *overrides]
    if not any(one.startswith("healthy=") for one in given):
        given.append(f"healthy={folder}")
    said = run_program(train, tmp_path / "run", *given)
    assert said.startswith("error: ")
    assert words in said
    assert "\n" not in said
    assert list((tmp_path / "run").iterdir()) == []


def test_too_few_trips_leave_nothing(folder, tmp_path):
    Path(sorted(folder.glob("*.yaml"))[0]).unlink()
    given = [*TRIPS, f"healthy={folder}", "speed_m_per_s=70"]
    said = run_program(train, tmp_path / "run", *given)
    assert "2 healthy trips can be used, at least 3 are needed" in said
    assert list((tmp_path / "run").iterdir()) == []
