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


def test_weight_without_tube_is_two_even_without_residual():
    u = torch.tensor([0.0, 1e-300, 1.0, 1e300], dtype=torch.float64)
    assert weight(u, 0.0).tolist() == [2.0, 2.0, 2.0, 2.0]


@pytest.mark.parametrize("function", [loss, derivative, weight])
@pytest.mark.parametrize("epsilon", [0.0, 0.2])
def test_inputs_stay_untouched(function, epsilon):
    u = torch.tensor([[0.0, 0.1], [0.2, 0.7]]).double()
    before = u.clone()
    result = function(u, epsilon)
    assert torch.equal(u, before)
    assert result.shape == u.shape
    assert result.dtype == u.dtype
