"""train.py healthy=DIR of several suspensions: a run for each, one that fails stops no other."""

import json
import logging

import pytest
from cli_runner import QUIET, run_composed, run_program
from fitted_at_once import fitted_at_once
from omegaconf import OmegaConf
from trip_fixtures import changed, small_fleet

from suspnet.cli import commission_fleet, folders, train
from suspnet.estimation.checkpoint import load_model
from suspnet.ground import own_files
from suspnet.ground.records import Place
from suspnet.ground.storage import write_json
from suspnet.runs.evaluate import find_runs
from suspnet.trains.jobs import commissioning as run
from suspnet.trains.pages.commissioning_page import as_json
from suspnet.trains.trips.commissionings import models_of, place_of

pytestmark = pytest.mark.usefixtures("blank", "healthy_trips_read_once")
FEW = ["data.n_train=100", "data.n_test=20", "data.n_calibrate=null", *QUIET]
TRIPS = [*FEW, "experiment=trips", "data.minutes=5", "data.segment_s=5", "model=linear"]
PLACES = {"one": Place("S1", "leading", "", "1", "1"), "two": Place("S1", "trailing", "", "1", "1")}


@pytest.fixture(scope="module")
def manifests():
    """Return the manifests of three trips of 5 minutes."""
    return small_fleet()[:3]


@pytest.fixture
def fleet(manifests, tmp_path):
    """Return a folder of two suspensions with three trips each."""
    for name, place in PLACES.items():
        (tmp_path / "fleet" / name).mkdir(parents=True)
        for path in manifests:
            where = {"bogie": place.bogie, "train": place.train, "car": place.car}
            where["axle"] = place.bogie  # the outer ones
            changed(path, tmp_path / "fleet" / name, path.stem, suspension="S1", **where)
    return tmp_path / "fleet"


@pytest.fixture(autouse=True)
def fitted(monkeypatch):
    """Put a bogie at its prior in the place of every fit, which would take long."""
    bogies = []

    def commission(vehicle, trips, *_, **__):
        bogies.append(vehicle.bogie)
        return fitted_at_once(vehicle, trips)

    monkeypatch.setattr(run, "commission_bogie", commission)
    return bogies


@pytest.fixture
def quick(monkeypatch):
    """Draw nothing."""

    def write_numbers(folder, healthy, outcome):
        misfits = [1.0] * len(healthy.of_parts)
        write_json(folder / "commissioning.json", as_json(healthy, outcome, misfits))

    monkeypatch.setattr(train, "write_outcome", write_numbers)


def trained(folder, fleet, *overrides):
    return run_program(train, folder, *TRIPS, f"healthy={fleet}", "workers=1", *overrides)


def stamps(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_each_suspension_has_a_run_of_its_own_as_its_folder_alone_gives(
    fitted, fleet, tmp_path, caplog
):
    folder = tmp_path / "run"
    with caplog.at_level(logging.INFO):
        assert trained(folder, fleet) == 0
    assert fitted == ["leading", "trailing"]
    assert find_runs(folder) == [folder / "one", folder / "two"]
    models = [load_model(one) for one in find_runs(folder)]
    assert [place_of(model) for model in models] == list(PLACES.values())
    assert models_of(models, PLACES["two"]) == models[1:]
    rows = json.loads((folder / "fleet.json").read_text())
    assert [row["suspension"] for row in rows] == ["one", "two"]
    assert rows[0]["place"]["bogie"] == "leading"
    assert rows[0]["n_trips"] == 3
    assert "2 suspensions in" in caplog.text
    assert "| two " in caplog.text
    for name in PLACES:
        assert {"commissioning.html", "metrics.json", "train.log"} <= {
            path.name for path in (folder / name).iterdir()
        }
        assert "-> " in (folder / name / "train.log").read_text()
    saved = OmegaConf.load(folder / "two" / "config.yaml")
    assert (saved.healthy, saved.generator.bogie) == (str(fleet / "two"), "trailing")
    assert (saved.generator.axle, models[1].generator.axle) == ("trailing", "trailing")
    assert models[0].generator.axle == "leading"
    assert OmegaConf.load(folder / "config.yaml").healthy == str(fleet)
    run_composed(
        train, tmp_path / "two", *TRIPS, f"healthy={fleet / 'two'}", "generator.bogie=trailing"
    )
    for name in ("model.safetensors", "config.yaml"):
        alone, of_all = ((tmp_path / x / name).read_bytes() for x in ("two", "run/two"))
        assert alone.replace(b"workers: 2", b"workers: 1") == of_all


def test_each_suspension_may_have_its_own_number_of_healthy_trips(quick, fleet, tmp_path):
    assert commission_fleet.first_trips(7, ["one", "two"]) == {"one": 7, "two": 7}
    assert trained(tmp_path / "run", fleet, "n_healthy={two:4,one:3}") == 0
    for name, number in (("one", 3), ("two", 4)):
        assert OmegaConf.load(tmp_path / "run" / name / "config.yaml").n_healthy == number


def test_failing_suspension_is_told_and_stops_no_other(quick, fleet, tmp_path, caplog):
    next((fleet / "one").glob("*.yaml")).unlink()
    (fleet / "empty").mkdir()
    folder = tmp_path / "run"
    said = trained(folder, fleet)
    assert said == (
        f"error: 2 of 3 suspensions are not trained (empty, one); the same command with "
        f"resume={folder} tries these again"
    )
    assert "one is not trained: " in caplog.text
    assert "2 healthy trips can be used, at least 3 are needed" in caplog.text
    assert "empty is not trained: " in caplog.text
    assert "at least 3 are needed" in (folder / "one" / folders.ERROR).read_text()
    assert find_runs(folder) == [folder / "two"]
    assert not (folder / "fleet.json").exists()


def test_finished_suspensions_are_not_trained_again(fitted, quick, fleet, tmp_path, caplog):
    removed = next((fleet / "two").glob("*.yaml"))
    kept = removed.read_text()
    removed.unlink()
    folder = tmp_path / "run"
    own_files.begin(folder)
    assert trained(folder, fleet) != 0
    before = stamps(folder / "one")
    removed.write_text(kept)
    with caplog.at_level(logging.INFO):
        assert trained(folder, fleet, f"resume={folder}", "threads=1") == 0
    assert fitted == ["leading", "trailing"]
    assert "2 suspensions in" in caplog.text
    assert "1 are finished already" in caplog.text
    assert stamps(folder / "one") == before
    assert not (folder / "two" / folders.ERROR).exists()
    assert trained(folder, fleet, f"resume={folder}") == 0
    assert fitted == ["leading", "trailing"]
    saved = (folder / "config.yaml").read_text()
    said = trained(folder, fleet, "seed=9")
    assert (folder / "config.yaml").read_text() == saved
    assert "run holds a finished run of other settings; give another folder" in said


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["generator=quarter_car"], "cannot be commissioned as a QuarterCar"),
        (["n_healthy=2"], "`n_healthy` must be a whole number >= 3 or null"),
        (["n_healthy={one:3,two:2}"], "`n_healthy` must be a whole number >= 3 or null"),
        (["n_healthy={one:3}"], "or name each suspension of the folder (one, two)"),
        (["workers=0"], "`workers` must be a whole number >= 1"),
    ],
)
def test_mistakes_of_all_are_one_line_and_leave_nothing(overrides, words, fleet, tmp_path):
    said = trained(tmp_path / "run", fleet, *overrides)
    assert said.startswith("error: ")
    assert words in said
    assert list((tmp_path / "run").iterdir()) == []


def test_log_of_a_run_leaves_the_logger_as_it_was(tmp_path):
    logger = logging.getLogger("suspnet")
    before = logger.level, logger.propagate, list(logger.handlers)
    with commission_fleet.own_log(tmp_path / "new" / "train.log") as warnings:
        logging.getLogger("suspnet.x").warning("doubt %d", 1)
        logging.getLogger("suspnet.x").info("news")
        assert [record.getMessage() for record in warnings.buffer] == ["doubt 1"]
    assert (tmp_path / "new" / "train.log").read_text() == "doubt 1\nnews\n"
    assert (logger.level, logger.propagate, list(logger.handlers)) == before


def test_table_shows_errors_of_models_that_were_tested_on_curves():
    row = {"suspension": "car", "n_trips": 5, "misfit": 6.623, "rms_percent": {"k_p": 1.0}}
    of_bogie = row | {"suspension": "bogie", "misfit": 1.084, "rms_percent": {}}
    table = commission_fleet.fleet_table([of_bogie, row])
    head, _, *body = ([*map(str.strip, line.strip("|").split("|"))] for line in table.splitlines())
    assert head == ["suspension", "trips", "misfit", "k_p"]
    assert body == [["bogie", "5", "1.08", ""], ["car", "5", "6.62", "1"]]
