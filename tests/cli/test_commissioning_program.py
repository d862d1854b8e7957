"""train.py healthy=DIR: a run on commissioned trips, and one clear line for each mistake."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest
from cli_runner import SMALL, run_main, run_program
from commissioned_example import UNCERTAIN, commissioned_example
from trip_fixtures import changed, small_fleet

from suspnet.cli import train
from suspnet.commissioning import run
from suspnet.model import load_model

TRIPS = [*SMALL, "experiment=trips", "data.minutes=5", "data.segment_s=5", "model=linear"]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Return a folder of three trips of 5 minutes."""
    return small_fleet(tmp_path_factory)[0].parent


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
    content = json.loads((tmp_path / "run" / "commissioning.json").read_text())
    assert {one["name"] for one in content["numbers"]} == set(UNCERTAIN)


def test_run_goes_on_with_a_warning_if_one_start_alone_found_the_vehicle(
    fitted, folder, tmp_path, monkeypatch, caplog
):
    spoilt = replace(fitted, n_agree=1, converged=False)
    monkeypatch.setattr(run, "commission", lambda *_, **__: spoilt)
    trained = []
    monkeypatch.setattr(train, "train", lambda *_, **options: trained.append(options["notes"]))
    with caplog.at_level(logging.WARNING):
        assert run_program(train, tmp_path / "run", *TRIPS, f"healthy={folder}") == 0
    assert trained[0]["commissioned"]["n_trips"] == 3
    said = [r.getMessage() for r in caplog.records if r.name == "suspnet.commissioning.run"]
    assert "did not converge" in said[0]
    assert "no other one found this vehicle" in said[1]
    assert 'class="result notice"' in (tmp_path / "run" / "commissioning.html").read_text()


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
    given = [*SMALL, *overrides]
    if not any(one.startswith("healthy=") for one in given):
        given.append(f"healthy={folder}")
    said = run_program(train, tmp_path / "run", *given)
    assert said.startswith("error: ")
    assert words in said
    assert "\n" not in said
    assert list((tmp_path / "run").iterdir()) == []


@pytest.mark.parametrize("speed", ["70", "[60,80]"])
def test_too_few_trips_leave_nothing(speed, folder, tmp_path):
    Path(sorted(folder.glob("*.yaml"))[0]).unlink()
    given = [*TRIPS, f"healthy={folder}", f"speed_m_per_s={speed}"]
    said = run_program(train, tmp_path / "run", *given)
    assert "2 healthy trips can be used, at least 3 are needed" in said
    assert list((tmp_path / "run").iterdir()) == []
