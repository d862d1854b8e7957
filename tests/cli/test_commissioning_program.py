"""train.py healthy=DIR: a run on commissioned trips, and one clear line for each mistake."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest
from cli_runner import QUIET, run_main, run_program
from commissioned_example import UNCERTAIN, commissioned_example
from omegaconf import OmegaConf
from trip_fixtures import changed, small_fleet

from suspnet.cli import train
from suspnet.curves.estimates import WIDE_SPEED_HALF_WIDTH
from suspnet.curves.speeds import SpeedRange, range_words
from suspnet.estimation.checkpoint import load_model
from suspnet.ground.storage import write_json
from suspnet.trains.jobs import commissioning as run

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


@pytest.fixture
def fitted(monkeypatch):
    """Put the example's vehicle in the place of every fit, which would take long."""
    outcome = commissioned_example()[1]
    monkeypatch.setattr(run, "commission", lambda *_, **__: outcome)
    return outcome


def test_run_on_healthy_trips_has_page_posterior_and_notes(fitted, folder, tmp_path):
    metrics = run_main(train, tmp_path / "run", *TRIPS, f"healthy={folder}")
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"commissioning.html", "commissioning.json", "model.json", "metrics.json"} <= names
    model = load_model(tmp_path / "run")
    assert model.generator.distribution == fitted.posterior
    assert model.generator.parts == ("bushings",)
    notes = model.training["commissioned"]
    assert notes == metrics["training"]["commissioned"]
    assert notes["trips"] == sorted(path.stem for path in folder.glob("*.yaml"))
    assert notes["n_trips"] == 3
    assert notes["misfit"] == fitted.misfit
    assert notes["converged"] is True
    content = json.loads((tmp_path / "run" / "commissioning.json").read_text())
    assert {one["name"] for one in content["numbers"]} == set(UNCERTAIN)


def test_run_goes_on_with_a_warning_if_one_start_alone_found_the_vehicle(
    fitted, folder, tmp_path, monkeypatch, caplog
):
    spoilt = replace(fitted, n_agree=1, converged=False)
    monkeypatch.setattr(run, "commission", lambda *_, **__: spoilt)
    trained = []
    monkeypatch.setattr(
        train, "train", lambda *_, **options: trained.append(options["context"].notes)
    )
    with caplog.at_level(logging.WARNING):
        assert run_program(train, tmp_path / "run", *TRIPS, f"healthy={folder}") == 0
    assert trained[0]["commissioned"]["n_trips"] == 3
    assert trained[0]["commissioned"]["converged"] is False
    said = [r.getMessage() for r in caplog.records if r.name == "suspnet.trains.jobs.commissioning"]
    assert "did not converge" in said[0]
    assert "no other one found this vehicle" in said[1]
    assert 'class="result notice"' in (tmp_path / "run" / "commissioning.html").read_text()


@pytest.mark.representatives(3)
@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["experiment=trips", "healthy=nowhere"], "there is no folder nowhere"),
        (["experiment=trips", "generator=quarter_car"], "cannot be commissioned as a QuarterCar"),
        (["experiment=trips", "vehicle=sedan"], "cannot be commissioned as a QuarterCar"),
        ([], "healthy= is for models that read trips: experiment=trips"),
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


@pytest.mark.representatives(1)
@pytest.mark.parametrize("speed", ["70", "[60,80]"])
def test_too_few_trips_leave_nothing(speed, folder, tmp_path):
    Path(sorted(folder.glob("*.yaml"))[0]).unlink()
    given = [*TRIPS, f"healthy={folder}", f"speed_m_per_s={speed}"]
    said = run_program(train, tmp_path / "run", *given)
    assert "2 healthy trips can be used, at least 3 are needed" in said
    assert list((tmp_path / "run").iterdir()) == []


@pytest.fixture
def problems(monkeypatch):
    """Train and draw nothing; return what would be trained."""
    asked = []

    def train_nothing(problem, model, folder, **options):
        asked.append(problem)
        metrics = {"rms_percent": {}, "scores": {}, "intervals": {}, "seconds": 0.0}
        write_json(folder / "metrics.json", metrics)
        return metrics

    monkeypatch.setattr(train, "train", train_nothing)
    monkeypatch.setattr(train, "write_outcome", lambda *_: None)
    return asked


def test_speeds_of_the_healthy_trips_are_the_default(fitted, problems, folder, tmp_path, caplog):
    assert run_program(train, tmp_path / "one", *TRIPS, f"healthy={folder}") == 0
    (problem,) = problems
    assert problem.generator.speed_m_per_s == problem.settings.speed_m_per_s == 70.0
    assert problem.settings.speed_half_width == WIDE_SPEED_HALF_WIDTH
    assert OmegaConf.load(tmp_path / "one" / "config.yaml").speed_m_per_s is None
    for path, speed in zip(sorted(folder.glob("*.yaml")), (62.0, 69.1, 77.0), strict=True):
        changed(path, folder, path.stem, speed=speed)
    given = [*TRIPS, f"healthy={folder}"]
    problems.clear()
    assert run_program(train, tmp_path / "wide", *given) == 0
    assert [one.generator.speed_m_per_s for one in problems] == [69.7]
    # several models where one does not read all speeds
    problems.clear()
    given.append("data.speed_half_width=0.08")
    with caplog.at_level(logging.INFO):
        assert run_program(train, tmp_path / "several", *given) == 0
        assert "healthy trips at 62.0 to 77.0 m/s: speed_m_per_s=[60,79]" in caplog.text
        ranges = [
            SpeedRange.around(one.generator.speed_m_per_s, one.settings.speed_half_width)
            for one in problems
        ]
        assert range_words(ranges) == "60.0 to 79.0 m/s"
        given.append(f"resume={tmp_path / 'several'}")
        assert run_program(train, tmp_path / "several", *given) == 0
        assert "finished before" in caplog.text
    assert len(problems) == len(ranges) == 2


def test_speed_that_is_given_is_taken(fitted, problems, folder, tmp_path):
    given = [*TRIPS, f"healthy={folder}", "speed_m_per_s=50"]
    assert run_program(train, tmp_path / "run", *given) == 0
    assert problems[0].generator.speed_m_per_s == 50.0
    said = run_program(train, tmp_path / "none", *TRIPS, "speed_m_per_s=null")
    assert said == (
        "error: speed_m_per_s=null is for healthy=DIR, whose trips show the speeds; give a speed"
    )
