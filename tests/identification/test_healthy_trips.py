"""Healthy trips of a folder are read whole, by mileage and speed, or refused in one clear line."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from dying_readers import open_dying
from trip_fixtures import RATES_HZ, SPEED, changed, signal, small_fleet
from vehicles import AM96

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import NoEstimateError
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.identification.commissioning_summary import unplaced
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.jobs.commissioning import prior_of
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import READERS
from suspnet.trains.recordings.reader_process import in_own_process
from suspnet.vehicle import VerticalVehicle

pytestmark = pytest.mark.usefixtures("healthy_trips_read_once")
SETTINGS = EstimateSettings(rates_hz=RATES_HZ).bound(AM96)
NAMES = ["first", "second", "third"]


@pytest.fixture(scope="module")
def manifests():
    return small_fleet()[:3]


@pytest.fixture
def folder(manifests, tmp_path):
    """Return a folder of three trips of 1000 km each, in which the last by name is the first."""
    for manifest, name in zip(reversed(manifests), NAMES, strict=True):
        changed(manifest, tmp_path, name, suspension="S1")
    return tmp_path


def read(folder, bogie="leading", axle="leading", **options):
    generator = VerticalVehicle(AM96, bogie=bogie, axle=axle)
    return read_healthy(folder, generator, SETTINGS, TripSettings(), **options)


def speeds(manifest, *parts):
    """Return a speed column of equally long parts."""
    return np.repeat(parts, -(-len(signal(manifest, "speed")) // len(parts)))[
        : len(signal(manifest, "speed"))
    ].astype(float)


def with_pairs(path, names=("axle_box", "bogie", "body")):
    """Give channels of a manifest a second sensor, on the right: the same motion, other noise."""
    content = yaml.safe_load(path.read_text())
    for name in names:
        left = content["channels"][name]
        copy = path.parent / f"{path.stem}_{name}.parquet"
        values = pq.read_table(left["file"]).column(0).to_numpy()
        noise = 0.01 * values.std() * np.random.default_rng(0).standard_normal(len(values))
        pq.write_table(pa.table({"right": values + noise}), copy)
        right = left | {"file": str(copy), "column": "right", "side": "right"}
        content["channels"][name] = [left | {"side": "left"}, right]
    path.write_text(yaml.safe_dump(content))


# reference


@pytest.mark.parametrize(
    ("side", "body", "expected"),
    [
        (None, None, (0.0, 0.0, 0.0)),
        pytest.param("left", None, (1.0, 1.0, 1.0), marks=pytest.mark.slow),
        pytest.param("right", "middle", (-1.0, -1.0, 0.0), marks=pytest.mark.slow),
        ("right", "left", (-1.0, -1.0, 1.0)),
    ],
)
def test_single_sensors_are_placed_by_the_side_that_is_said(folder, side, body, expected):
    for name in NAMES:
        channels = {"body": {"side": body}}
        changed(folder / f"{name}.yaml", folder, name, channels=channels, side=side)
    trips = read(folder)
    placed = prior_of(VerticalVehicle(AM96), trips)
    assert placed.sensor_lateral_m == expected
    assert ("roll" in placed.parts) == any(expected)
    assert (unplaced(trips) is None) == (side is not None)


def test_a_trip_that_shows_its_parts_without_a_sensor_only_is_left_out(
    manifests, tmp_path, monkeypatch
):
    """One loose cable among eight healthy trips had no bogie trained at all."""
    for manifest, name in zip(small_fleet(), (*NAMES, "fourth", "fifth"), strict=False):
        with_pairs(changed(manifest, tmp_path, name, suspension="S1"))
    lost = {"second": ("body_left",)}

    def by_part(recording, *_):
        if recording.manifest.name == "fourth":
            raise NoEstimateError("0.0 minutes at one speed, 9.0 are needed")
        return SimpleNamespace(lost=lost.get(recording.manifest.name, ()))

    monkeypatch.setattr("suspnet.trains.identification.healthy_trips.bogie_trip", by_part)
    found = read(tmp_path)
    kept = [one.name for one in found.manifests]
    assert len(found.of_parts) == len(kept) == 3
    assert not {"second", "fourth"} & set(kept)
    assert sorted(found.left_out) == [
        "fourth: 0.0 minutes at one speed, 9.0 are needed",
        "second: no stretch with all sensors at one speed is long enough to read each part: ",
    ]


# properties


def test_trips_come_by_mileage_each_with_its_speed(folder):
    found = read(folder)
    assert [manifest.name for manifest in found.manifests] == NAMES[::-1]
    np.testing.assert_allclose(found.speeds_m_per_s, SPEED, rtol=1e-9)
    assert not found.absent
    assert found.paired == (False, False, False)
    assert found.left_out == ()


def test_first_trips_by_mileage_are_taken(folder):
    changed(folder / "first.yaml", folder, "latest", mileage_km=9000.0)
    assert len(read(folder).manifests) == 4
    assert [one.name for one in read(folder, n_first=3).manifests] == NAMES[::-1]


def test_a_trip_at_two_speeds_is_read_at_the_one_of_the_longer_stretch(folder, manifests):
    part = {"speed": speeds(manifests[0], 60.0, 70.0, 70.0)}
    changed(folder / "third.yaml", folder, "third", signals=part)
    np.testing.assert_allclose(read(folder).speeds_m_per_s, [70.0, SPEED, SPEED])


def test_pairs_of_sensors_are_seen_as_such(folder):
    for name in NAMES:
        with_pairs(folder / f"{name}.yaml", ("axle_box", "body"))
    assert read(folder).paired == (True, False, True)


def test_a_trip_without_a_steady_stretch_is_left_out_and_named(folder, manifests):
    sweep = np.linspace(30.0, 80.0, len(signal(manifests[0], "speed")))
    changed(folder / "first.yaml", folder, "sweep", signals={"speed": sweep})
    found = read(folder)
    assert [manifest.name for manifest in found.manifests] == NAMES[::-1]
    assert len(found.of_parts) == 3
    assert found.left_out == ("sweep: no stretch at one speed is long enough and free of faults",)


# failures


def test_too_few_trips_are_refused_with_the_reason_of_each(folder, manifests):
    (folder / "third.yaml").unlink()
    words = "2 healthy trips can be used, at least 3 are needed to commission a vehicle"
    with pytest.raises(TripError, match=words):
        read(folder)
    sweep = np.linspace(30.0, 80.0, len(signal(manifests[0], "speed")))
    changed(folder / "first.yaml", folder, "sweep", signals={"speed": sweep})
    with pytest.raises(TripError, match=rf"{words} \(sweep: no stretch at one speed"):
        read(folder)


def test_trips_of_another_vehicle_are_refused(folder):
    changed(folder / "first.yaml", folder, "first", vehicle="ice3")
    with pytest.raises(TripError, match=r"first\.yaml: the trip is of vehicle 'ice3', vehicle=am9"):
        read(folder)


@pytest.mark.parametrize("place", [{"suspension": "S2"}, {"bogie": "trailing"}, {"side": "left"}])
def test_trips_of_several_suspensions_are_refused(place, folder):
    changed(folder / "first.yaml", folder, "first", **place)
    with pytest.raises(TripError, match=r"of several suspensions \(S1, .*give a folder of one|S2"):
        read(folder)


def test_sensors_that_differ_between_trips_are_refused(folder):
    with_pairs(folder / "first.yaml")
    with pytest.raises(TripError, match="healthy trips differ in their sensors"):
        read(folder)


def test_file_that_kills_its_reader_is_named(folder, monkeypatch):
    monkeypatch.setitem(READERS, ".mat", in_own_process(open_dying))
    (folder / "body.mat").write_text("crash:0")
    channels = {"body": {"file": "body.mat", "column": "a", "unit": "g"}}
    changed(folder / "first.yaml", folder, "first", channels=channels)
    with pytest.raises(TripError, match=r"body\.mat: its reader crashed \(SIGSEGV\), so the file"):
        read(folder)


def test_a_folder_without_trips_is_named(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        read(Path("nowhere"))
    empty = tmp_path / "empty"
    shutil.rmtree(empty, ignore_errors=True)
    empty.mkdir()
    with pytest.raises(FileNotFoundError, match=r"holds no \*\.yaml file"):
        read(empty)


def test_trips_of_the_other_bogie_are_refused_before_they_are_read(manifests, tmp_path):
    for manifest, name in zip(manifests, NAMES, strict=True):
        changed(manifest, tmp_path, name, bogie="trailing")
    with pytest.raises(TripError, match=r"of the trailing bogie.*: give generator\.bogie=trailing"):
        read(tmp_path, bogie="leading")
    assert len(read(tmp_path, bogie="trailing").manifests) == 3
    for manifest, name in zip(manifests, NAMES, strict=True):
        changed(manifest, tmp_path, name, axle="trailing" if name == NAMES[-1] else None)
    with pytest.raises(TripError, match=r"of the trailing axle.*: give generator\.axle=trailing"):
        read(tmp_path)
