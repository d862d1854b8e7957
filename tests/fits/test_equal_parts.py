"""All parts of a kind as equal: tied coordinates of the search, and sensors in the middle."""

import numpy as np
import pytest
import torch
from test_bogie_fit import AM96, BINS, MASSES, VEHICLE, commissioned_bogie, drawn, row, trip

from suspnet import (
    COMPONENTS,
    PARAMETERS,
    SpatialVehicle,
    VerticalVehicle,
    commission_bogie,
    fit_parts,
)

WORN = {"k_p": 0.7, "c_p": 0.8, "k_s": 1.2, "c_s": 0.6}
EVERY = {name: WORN[name[:3]] for name in COMPONENTS[:-1]}
MIDDLE = SpatialVehicle(
    AM96,
    parts=("bushings",),
    sensors=("axle_box_axle1_middle", "frame_axle1_middle", "body_middle"),
    distribution={"healthy_k_p": 0.1, "healthy_k_s": 0.1, "half_wheelbase": 0.05},
)


def uncertain(parts, mass):
    """Return a row of a vehicle with three sensors, off its median."""
    given = torch.ones(1, len(COMPONENTS), dtype=torch.float64)
    for name, ratio in parts.items():
        given[0, COMPONENTS.index(name)] = ratio
    given[0, -1] = mass
    return MIDDLE.with_uncertain(given, torch.tensor([[1.05, 0.93, 1.02]], dtype=torch.float64))


# reference


def test_three_sensors_in_the_middle_measure_the_responses_of_the_vertical_vehicle():
    vertical = VerticalVehicle(AM96, parts=("bushings",))
    expected = vertical.channels([[*WORN.values(), 1.1]], BINS)
    found = MIDDLE.channels([[*EVERY.values(), 1.1]], BINS)
    torch.testing.assert_close(found[:, :1], expected, rtol=1e-9, atol=1e-12)
    assert found[:, 1].abs().max() < 1e-12  # cross level


# property


@pytest.mark.parametrize(
    ("vehicle", "row_of"),
    [(VEHICLE, row), (MIDDLE, uncertain)],
    ids=["six", "three in the middle"],
)
def test_one_ratio_of_each_kind_is_read(vehicle, row_of):
    def measured(parts, mass, seed):
        return trip(drawn(vehicle, row_of(parts, mass), seed), 70.0)

    if vehicle is VEHICLE:
        bogie = commissioned_bogie()
    else:
        healthy = [measured({}, mass, i) for i, mass in enumerate(MASSES)]
        bogie = commission_bogie(vehicle, healthy)
        assert bogie.outputs == bogie.healthy.names == PARAMETERS
        assert bogie.scatter.own == (0.0, 0.0, 0.0, 0.0)
        assert np.shape(bogie.scatter.noise) == (4, 4)
    found = fit_parts(bogie, measured(EVERY, 1.05, 9), equal=vehicle is VEHICLE or None)
    assert found.names == found.as_estimate().names == PARAMETERS
    errors = np.log(found.values[:4] / list(WORN.values()))
    assert (np.abs(errors) < 4 * found.deviations[:4]).all()
    assert np.abs(errors).max() < 0.1
    assert found.misfit < 1.2
