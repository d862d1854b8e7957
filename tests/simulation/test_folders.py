"""A simulation goes on after an interruption, and keeps out of another one's folder."""

import json
import logging
from concurrent.futures import ThreadPoolExecutor

import pytest
from recording_files import contents
from trip_fixtures import SENSORS
from vehicles import AM96

from suspnet.ground import workers
from suspnet.ground.storage import locked
from suspnet.trains.simulation import writing
from suspnet.trains.simulation.fleet import Fleet, Scenario
from suspnet.trains.simulation.folders import UNFINISHED, FolderTakenError
from suspnet.trains.simulation.writing import Simulation, write_fleet
from suspnet.vehicle import QuarterCar

FLEET = Fleet(n_trips=4, minutes=0.1, sensors=SENSORS)
LOADS = Scenario("loads")


def simulate(folder, fleet=FLEET, seed=3, **options):
    return write_fleet(folder, Simulation(fleet, LOADS, QuarterCar(AM96), seed=seed), **options)


@pytest.fixture
def stopped(tmp_path, monkeypatch):
    """Return a folder in which a simulation was interrupted while it wrote its third trip."""
    write_manifest, folder = writing.write_manifest, tmp_path / "fleet"

    def write_two(manifest):
        if manifest.name == "trip_003":
            raise KeyboardInterrupt("stop")
        return write_manifest(manifest)

    with monkeypatch.context() as patch:
        patch.setattr(writing, "write_manifest", write_two)
        with pytest.raises(KeyboardInterrupt, match="stop"):
            simulate(folder)
    return folder


def test_interrupted_simulation_goes_on_and_ends_as_if_uninterrupted(
    stopped, tmp_path, monkeypatch, caplog
):
    before = contents(stopped)
    assert "truth.json" not in before
    written, write = [], writing.write_manifest

    def counted(manifest):
        written.append(manifest.name)
        return write(manifest)

    monkeypatch.setattr(writing, "write_manifest", counted)
    with caplog.at_level(logging.INFO):
        paths = simulate(stopped)
    assert written == ["trip_003", "trip_004"]
    assert "2 of 4 trips are written, continuing" in caplog.text
    assert [path.name for path in paths] == [f"trip_{i:03d}.yaml" for i in range(1, 5)]
    simulate(tmp_path / "whole")
    assert contents(stopped) == contents(tmp_path / "whole")


def test_trip_that_lost_a_file_is_written_again(stopped, tmp_path):
    (stopped / "trip_001" / "body.parquet").unlink()
    simulate(stopped)
    simulate(tmp_path / "whole")
    assert contents(stopped) == contents(tmp_path / "whole")


@pytest.mark.parametrize("kind", ["unfinished", "whole", "foreign"])
def test_trips_of_another_simulation_stay(stopped, kind):
    if kind == "whole":
        simulate(stopped)
    if kind == "foreign":
        (stopped / UNFINISHED).unlink()
    before = contents(stopped)
    with pytest.raises(FolderTakenError, match="fleet already holds trips; give another folder"):
        simulate(stopped, seed=4)
    assert contents(stopped) == before


def test_folder_that_another_simulation_writes_to_is_left_to_it(tmp_path):
    with locked(tmp_path / "fleet"), pytest.raises(FolderTakenError, match="is writing to"):
        simulate(tmp_path / "fleet")
    assert contents(tmp_path / "fleet") == {}


def test_mistake_before_the_first_trip_leaves_nothing(tmp_path):
    fleet = Fleet(n_trips=1, minutes=0.1, journey="service", sensors=SENSORS)
    with pytest.raises(ValueError, match="stops in"):
        simulate(tmp_path / "fleet", fleet)
    assert not (tmp_path / "fleet").exists()


class Threads(ThreadPoolExecutor):
    """Workers in this process: no import of their own."""

    def __init__(self, n_workers):
        super().__init__(1)

    def shutdown(self, kill_workers=False, **options):
        super().shutdown(**options)


@pytest.mark.parametrize("kind", ["threads", pytest.param("processes", marks=pytest.mark.slow)])
def test_workers_change_nothing(kind, tmp_path, monkeypatch):
    if kind == "threads":
        monkeypatch.setattr(workers, "guarded", Threads)
    for folder, n_jobs in (("one", 1), ("two", 2)):
        simulate(tmp_path / folder, n_jobs=n_jobs)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert set(json.loads((tmp_path / "one" / "truth.json").read_text())) >= {"numbers", "seed"}
