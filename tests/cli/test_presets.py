"""What healthy=DIR says of itself: experiment, vehicle, and how many trips are healthy."""

import pytest
import yaml
from cli_runner import typed

from suspnet.cli import train
from suspnet.cli.loader import of_healthy
from suspnet.estimation.trip_settings import N_HEALTHY

OPTIONS = {"am96": "am96", "our_file": "our train", "ice3": "ice3"}


def given(*options, **typed):
    return of_healthy(typed, options or tuple(OPTIONS), OPTIONS.get)


def write(folder, vehicle):
    source = {"file": "all.csv", "unit": "m/s2", "rate_hz": 100.0}
    channels = {name: source | {"column": name} for name in ("axle_box", "bogie", "body")}
    content = {"format": "suspnet-trip-1", "vehicle": vehicle, "suspension": "S1"}
    content |= {"mileage_km": 1.0, "speed": 70.0, "channels": channels}
    (folder / "trip.yaml").write_text(yaml.safe_dump(content))


@pytest.fixture(params=[".", "car 7"], ids=["folder", "subfolder"])
def folder(request, tmp_path):
    place = tmp_path / "trips" / request.param
    place.mkdir(parents=True, exist_ok=True)
    write(place, "am96")
    return tmp_path / "trips"


def test_experiment_and_vehicle_are_those_of_the_trips(folder):
    assert given(healthy=str(folder)) == ["experiment=trips", "vehicle=am96"]
    assert given(healthy=str(folder), vehicle="ice3") == ["experiment=trips"]
    assert given(healthy=str(folder), experiment="trips", vehicle="ice3") == []
    assert given("ice3", healthy=str(folder)) == ["experiment=trips"]  # training refuses the trips


def test_a_vehicle_is_found_by_its_name(tmp_path):
    write(tmp_path, "our train")
    assert given(healthy=str(tmp_path)) == ["experiment=trips", "vehicle=our_file"]


@pytest.mark.parametrize("typed", [{}, {"healthy": "null"}, {"healthy": ""}])
def test_nothing_is_taken_without_a_folder(typed):
    assert given(**typed) == []


def test_a_folder_that_cannot_be_read_says_nothing(tmp_path):
    (tmp_path / "broken.yaml").write_text("[")
    for wrong in (tmp_path, tmp_path / "nowhere", tmp_path / "broken.yaml"):
        assert given(healthy=str(wrong)) == ["experiment=trips"]


@pytest.mark.parametrize("name", ["trips", "Wagen=4711, [a] & {b};#c"])
def test_the_command_takes_them(tmp_path, name):
    folder = tmp_path / name
    folder.mkdir()
    write(folder, "ice3")
    done = typed(train, f"healthy={folder}", "--cfg", "job", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    config = yaml.safe_load(done.stdout)
    assert (config["protocol"]["name"], config["vehicle"]["name"]) == ("trips", "ice3")
    assert (config["n_healthy"], config["job"]) == (N_HEALTHY, "trips")
