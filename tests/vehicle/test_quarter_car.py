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

from suspnet.vehicle import QuarterCar

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


@pytest.mark.parametrize("vehicle", [AM96, AM96.degraded(k_p=0.6, c_p=2.0, k_s=1.5, M_s=0.7)])
def test_state_space_has_the_same_frequency_response(vehicle):
    model = QuarterCar(vehicle)
    a, b, c, d = model.motion_system(HEALTHY[0]).state_space()
    g_p, g_s = (g[0].numpy() for g in model.responses(HEALTHY, FREQUENCIES))
    for column, f in enumerate(FREQUENCIES.tolist()):
        outputs = c @ np.linalg.solve(2j * math.pi * f * np.eye(4) - a, b) + d
        expected = [g_p[column], g_p[column] * g_s[column]]
        np.testing.assert_allclose(outputs[:, 0], expected, rtol=1e-9)


# limit


def test_gain_falls_like_one_over_frequency_far_above_both_modes(quarter_car):
    near, far = quarter_car.magnitudes(HEALTHY, torch.tensor([1e4, 1e5])).squeeze(0).T
    # c_p s / (M_p s^2) and c_s s / (M_s s^2) remain
    torch.testing.assert_close(far / near, torch.full((2,), 0.1).double(), rtol=1e-4, atol=0)
    expected = torch.tensor([3.7e3 / 1725, 22.6e3 / 6300]).double() / (2 * math.pi * 1e5)
    torch.testing.assert_close(far, expected, rtol=1e-4, atol=0)
