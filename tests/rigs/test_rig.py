"""A rig's numbers and its equations of motion."""

import numpy as np
import pytest
import torch
from rig_records import chain

from suspnet import QuarterCar, Rig, read_rigs, read_vehicles
from suspnet.vehicle.rig import equations, patterns

SEDAN = read_vehicles()["sedan"]
HEALTHY = (
    *("primary_stiffness_n_per_m", "primary_damping_ns_per_m"),
    *("secondary_stiffness_n_per_m", "secondary_damping_ns_per_m"),
)
RIG = Rig("bench", primary_hz=11.0, secondary_hz=1.4, mass_ratio=7.0)
FREQUENCIES_HZ = np.linspace(0.3, 30, 40)


def test_equations_are_zero_for_the_motion_of_the_quarter_car():
    responses = QuarterCar(SEDAN).channels(torch.ones(1, 5), torch.as_tensor(FREQUENCIES_HZ))
    motion = responses[0, 0].numpy().T[:, :, None]  # (n_freq, 3, 1)
    rows = equations(Rig.of(SEDAN).logs, patterns(FREQUENCIES_HZ))
    assert np.abs(rows @ motion).max() < 1e-9 * np.abs(rows).max()


def test_equations_are_zero_for_the_motion_of_an_independent_chain():
    a, b, c, d = chain(*np.exp(RIG.logs))
    rows = equations(RIG.logs, patterns(FREQUENCIES_HZ))
    for s, of_bin in zip(2j * np.pi * FREQUENCIES_HZ, rows, strict=True):
        motion = c @ np.linalg.solve(s * np.eye(4) - a, b) + d
        assert np.abs(of_bin @ motion).max() < 1e-9 * np.abs(of_bin).max()


def test_modes_are_those_of_the_quarter_car():
    assert Rig.of(SEDAN).modes_hz == pytest.approx(QuarterCar(SEDAN).natural_modes()[0], rel=1e-12)


def test_rig_of_a_vehicle_has_its_frequencies_and_mass(tmp_path):
    names = ("bogie_mass_kg", "body_mass_kg", *HEALTHY)
    numbers = {name: getattr(SEDAN, name) for name in names}
    (tmp_path / "vehicle").mkdir()
    lines = [f"{name}: {value}" for name, value in numbers.items()]
    file = tmp_path / "vehicle" / "sedan.yaml"
    file.write_text("\n".join(["kind: rig", "name: sedan", *lines]))
    expected = np.array(SEDAN.healthy_values()) / SEDAN.bogie_mass_kg
    assert np.exp(read_rigs(tmp_path)["sedan"].logs) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ("primary_hz: -1\nsecondary_hz: 2", "`primary_hz` must be"),
        ("primary_hz: 1", r"`vehicle\.secondary_hz` is missing"),
        ("primry_hz: 1", r"`vehicle\.primry_hz` is no setting of vehicle.*did you mean primary_hz"),
        ("primary_hz: 3\nsecondary_hz: 2\nlow_hz: 90", "`low_hz` must be below"),
        ("primary_hz: 3\nsecondary_hz: 2\nlimits: {k: null}", "`limits` must be named as in"),
    ],
)
def test_wrong_numbers_are_refused(tmp_path, numbers, words):
    (tmp_path / "vehicle").mkdir()
    (tmp_path / "vehicle" / "bench.yaml").write_text(f"kind: rig\nname: bench\n{numbers}\n")
    with pytest.raises(ValueError, match=words):
        read_rigs(tmp_path)


def test_rigs_of_a_folder_are_not_among_its_vehicles(tmp_path):
    (tmp_path / "vehicle").mkdir()
    file = tmp_path / "vehicle" / "bench.yaml"
    file.write_text("kind: rig\nname: bench\nprimary_hz: 11\nsecondary_hz: 1.4\nmass_ratio: 7\n")
    assert read_rigs(tmp_path) == {"bench": RIG}
    assert read_vehicles(tmp_path) == {}
    file.write_text("kind: rug\nname: bench\n")
    with pytest.raises(ValueError, match=r"bench\.yaml: `vehicle\.kind` must be"):
        read_rigs(tmp_path)
