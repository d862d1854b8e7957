"""What all generators of responses have in common: shapes, types, limits and refusals."""

import math

import numpy as np
import pytest
import torch
from vehicles import AM96

from suspnet.vehicle import QuarterCar, ResponseGenerator, SpatialVehicle, VerticalVehicle
from suspnet.vehicle.quantities import UNMEASURED

FREQUENCIES = torch.linspace(0.3, 19.0, 7, dtype=torch.float64)
GENERATORS = [
    QuarterCar(AM96),
    VerticalVehicle(AM96),
    VerticalVehicle(AM96, bogie="trailing", body_sensor_m=2.0, parts=("rubber", "bending")),
    SpatialVehicle(AM96, parts=("frame_sway",)),
]
RESPONDING = GENERATORS[:3]
of_each = pytest.mark.parametrize("generator", GENERATORS, ids=lambda one: type(one).__name__)
of_responding = pytest.mark.parametrize("generator", RESPONDING, ids=lambda one: type(one).__name__)


def n_outputs(generator):
    return len(getattr(generator, "outputs", "kckcM"))


def ratios_of(generator, n=3):
    values = np.random.default_rng(0).uniform(0.6, 1.6, (n, n_outputs(generator)))
    return torch.as_tensor(values)


@of_responding
def test_magnitudes_and_channels_are_those_of_the_responses(generator):
    ratios = ratios_of(generator)
    g_p, g_s = generator.responses(ratios, FREQUENCIES)
    magnitudes = generator.magnitudes(ratios, FREQUENCIES)
    torch.testing.assert_close(magnitudes, torch.stack([g_p, g_s], 1).abs(), rtol=1e-10, atol=0)
    box, frame, body = generator.channels(ratios, FREQUENCIES)[:, 0].unbind(1)
    torch.testing.assert_close(frame / box, g_p, rtol=1e-12, atol=0)
    torch.testing.assert_close(body / frame, g_s, rtol=1e-12, atol=0)
    assert isinstance(generator, ResponseGenerator)
    assert not isinstance(generator.vehicle, ResponseGenerator)


@of_responding
def test_gain_at_zero_frequency_is_one(generator):
    gains = torch.stack(generator.responses(ratios_of(generator), torch.tensor([0.0])))
    torch.testing.assert_close(gains, torch.ones_like(gains), rtol=1e-12, atol=1e-12)
    # delays change it in first order of frequency: 1e-6 Hz * 20 m / (70 m/s)
    near = torch.stack(generator.responses(ratios_of(generator), torch.tensor([1e-6])))
    assert (near - 1).abs().max() < 1e-5


@of_each
def test_batch_equals_one_by_one_and_float32_gives_float64(generator):
    ratios = ratios_of(generator)
    together = generator.channels(ratios, FREQUENCIES)
    alone = torch.cat([generator.channels(row[None], FREQUENCIES) for row in ratios])
    torch.testing.assert_close(together, alone, rtol=1e-11, atol=1e-13)
    assert together.std(dim=0).max() > 0
    single = torch.full((2, n_outputs(generator)), 0.75)
    assert generator.channels(single, FREQUENCIES.float()).dtype == torch.complex128
    assert bool((single == 0.75).all())


@of_each
def test_other_directions_and_devices_keep_the_rest(generator):
    assert generator.running("forward").on("cpu") == generator
    backwards = generator.running("reverse")
    assert type(backwards) is type(generator)
    assert (backwards == generator) == (generator.direction is None)


@of_each
def test_ratios_of_the_wrong_shape_are_rejected(generator):
    n = n_outputs(generator)
    for shape in ((n,), (1, n - 1), (1, n + 2), (2, n, 1)):
        with pytest.raises(ValueError, match=r"must have shape \(n_vehicles, \d+\)"):
            generator.channels(torch.ones(shape), FREQUENCIES)


@pytest.mark.parametrize("value", [0.0, -0.5, math.nan, math.inf])
@of_each
def test_ratios_that_are_not_positive_and_finite_are_rejected(generator, value):
    ratios = torch.ones(3, n_outputs(generator))
    ratios[1, 2] = value
    with pytest.raises(ValueError, match="`ratios` must be positive and finite"):
        generator.channels(ratios, FREQUENCIES)
    with pytest.raises(ValueError, match="`ratios` must be positive and finite"):
        generator.motion_system(ratios[1])


def test_numbers_of_all_columns_are_checked_too():
    ratios = torch.ones(3, 5 + len(UNMEASURED))
    ratios[1, 5 + UNMEASURED.index("bending_damping")] = 0.0
    with pytest.raises(ValueError, match="`ratios` must be positive and finite"):
        VerticalVehicle(AM96).magnitudes(ratios, FREQUENCIES)


@pytest.mark.parametrize("bins", [[-1.0, 2.0], [math.nan], [[1.0, 2.0]]])
@of_each
def test_frequencies_that_are_none_are_rejected(generator, bins):
    with pytest.raises(ValueError, match="`frequencies_hz` must be finite and not negative"):
        generator.channels(ratios_of(generator), bins)
    with pytest.raises(TypeError, match="real numbers are expected"):
        generator.channels(ratios_of(generator).numpy() + 0j, FREQUENCIES)


def test_separate_parts_need_frequencies_above_zero():
    with pytest.raises(ValueError, match="`frequencies_hz` must be positive"):
        GENERATORS[3].channels(ratios_of(GENERATORS[3]), [0.0, 1.0])
