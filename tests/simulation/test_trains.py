"""Trains of several suspensions: each is itself wherever it runs, and shares its train's trips."""

import json

import pytest
from recording_files import contents
from trip_fixtures import SENSORS
from vehicles import AM96

from suspnet.trains.simulation import writing
from suspnet.trains.simulation.fleet import Fleet, Scenario, Trains
from suspnet.trains.simulation.writing import Simulation, write_trains
from suspnet.trains.trips.grouping import find_groups
from suspnet.vehicle import QuarterCar, VerticalVehicle

FLEET = Fleet(n_trips=2, minutes=0.1, last_mileage_km=1000.0, sensors=SENSORS)
WORN = Scenario("worn", {"c_s": {"from_km": 0.0, "to_km": 1000.0, "ratio": 0.5}})
SECTION_S = 20 * 60
"""Length of the sections into which a live stream is cut [s]."""


def simulate(folder, trains=None, fleet=FLEET, generator=None, **options):
    generator = generator or QuarterCar(AM96)
    drawn = {name: options.pop(name, value) for name, value in (("seed", 5), ("scatter", 1.0))}
    simulation = Simulation(fleet, WORN, generator, **drawn)
    return write_trains(folder, trains or Trains(1, 1, 1), simulation, **options)


def truth(folder):
    return json.loads((folder / "truth.json").read_text())


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Return the folder of two suspensions, one of which wears."""
    folder = tmp_path_factory.mktemp("trains") / "fleet"
    simulate(folder)
    return folder


# which suspensions there are


def test_every_bogie_of_every_car_has_a_place_and_a_seed_of_its_own():
    found = Trains(3, 4).suspensions(0)
    assert len(found) == Trains(3, 4).n_all == 24
    assert len({one.name for one in found}) == len({one.seed for one in found}) == 24
    assert str(found[5].place(" S1 ")) == "train 1, car 3, S1, trailing bogie"
    assert found[5].name == "train_1_car_3_trailing"


def test_suspensions_of_a_train_share_what_others_do_not():
    found = Trains(3, 2).suspensions(0)
    for shared in ("train_seed", "first_start"):
        by_train = {
            train: {getattr(one, shared) for one in found if one.train == train} for train in "123"
        }
        assert all(len(values) == 1 for values in by_train.values())
        assert len(set.union(*by_train.values())) == 3


def test_trips_begin_where_a_section_of_a_stream_does():
    for one in Trains(3).suspensions(0):
        assert one.first_start.timestamp() % SECTION_S == 0
    assert writing.STEP.total_seconds() % SECTION_S == 0


@pytest.mark.parametrize(("n_wearing", "expected"), [(0, 0), (2, 2), (24, 24), (None, 24)])
def test_as_many_wear_as_are_asked_for(n_wearing, expected):
    for seed in range(3):
        assert sum(one.wears for one in Trains(3, 4, n_wearing).suspensions(seed)) == expected


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((0,), "`trains` must be a whole number >= 1"),
        ((1, 0), "`cars` must be a whole number >= 1"),
        ((1, 101), "`cars` must be at most 100"),
        ((2, 1, 5), "`n_wearing` must be at most 4"),
        ((1, 1, -1), "`n_wearing` must be a whole number >= 0"),
    ],
)
def test_numbers_out_of_range_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Trains(*given)


# what is written


def test_each_suspension_has_a_folder_that_says_where_it_is(fleet):
    groups = find_groups(fleet)
    assert [group.name for group in groups] == ["train_1_car_1_leading", "train_1_car_1_trailing"]
    assert [str(group.place) for group in groups] == [
        "train 1, car 1, simulated, leading bogie",
        "train 1, car 1, simulated, trailing bogie",
    ]
    for group in groups:
        trips = [one.trip for one in group.manifests]
        assert [trip.mileage_km for trip in trips] == [500.0, 1000.0]
        assert all(trip.place == group.place for trip in trips)
        place = truth(group.folder)["place"]
        assert (place["train"], place["car"], place["bogie"]) == ("1", "1", group.place.bogie)


def test_suspensions_of_a_train_have_its_trips_and_a_vehicle_and_noise_of_their_own(fleet):
    folders = [group.folder for group in find_groups(fleet)]
    one, other = (group.manifests for group in find_groups(fleet))
    for first, second in zip(one, other, strict=True):
        assert first.trip.start == second.trip.start
        files = [one.path.with_suffix("") for one in (first, second)]
        speeds, signals = (
            [(file / f"{name}.parquet").read_bytes() for file in files]
            for name in ("speed", "body")
        )
        assert speeds[0] == speeds[1]
        assert signals[0] != signals[1]
    numbers = [truth(folder)["numbers"]["healthy_k_p"]["ratio"] for folder in folders]
    assert truth(folders[0])["seed"] != truth(folders[1])["seed"]
    assert numbers == [1.0, 1.0]  # a quarter car is its own drawing
    values = [truth(folder)["numbers"]["healthy_k_p"]["value"] for folder in folders]
    assert values[0] != values[1]


def test_those_that_wear_are_told_and_nothing_of_the_others_wears(fleet):
    whole = truth(fleet)
    assert whole["scenario"] == "worn"
    assert len(whole["wearing"]) == 1
    for group in find_groups(fleet):
        wears = group.name in whole["wearing"]
        last = group.manifests[-1].trip.truth
        assert last["c_s"] == (0.5 if wears else 1.0)
        assert truth(group.folder)["scenario"] == ("worn" if wears else "healthy")


def test_vertical_vehicle_is_taken_at_the_bogie_of_its_suspension(tmp_path, monkeypatch):
    bogies = {}

    def noted(folder, simulation, **_):
        bogies[folder.name] = simulation.generator.bogie

    monkeypatch.setattr(writing, "write_fleet", noted)
    simulate(tmp_path / "fleet", generator=VerticalVehicle(AM96))
    assert bogies == {"train_1_car_1_leading": "leading", "train_1_car_1_trailing": "trailing"}


# that two workers change nothing is tested by default in test_folders.py
@pytest.mark.parametrize("n_jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_another_car_and_other_workers_change_no_file_of_the_others(fleet, tmp_path, n_jobs):
    simulate(tmp_path / "more", Trains(1, 2, 0), n_jobs=n_jobs)
    simulate(tmp_path / "same", Trains(1, 1, 0))
    for name in ("train_1_car_1_leading", "train_1_car_1_trailing"):
        assert contents(tmp_path / "more" / name) == contents(tmp_path / "same" / name)
    (wearing,) = truth(fleet)["wearing"]
    (healthy,) = {one.name for one in Trains().suspensions(5)} - {wearing}
    assert contents(tmp_path / "same" / healthy) == contents(fleet / healthy)


# interruptions and mistakes
