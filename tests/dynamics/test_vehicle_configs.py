"""Every vehicle file is complete, sourced, and reduced correctly from the published numbers."""

import math
from dataclasses import fields
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from suspnet.dynamics import QuarterCar, Vehicle
from suspnet.dynamics.vehicle import GEOMETRY

FILES = sorted((Path(__file__).parents[2] / "configs" / "vehicle").glob("*.yaml"))

# Two-dimensional vehicles, both sides lumped, as published: body M_c [kg], bogie M_t [kg], per
# axle K_p [N/m] and C_p [N s/m], per bogie K_s and C_s; pitch inertias of body and bogie [kg m^2],
# distance of the bogies' centres and wheelbase [m]. Source: TTB-2D vehicle library (D. Cantero).
LUMPED = {
    "ice3": (47800, 3500, 2 * 1200e3, 2 * 10e3, 2 * 350e3, 2 * 20e3, 1957888, 1715, 17.375, 2.5),
    "manchester": (32000, 2615, 2.4e6, 8e3, 0.86e6, 40e3, 1.97e6, 1476, 19.0, 2.56),
    "shinkansen_s300": (41750, 3040, 1.18e6, 39.2e3, 0.53e6, 90.2e3, 2.08e6, 3930, 17.5, 2.5),
    "china_star": (
        *(59364.2, 5630.8, 2 * 2.3996e6, 2 * 30e3, 2 * 0.8858e6, 2 * 45e3),
        *(1.723e6, 9487, 11.46, 3.0),
    ),
}
# The same for K_p, C_p of one axle box and K_s, C_s of one side of a bogie. Source: VTCM.
PER_SIDE = {
    "chinese_coach": (34000, 3000, 0.55e6, 6e3, 0.4e6, 80e3, 2.277e6, 2710, 2 * 9.0, 2 * 1.2)
}
# Quarter cars as published: sprung and unsprung mass, suspension k and c, tyre k and c.
ROAD = {
    "sedan": (300, 60, 16e3, 1e3, 190e3, 0.01 * 2 * math.sqrt(190e3 * 60)),
    "truck": (2500, 320, 80e3, 350, 500e3, 15020),
}
# Table III of the paper, kN/m read as N/m; its geometry is not published with it.
PAPER = {"am96": (1725, 6300, 1.30e6, 3.7e3, 0.69e6, 22.6e3)}


def load(file):
    values = OmegaConf.to_container(OmegaConf.load(file))  # plain YAML 1.1 reads 1.3e6 as text
    values = values.get("vehicle", values)  # a road vehicle's file sets speed and track too
    assert values.pop("_target_") == "suspnet.dynamics.Vehicle"
    return Vehicle(**values)


def numbers(vehicle):
    return [getattr(vehicle, f.name) for f in fields(vehicle) if f.name not in ("name", "source")]


def naive_numbers(name):
    """Return the fields of a vehicle in their order, from the published numbers."""
    if name in PAPER:
        return [*PAPER[name], 1.35, 9.5, 0.8, 7.8]
    if name in ROAD:
        sprung, unsprung, k, c, tyre_k, tyre_c = ROAD[name]
        return [unsprung, sprung, tyre_k, tyre_c, k, c, None, None, None, None]
    M_c, M_t, K_p, C_p, K_s, C_s, I_c, I_t, pivots, wheelbase = (LUMPED | PER_SIDE)[name]
    sides = 2 if name in LUMPED else 1  # how many sides K and C stand for
    springs = [2 * K_p / sides, 2 * C_p / sides, K_s / sides, C_s / sides]  # two axles, one bogie
    arms = [wheelbase / 2, pivots / 2, math.sqrt(I_t / M_t), math.sqrt(I_c / M_c)]
    return [M_t / 2, M_c / 4, *springs, *arms]


@pytest.fixture(params=FILES, ids=lambda file: file.stem)
def file(request):
    return request.param


# reference


def test_numbers_are_the_published_ones_reduced_to_one_bogie_side(file):
    # The files give five digits.
    for got, expected in zip(numbers(load(file)), naive_numbers(file.stem), strict=True):
        assert got == (None if expected is None else pytest.approx(expected, rel=1e-4, abs=0))


def test_static_load_of_a_bogie_side_is_its_share_of_the_vehicle():
    # A body hangs on four bogie sides in parallel: f = sqrt(2 K_s / M_c) / (2 pi) either way.
    for file in FILES:
        if file.stem in LUMPED:
            body, stiffness = LUMPED[file.stem][0], LUMPED[file.stem][4]
            expected = math.sqrt(2 * stiffness / body) / (2 * math.pi)
        elif file.stem in PER_SIDE:
            body, stiffness = PER_SIDE[file.stem][0], PER_SIDE[file.stem][4]
            expected = math.sqrt(4 * stiffness / body) / (2 * math.pi)
        else:
            continue
        assert load(file).secondary_frequency_hz == pytest.approx(expected, rel=1e-4)


# property


def test_every_published_vehicle_has_a_file_and_every_file_is_checked():
    assert {file.stem for file in FILES} == {*PAPER, *LUMPED, *PER_SIDE, *ROAD}


def test_vehicle_is_named_as_its_file_and_sourced(file):
    vehicle = load(file)
    assert vehicle.name == file.stem
    assert vehicle.source.strip()


def test_geometry_is_complete_or_absent(file):
    known = [getattr(load(file), name) is not None for name in GEOMETRY]
    assert all(known) or not any(known)


def test_natural_frequencies_are_those_of_a_vehicle(file):
    frequencies_hz, _ = QuarterCar(load(file)).natural_modes()
    assert 0.3 < frequencies_hz[0] < frequencies_hz[1] < 50.0
