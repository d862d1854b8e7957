"""Responses of twelve separate parts against points and axes in space, and their derivatives."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import spatial_reference
import torch
from vehicles import AM96

from suspnet import SpatialVehicle
from suspnet.ground.parameters import COMPONENTS, CORNERS
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle import spatial_response as module
from suspnet.vehicle.quantities import ADDITIONS, PARTS, PLACES

FREQUENCIES = torch.tensor([0.3, 0.9, 1.31, 1.9, 3.3, 5.4, 7.7, 11.0, 20.0]).double()
LATERAL = (1.0, 0.95, 1.1)
EVERY = (*PARTS, *ADDITIONS)
SIDES = ("leading", "trailing")


def vehicle(parts=EVERY, **options):
    return SpatialVehicle(
        AM96,
        **{"speed_m_per_s": 52.0, "parts": parts, "sensor_lateral_m": LATERAL, "sensors": PLACES}
        | options,
    )


def rows_of(generator, n=2, seed=3):
    """Return ratios with all columns, none of them 1."""
    values = np.random.default_rng(seed).uniform(0.7, 1.4, (n, len(generator.columns)))
    shifted = ("load_ahead", "load_aside", "equipment_ahead")
    values[:, [name in shifted for name in generator.columns]] *= 0.2  # m from the middle
    return torch.as_tensor(values)


def even(generator, rows, names):
    """Return columns of a vehicle whose parts are alike, from columns `names` of another one."""
    column = dict(zip(names, rows.T, strict=True))
    column = {name: column.get(name, column.get(name[:3])) for name in generator.columns}
    ones = torch.ones(len(rows), dtype=torch.float64)
    return torch.stack([ones if one is None else one for one in column.values()], dim=1)


# reference


@pytest.mark.parametrize("parts", [EVERY, *((part,) for part in (*ADDITIONS, "payload"))])
@pytest.mark.parametrize(
    ("bogie", "axle", "direction"),
    [("leading", "leading", "forward"), ("trailing", "trailing", "reverse")],
)
def test_channels_are_those_of_points_and_axes_in_space(parts, bogie, axle, direction):
    generator = vehicle(parts, bogie=bogie, axle=axle, direction=direction, body_sensor_m=1.7)
    rows, bins = rows_of(generator), FREQUENCIES[::2]
    found = generator.channels(rows, bins).numpy()
    assert found.shape == (2, len(generator.inputs), len(PLACES), len(bins))
    assert found.dtype == np.complex128
    for row, one in zip(rows.numpy(), found, strict=True):
        for column, frequency in enumerate(bins.tolist()):
            expected = spatial_reference.channels(generator, row, frequency)
            scale = np.abs(expected).max(axis=1, keepdims=True)
            assert scale.min() > 1e-6
            np.testing.assert_allclose(one[..., column] / scale, expected / scale, atol=1e-9)


@pytest.mark.parametrize(("bogie", "axle"), list(itertools.product(SIDES, SIDES)))
def test_responses_at_a_speed_that_scatters_are_their_mean(bogie, axle):
    """All four wheelsets follow the mean of both rails, each as late as its place says."""
    generator = vehicle((), bogie=bogie, axle=axle)
    rows, nodes = rows_of(generator), np.polynomial.hermite_e.hermegauss(20)
    every = [
        replace(generator, speed_m_per_s=52.0 / (1 + 0.02 * node)).channels(rows, FREQUENCIES)[:, 0]
        for node in nodes[0]
    ]
    expected = np.tensordot(nodes[1] / nodes[1].sum(), np.stack(every), 1)
    found = replace(generator, speed_scatter=0.02).channels(rows, FREQUENCIES)[:, 0].numpy()
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=1e-9 * scale)
    assert np.abs(found - generator.channels(rows, FREQUENCIES)[:, 0].numpy()).max() > 1e-3 * scale


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_channels_alone_are_the_motion_of_one_wheelset(direction):
    generator = vehicle(direction=direction)
    rows, bins = rows_of(generator, 1), FREQUENCIES[::4]
    found = generator.channels_alone(rows, bins).numpy()
    assert found.shape == (1, 3, 4, len(PLACES), len(bins))
    for column, frequency in enumerate(bins.tolist()):
        expected = spatial_reference.alone(generator, rows[0].numpy(), frequency)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found[0, ..., column] / scale, expected / scale, atol=1e-9)


@pytest.mark.parametrize("direction", ["forward", "reverse"])
@pytest.mark.parametrize("parts", [(), ("bushings", "rubber", "frame_yaw", "torsion")])
def test_strokes_are_the_motion_between_the_ends_of_dampers(parts, direction):
    """All sensors are where springs and dampers are."""
    generator = vehicle(parts, direction=direction, sensor_lateral_m=(1.0, 1.0, 1.0))
    rows, bins = torch.ones(2, len(generator.columns), dtype=torch.float64), FREQUENCIES[::2]
    rows[:, : len(COMPONENTS)] = rows_of(generator)[:, : len(COMPONENTS)]
    channels = dict(zip(PLACES, generator.channels(rows, bins).movedim(2, 0), strict=True))
    expected = []
    for corner in CORNERS:
        expected.append(channels[f"frame_{corner}"] - channels[f"axle_box_{corner}"])
    for side in ("left", "right"):
        expected.append(channels[f"body_{side}"] - channels[f"frame_centre_{side}"])
    expected = torch.stack(expected, dim=2)
    if "bushings" in parts:
        numbers = spatial_reference.numbers(generator, rows[0])
        for i, name in enumerate(name for name in COMPONENTS if name.startswith("c_")):
            kind = "primary" if "_p" in name else "secondary"
            damping = rows[:, COMPONENTS.index(name)] * numbers[f"healthy_{name[:3]}"]
            stiffness = numbers[f"{kind}_bushing"]
            of_damper = 1 / (1 + 2j * np.pi * bins * damping[:, None] / stiffness)
            expected[:, :, i] *= of_damper[:, None]
    found = generator.strokes(rows, bins)
    assert found.shape == (2, len(generator.inputs), 12, len(bins))
    scale = expected.abs().amax(dim=(1, 2), keepdim=True)
    torch.testing.assert_close(found[:, :, :6] / scale, expected / scale, rtol=0, atol=1e-9)
    # where both bogies are alike, the other one moves as the measured one does the other way
    back = vehicle(parts, direction="reverse" if direction == "forward" else "forward")
    alike = torch.ones(1, len(generator.columns), dtype=torch.float64)
    other, own = (of.strokes(alike, bins).abs() for of in (generator, back))
    torch.testing.assert_close(other[:, :, 6:], own[:, :, [2, 3, 0, 1, 4, 5]])


@pytest.mark.parametrize(
    ("parts", "direction"),
    [
        ([part for part in EVERY if part != "track"], "forward"),
        ([part for part in EVERY if part != "track"], "reverse"),
        (EVERY, "forward"),
    ],
    ids=["forward", "reverse", "track"],
)
def test_derivatives_are_those_of_central_differences(parts, direction):
    generator, bins = vehicle(parts, direction=direction), FREQUENCIES[::2]
    # at 1e-5 the differences err by their rounding, which left no room below the bound
    rows, offsets, step = rows_of(generator, 2), generator.offsets, 3e-5
    n = len(generator.columns)
    mixed = np.random.default_rng(0).normal(size=(3, n)) / np.sqrt(n)
    along = torch.cat([torch.eye(n, dtype=torch.float64), torch.as_tensor(mixed)])
    channels, slopes = generator.channels_along(rows, bins, along)
    expected = generator.channels(rows, bins)
    assert slopes.shape == (2, n + 3, *expected.shape[1:])
    torch.testing.assert_close(channels, expected, rtol=1e-12, atol=1e-14)
    without_effect = []
    above, below = (
        generator.channels(
            ((rows + offsets)[:, None] * torch.exp(way * step * along) - offsets).flatten(0, 1),
            bins,
        ).unflatten(0, (2, -1))
        for way in (1, -1)
    )
    differences = (above - below) / (2 * step)
    for k, difference in enumerate(differences.unbind(1)):
        size = float(difference.abs().max())
        if size < 1e-6:
            without_effect.append(k)
            size = 1.0
        assert (slopes[:, k] - difference).abs().max() < max(1e-6 * size, 5e-8)  # rounding
    # with an air spring the secondary bushing is out of use
    unused = {"secondary_bushing"}
    if "track" not in parts:
        unused |= {"track_compliance", "track_time"}
    assert {generator.columns[k] for k in without_effect} == unused


# limit


def test_yaw_dampers_without_damping_are_none():
    generator = vehicle(("creep", "frame_yaw", "yaw_dampers"))
    rows = rows_of(generator)
    rows[:, generator.columns.index("yaw_damping")] = 0.0
    without = vehicle(("creep", "frame_yaw"))
    torch.testing.assert_close(
        generator.channels(rows, FREQUENCIES),
        without.channels(rows, FREQUENCIES),
        rtol=1e-3,
        atol=1e-7,
    )


@pytest.mark.parametrize(
    ("bogie", "axle", "frame_sensor", "direction"),
    list(itertools.product(SIDES, SIDES, ("axle", "centre"), ("forward", "reverse"))),
)
@pytest.mark.parametrize("parts", [PARTS[:-1], PARTS, ("roll",)], ids=len)
def test_equal_parts_without_lateral_motion_are_the_vertical_vehicle(
    parts, bogie, axle, frame_sensor, direction
):
    options = {"bogie": bogie, "axle": axle, "direction": direction, "body_sensor_m": 1.7}
    options |= {"frame_sensor": frame_sensor, "speed_m_per_s": 52.0, "sensor_lateral_m": LATERAL}
    parts = tuple(part for part in parts if part != "sensors")
    vertical = VerticalVehicle(AM96, parts=parts, **options)
    spatial = SpatialVehicle(AM96, parts=parts, **options)
    rows = rows_of(vertical)
    expected = vertical.channels(rows, FREQUENCIES)
    found = spatial.channels(even(spatial, rows, vertical.columns), FREQUENCIES)
    mean, half = (
        (found[:, :, ::2] + found[:, :, 1::2]) / 2,
        (found[:, :, ::2] - found[:, :, 1::2]) / 2,
    )
    close = {"rtol": 1e-9, "atol": 1e-12}
    torch.testing.assert_close(mean[:, 0], expected[:, 0], **close)
    torch.testing.assert_close(half[:, 1], expected[:, -1], **close)
    # neither does the mean tilt the vehicle, nor the cross level lift it
    assert half[:, 0].abs().max() < 1e-12
    assert mean[:, 1].abs().max() < 1e-12
    if "wheelsets" in parts:  # the vertical vehicle has the wheelset that runs ahead first
        ahead = (axle == "leading") == (direction == "forward")
        order = [2, 3, 4, 5] if ahead else [3, 2, 5, 4]
        torch.testing.assert_close(mean[:, order], expected[:, 1:5], **close)


def test_five_columns_of_the_vertical_vehicle_with_second_axle_box_and_other_frame_place():
    vertical = VerticalVehicle(AM96, parts=("roll",), sensor_lateral_m=LATERAL)
    spatial = vehicle(
        ("roll",),
        speed_m_per_s=70.0,
        sensors=("axle_box_axle2_left", "frame_centre_middle", "body_middle"),
    )
    ratios = torch.tensor([[0.7, 1.5, 1.3, 0.6, 1.1]]).double()
    found = spatial.channels(
        even(spatial, vertical.complete(ratios), vertical.columns), FREQUENCIES
    )
    delay_s = 2 * AM96.half_wheelbase_m / 70.0
    late = torch.exp(-2j * torch.pi * delay_s * torch.as_tensor(FREQUENCIES))[None]
    torch.testing.assert_close(found[:, 0, 0], late, rtol=1e-9, atol=0)
    centre = replace(vertical, frame_sensor="centre").channels(ratios, FREQUENCIES)[:, 0, 1]
    torch.testing.assert_close(found[:, 0, 1], centre, rtol=1e-9, atol=0)
    body = vertical.channels(ratios, FREQUENCIES)[:, 0, 2]
    torch.testing.assert_close(found[:, 0, 2], body, rtol=1e-9, atol=0)


# property


def test_chunks_do_not_change_the_results(monkeypatch):
    generator = vehicle(sensors=None)
    rows = rows_of(generator, 5)
    along = torch.as_tensor(np.random.default_rng(1).normal(size=(4, len(generator.columns))))
    expected = generator.channels_along(rows, FREQUENCIES, along)
    monkeypatch.setattr(module, "MOST_NUMBERS", 20_000)
    found = generator.channels_along(rows, FREQUENCIES, along)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(
            one, other, rtol=1e-8, atol=1e-10
        )  # rounding over the step of differences
    torch.testing.assert_close(generator.channels(rows, FREQUENCIES), expected[0])
