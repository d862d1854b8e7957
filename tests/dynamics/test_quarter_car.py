"""Frequency responses of the quarter-car model against Eqs. (1)-(4) evaluated naively."""

import dataclasses
import math

import numpy as np
import pytest
import reference
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import eigh
from vehicles import AM96

from suspnet.dynamics import QuarterCar, ResponseGenerator, VerticalVehicle

FREQUENCIES = torch.linspace(0.05, 25.0, 40, dtype=torch.float64)
HEALTHY = torch.ones(1, 5, dtype=torch.float64)
ratio_rows = hnp.arrays(
    np.float64, st.tuples(st.integers(1, 4), st.just(5)), elements=st.floats(0.5, 2.0)
)


def scaled(vehicle, mass=1.0, damping=1.0, stiffness=1.0):
    return dataclasses.replace(
        vehicle,
        bogie_mass_kg=vehicle.bogie_mass_kg * mass,
        body_mass_kg=vehicle.body_mass_kg * mass,
        primary_stiffness_n_per_m=vehicle.primary_stiffness_n_per_m * stiffness,
        secondary_stiffness_n_per_m=vehicle.secondary_stiffness_n_per_m * stiffness,
        primary_damping_ns_per_m=vehicle.primary_damping_ns_per_m * damping,
        secondary_damping_ns_per_m=vehicle.secondary_damping_ns_per_m * damping,
    )


# reference


@given(ratio_rows)
def test_responses_equal_eqs_3_and_4(ratios):
    g_p, g_s = QuarterCar(AM96).responses(torch.as_tensor(ratios), FREQUENCIES)
    for row, vehicle_ratios in enumerate(ratios):
        for column, f in enumerate(FREQUENCIES.tolist()):
            expected_p, expected_s = reference.transfer(AM96, vehicle_ratios, f)
            # both orders of operation lose a few digits where powers of s nearly cancel
            assert g_p[row, column].item() == pytest.approx(expected_p, rel=1e-10)
            assert g_s[row, column].item() == pytest.approx(expected_s, rel=1e-10)


@given(ratio_rows)
def test_magnitudes_are_absolute_values_of_responses(ratios):
    model = QuarterCar(AM96)
    curves = model.magnitudes(torch.as_tensor(ratios), FREQUENCIES)
    responses = torch.stack(model.responses(torch.as_tensor(ratios), FREQUENCIES), dim=1)
    assert curves.shape == (len(ratios), 2, len(FREQUENCIES))
    assert curves.min() > 0
    torch.testing.assert_close(curves, responses.abs(), rtol=1e-10, atol=0)


@pytest.mark.parametrize("frequency_hz", [0.1, 1.3, 1.67, 5.4, 20.0])
def test_responses_solve_the_equations_of_motion(quarter_car, frequency_hz):
    ratios = (0.7, 1.9, 1.4, 0.6, 1.2)
    g_p, g_s = quarter_car.responses(
        torch.tensor([ratios], dtype=torch.float64), torch.tensor([frequency_hz])
    )
    frequency_hz = float(torch.tensor(frequency_hz))  # as the float32 that was passed
    expected = reference.transfer_by_solving(quarter_car.vehicle, ratios, frequency_hz)
    assert (g_p.item(), g_s.item()) == pytest.approx(expected, rel=1e-10)


def test_natural_modes_solve_the_undamped_eigenvalue_problem(quarter_car):
    v = quarter_car.vehicle
    k_p, k_s = v.primary_stiffness_n_per_m, v.secondary_stiffness_n_per_m
    mass = np.diag([v.bogie_mass_kg, v.body_mass_kg])
    stiffness = np.array([[k_p + k_s, -k_s], [-k_s, k_s]])
    frequencies_hz, shapes = quarter_car.natural_modes()
    expected = np.sqrt(eigh(stiffness, mass, eigvals_only=True)) / math.tau
    np.testing.assert_allclose(frequencies_hz, expected, rtol=1e-12)
    # the characteristic polynomial in omega^2, written out by hand
    coefficients = [
        mass[0, 0] * mass[1, 1],
        -(mass[0, 0] * k_s + mass[1, 1] * (k_p + k_s)),
        k_p * k_s,
    ]
    np.testing.assert_allclose(
        frequencies_hz, np.sort(np.sqrt(np.roots(coefficients))) / math.tau, rtol=1e-12
    )
    np.testing.assert_allclose(shapes.T @ mass @ shapes, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(
        shapes.T @ stiffness @ shapes, np.diag((math.tau * frequencies_hz) ** 2), atol=1e-8
    )


def test_natural_modes_are_where_a_nearly_undamped_response_peaks(am96):
    model = QuarterCar(am96.degraded(c_p=0.05, c_s=0.02))  # damping ratios 0.2 and 0.34 %
    frequencies = torch.linspace(0.5, 8.0, 75_001, dtype=torch.float64)
    curve = model.magnitudes(HEALTHY, frequencies)[0, 0].numpy()
    inner = curve[1:-1]
    top = np.flatnonzero((inner > curve[:-2]) & (inner > curve[2:])) + 1
    # the peak of a mode with damping ratio z lies within z^2 of it; the grid is 1e-4 Hz
    np.testing.assert_allclose(frequencies[top].numpy(), model.natural_modes()[0], rtol=1e-4)


@pytest.mark.parametrize("vehicle", [AM96, AM96.degraded(k_p=0.6, c_p=2.0, k_s=1.5, M_s=0.7)])
def test_state_space_has_the_same_frequency_response(vehicle):
    model = QuarterCar(vehicle)
    a, b, c, d = model.motion_system(HEALTHY[0]).state_space()
    g_p, g_s = (g[0].numpy() for g in model.responses(HEALTHY, FREQUENCIES))
    for column, f in enumerate(FREQUENCIES.tolist()):
        outputs = c @ np.linalg.solve(2j * math.pi * f * np.eye(4) - a, b) + d
        expected = [g_p[column], g_p[column] * g_s[column]]
        np.testing.assert_allclose(outputs[:, 0], expected, rtol=1e-9)


def test_state_space_poles_are_the_roots_of_the_denominator(quarter_car):
    poles = np.linalg.eigvals(quarter_car.motion_system(HEALTHY[0]).state_space()[0])
    denominator = quarter_car.transfer_coefficients(HEALTHY)[1][0].numpy()
    expected = np.roots(denominator[::-1])
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(expected), rtol=1e-8)
    assert poles.real.max() < 0


# limit


@given(ratio_rows)
def test_gain_at_zero_frequency_is_one(ratios):
    curves = QuarterCar(AM96).magnitudes(torch.as_tensor(ratios), torch.tensor([0.0, 1e-6]))
    # the gain rises as (f / f_0)^2, 1e-12 of it here
    torch.testing.assert_close(curves, torch.ones_like(curves), rtol=1e-10, atol=0)


def test_gain_falls_like_one_over_frequency_far_above_both_modes(quarter_car):
    near, far = quarter_car.magnitudes(HEALTHY, torch.tensor([1e4, 1e5])).squeeze(0).T
    # c_p s / (M_p s^2) and c_s s / (M_s s^2) remain
    torch.testing.assert_close(far / near, torch.full((2,), 0.1).double(), rtol=1e-4, atol=0)
    expected = torch.tensor([3.7e3 / 1725, 22.6e3 / 6300]).double() / (2 * math.pi * 1e5)
    torch.testing.assert_close(far, expected, rtol=1e-4, atol=0)


# property


def test_scaling_masses_dampers_and_springs_together_changes_nothing(quarter_car):
    heavier = QuarterCar(scaled(quarter_car.vehicle, mass=3.0, damping=3.0, stiffness=3.0))
    expected = quarter_car.magnitudes(HEALTHY, FREQUENCIES)
    torch.testing.assert_close(
        heavier.magnitudes(HEALTHY, FREQUENCIES), expected, rtol=1e-12, atol=0
    )


@pytest.mark.parametrize("factor", [0.6, 2.0])
def test_scaling_dampers_by_a_and_springs_by_a_squared_moves_frequencies_by_a(am96, factor):
    faster = QuarterCar(scaled(am96, damping=factor, stiffness=factor**2))
    before = QuarterCar(am96).responses(HEALTHY, FREQUENCIES)
    after = faster.responses(HEALTHY, factor * FREQUENCIES)
    for g_before, g_after in zip(before, after, strict=True):
        torch.testing.assert_close(g_after, g_before, rtol=1e-10, atol=0)


def test_g_s_depends_on_ratios_to_the_body_mass_only(quarter_car):
    ratios = torch.tensor([[1.0, 1.0, 0.6, 0.8, 0.5], [1.0, 1.0, 1.2, 1.6, 1.0]])
    curves = quarter_car.magnitudes(ratios.double(), FREQUENCIES)
    torch.testing.assert_close(curves[0, 1], curves[1, 1], rtol=1e-12, atol=0)
    assert (curves[0, 0] / curves[1, 0] - 1).abs().max() > 0.1


def test_batch_equals_one_by_one(quarter_car):
    ratios = torch.as_tensor(np.random.default_rng(0).uniform(0.5, 2.0, (20, 5)))
    together = quarter_car.magnitudes(ratios, FREQUENCIES)
    alone = torch.cat([quarter_car.magnitudes(row[None], FREQUENCIES) for row in ratios])
    # the matrix product may add in another order
    torch.testing.assert_close(together, alone, rtol=1e-12, atol=0)
    assert together.std(dim=0).min() > 0


def test_ratios_are_left_untouched_and_float32_gives_float64(quarter_car):
    ratios = torch.full((2, 5), 0.75)
    curves = quarter_car.magnitudes(ratios, FREQUENCIES.float())
    assert curves.dtype == torch.float64
    assert torch.equal(ratios, torch.full((2, 5), 0.75))


def test_quarter_car_is_a_response_generator(quarter_car):
    assert isinstance(quarter_car, ResponseGenerator)
    assert not isinstance(quarter_car.vehicle, ResponseGenerator)


# failure


@pytest.mark.parametrize("shape", [(5,), (1, 4), (1, 7), (2, 5, 1)])
@pytest.mark.parametrize("method", ["responses", "magnitudes"])
def test_ratios_of_the_wrong_shape_are_rejected(quarter_car, shape, method):
    with pytest.raises(ValueError, match=r"must have shape \(n_vehicles, 5\)"):
        getattr(quarter_car, method)(torch.ones(shape), FREQUENCIES)


@pytest.mark.parametrize("bins", [[-1.0, 2.0], [math.nan], [[1.0, 2.0]]])
@pytest.mark.parametrize("generator", [QuarterCar(AM96), VerticalVehicle(AM96)])
def test_frequencies_that_are_none_are_rejected(generator, bins):
    for function in (generator.responses, generator.magnitudes, generator.dynamic_stiffness):
        with pytest.raises(ValueError, match=r"finite and not negative, of shape \(n_freq,\)"):
            function(HEALTHY, bins)
    with pytest.raises(TypeError, match="real numbers are expected"):
        generator.responses(np.ones((1, 5)) + 0j, FREQUENCIES)


@pytest.mark.parametrize("value", [0.0, -0.5, math.nan, math.inf])
def test_ratios_that_are_not_positive_and_finite_are_rejected(quarter_car, value):
    ratios = torch.ones(3, 5)
    ratios[1, 2] = value
    with pytest.raises(ValueError, match="`ratios` must be positive and finite"):
        quarter_car.magnitudes(ratios, FREQUENCIES)
