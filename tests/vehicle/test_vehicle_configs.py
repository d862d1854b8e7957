"""Every vehicle file is complete, sourced, and reduced from the published numbers it states."""

import math
import re
from pathlib import Path

import pytest

from suspnet.cli.config_files import CONFIGS
from suspnet.cli.kinds import read_vehicles
from suspnet.ground.parameters import DEFAULT_LIMITS
from suspnet.vehicle import QuarterCar
from suspnet.vehicle.vehicle import GEOMETRY

VEHICLES = read_vehicles()
DERIVED = re.compile(r"^ *(\w+): (\S+) # ((?:[\d.e*/() ]|sqrt)+)$", re.MULTILINE)
"""A number of a file, and in its comment how it follows from published ones: 1.25 # 2.5 / 2."""


@pytest.fixture(params=VEHICLES)
def name(request):
    return request.param


def derived(name):
    """Return {key: (number, as calculated from published ones)} of a vehicle's file."""
    with open(f"{CONFIGS}/vehicle/{name}.yaml", encoding="utf-8") as file:
        found = DERIVED.findall(file.read())
    return {key: (float(value), eval(how, {"sqrt": math.sqrt})) for key, value, how in found}


# reference


def test_numbers_follow_from_the_published_ones_beside_them(name):
    for key, (value, expected) in derived(name).items():
        assert value == pytest.approx(expected, rel=1e-4), key  # the files give five digits
        assert getattr(VEHICLES[name], key) == value


def test_reduced_vehicles_state_what_they_are_reduced_from():
    reduced = {
        name: set(values) for name in VEHICLES if "body_gyration_m" in (values := derived(name))
    }
    assert len(reduced) >= 5
    masses = {"bogie_mass_kg", "body_mass_kg", "bogie_gyration_m"}
    assert all(masses <= keys for keys in reduced.values())


# property


def test_vehicle_is_named_as_its_file_and_sourced(name):
    assert VEHICLES[name].name == name
    assert VEHICLES[name].source.strip()


def test_shipped_limits_are_the_defaults_with_a_reason(name):
    found = VEHICLES[name].known_limits
    pairs = {key: (one.notice, one.act) for key, one in found.items()}
    assert pairs == {key: (one.notice, one.act) for key, one in DEFAULT_LIMITS.items()}
    assert all(one.why for one in found.values())
    assert (VEHICLES[name].limits is None) == (name != "am96")


def test_geometry_is_complete_or_absent(name):
    known = [getattr(VEHICLES[name], key) is not None for key in GEOMETRY]
    assert all(known) or not any(known)


def test_natural_frequencies_are_those_of_a_vehicle(name):
    frequencies_hz, _ = QuarterCar(VEHICLES[name]).natural_modes()
    assert 0.3 < frequencies_hz[0] < frequencies_hz[1] < 50.0


def test_folder_without_vehicles_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no vehicles: each is a file vehicle/NAME"):
        read_vehicles(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            ("bogie_mass_kg", "bogy_mass_kg"),
            r"`vehicle\.bogy_mass_kg` is no setting.*did you mean bogie_mass_kg\?",
        ),
        (("\nbody_mass_kg", "\n# body_mass_kg"), r"`vehicle\.body_mass_kg` is missing"),
        (("\nbody_mass_kg: ", "\nbody_mass_kg: -"), "`body_mass_kg` must be a finite number > 0"),
    ],
)
def test_wrong_key_or_value_names_the_file_and_the_key(tmp_path, change, words):
    (tmp_path / "vehicle").mkdir()
    text = (Path(CONFIGS) / "vehicle" / "ice3.yaml").read_text()
    (tmp_path / "vehicle" / "mine.yaml").write_text(text.replace(*change))
    with pytest.raises(ValueError, match=rf"mine\.yaml: {words}"):
        read_vehicles(tmp_path)
