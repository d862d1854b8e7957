"""The loss of Eq. (8), its derivative and its IRWLS weight."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_reference import naive_loss

from suspnet.learning.loss import derivative, loss, weight

EPSILONS = (0.0, 1e-6, 1e-3, 0.05, 0.3)
seeded = settings(derandomize=True, deadline=None, max_examples=100)
norms = st.lists(st.floats(0, 1e6), min_size=1, max_size=8)
radii = st.floats(0, 10)


def grid(epsilon):
    """Norms on both sides of the kink, 0 and the kink itself included."""
    return torch.tensor(
        [0.0, epsilon / 2, epsilon, epsilon + 1e-9, epsilon + 0.1, 3.0, 1e3]
    ).double()


@pytest.mark.parametrize("epsilon", EPSILONS)
def test_loss_is_equation_8(epsilon):
    u = grid(epsilon)
    expected = [naive_loss(float(v), epsilon) for v in u]
    assert max(expected) > 1
    np.testing.assert_allclose(loss(u, epsilon), expected, rtol=1e-14, atol=0)


@given(norms, radii)
@seeded
def test_loss_is_equation_8_for_any_norm_and_radius(values, epsilon):
    expected = [naive_loss(v, epsilon) for v in values]
    u = torch.tensor(values, dtype=torch.float64)
    # Exactly: the same two operations, on the same numbers.
    np.testing.assert_array_equal(loss(u, epsilon), expected)


@pytest.mark.parametrize("epsilon", EPSILONS)
def test_derivative_is_that_of_autograd(epsilon):
    # Away from the kink, where gradcheck's finite differences are not those of one branch.
    u = torch.tensor(
        [epsilon / 2, epsilon + 0.01, epsilon + 2.0], dtype=torch.float64
    ).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: loss(v, epsilon), u)
    (expected,) = torch.autograd.grad(loss(u, epsilon).sum(), u)
    assert float(expected.max()) > 1
    np.testing.assert_allclose(derivative(u.detach(), epsilon), expected, rtol=1e-14)


@given(st.lists(st.floats(1e-100, 1e6), min_size=1, max_size=8), radii)
@seeded
def test_weight_is_derivative_over_norm(values, epsilon):
    u = torch.tensor(values, dtype=torch.float64)
    # Two roundings: rtol of a few units in the last place.
    np.testing.assert_allclose(weight(u, epsilon), derivative(u, epsilon) / u, rtol=1e-15)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=4), radii)
@seeded
def test_weight_times_residual_is_the_gradient_in_the_residual(values, epsilon):
    e = torch.tensor(values, dtype=torch.float64, requires_grad=True)
    u = e.norm()
    (expected,) = torch.autograd.grad(loss(u, epsilon), e)
    found = weight(u.detach()[None], epsilon) * e.detach()
    # atol for residuals whose squares underflow in the norm.
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-150)


@pytest.mark.parametrize("epsilon", EPSILONS[1:])
def test_loss_derivative_and_weight_are_continuous_at_epsilon(epsilon):
    h = 1e-6 * epsilon
    sides = torch.tensor([epsilon - h, epsilon + h], dtype=torch.float64)
    # Jumps are of the order of the step: h^2, 2h and 2h / epsilon (rounding of the sum allowed).
    assert np.ptp(loss(sides, epsilon).numpy()) <= 1.01 * h**2
    assert np.ptp(derivative(sides, epsilon).numpy()) <= 2.01 * h
    assert np.ptp(weight(sides, epsilon).numpy()) <= 2.01 * h / epsilon


def test_everything_vanishes_on_the_tube():
    u = torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64)
    for function in (loss, derivative, weight):
        assert function(u, 0.2).tolist() == [0.0, 0.0, 0.0]


def test_weight_without_tube_is_two_even_without_residual():
    u = torch.tensor([0.0, 1e-300, 1.0, 1e300], dtype=torch.float64)
    assert weight(u, 0.0).tolist() == [2.0, 2.0, 2.0, 2.0]


@pytest.mark.parametrize("epsilon", [0.0, 1e-3])
def test_no_residual_gives_finite_values(epsilon):
    u = torch.zeros(3, dtype=torch.float64)
    for function in (loss, derivative, weight):
        assert bool(torch.isfinite(function(u, epsilon)).all())


@given(norms, radii)
@seeded
def test_weight_lies_between_zero_and_two(values, epsilon):
    found = weight(torch.tensor(values, dtype=torch.float64), epsilon)
    assert bool((found >= 0).all())
    assert bool((found <= 2).all())


@pytest.mark.parametrize("function", [loss, derivative, weight])
@pytest.mark.parametrize("epsilon", [0.0, 0.2])
def test_inputs_stay_untouched(function, epsilon):
    u = torch.tensor([[0.0, 0.1], [0.2, 0.7]]).double()
    before = u.clone()
    result = function(u, epsilon)
    assert torch.equal(u, before)
    assert result.shape == u.shape
    assert result.dtype == u.dtype
