"""The IRWLS solver on its own functional, against other people's optimisers."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_reference import (
    lbfgs_msvr,
    naive_loss,
    naive_lower_bound,
    naive_msvr_objective,
    naive_msvr_weights,
    smooth_data,
)
from sklearn.linear_model import Ridge

from suspnet.learning.design import Coefficients, DenseDesign, Gram
from suspnet.learning.feature_maps import random_fourier
from suspnet.learning.irwls import IRWLS, Functional, Status, loss, weight

N_COMPONENTS = 40
PATHS = {
    "fixed": {"slow_decrease": math.inf},  # no step is slow
    "newton": {"slow_decrease": -1.0},  # every step is slow
    "as printed": {"solver": "irwls"},
    "as it goes": {},
}


@pytest.fixture(params=sorted(PATHS))
def path(request):
    return request.param


def problem(sigma=1.0, seed=0, n_samples=150):
    """Blocks of random features, the same as a matrix, and targets."""
    X, Y = smooth_data(seed, n_samples)
    X = torch.tensor(X)
    phi = random_fourier(X, sigma, N_COMPONENTS, seed)
    return DenseDesign(phi, X), phi(X).numpy(), torch.tensor(Y)


@functools.cache
def small_problem():
    """As `problem`, with fewer samples and features."""
    X, Y = smooth_data(1, 60)
    X = torch.tensor(X)
    phi = random_fourier(X, 1.0, 20, 1)
    return DenseDesign(phi, X), phi(X).numpy(), torch.tensor(Y)


@functools.cache
def small_minimum(C, epsilon, fit_intercept):
    _, Phi, Y = small_problem()
    return lbfgs_msvr(Phi, Y.numpy(), C, epsilon, fit_intercept)[2]


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=8), st.floats(0, 10))
@settings(max_examples=50)
def test_loss_is_equation_8_for_any_norm_and_radius(values, epsilon):
    # Exactly: the same two operations, on the same numbers.
    u = torch.tensor(values, dtype=torch.float64)
    np.testing.assert_array_equal(loss(u, epsilon), [naive_loss(v, epsilon) for v in values])


@pytest.mark.parametrize("epsilon", [0.0, 1e-6, 0.05, 0.3])
def test_weight_is_the_derivative_of_the_loss_over_the_norm(epsilon):
    u = torch.tensor([epsilon / 2, epsilon + 0.01, epsilon + 2.0]).double().requires_grad_()
    # Away from the kink, where gradcheck's finite differences are not those of one branch.
    assert torch.autograd.gradcheck(lambda v: loss(v, epsilon), u)
    (slope,) = torch.autograd.grad(loss(u, epsilon).sum(), u)
    expected = torch.where(u > 0, slope / u, 2.0).detach()
    np.testing.assert_allclose(weight(u.detach(), epsilon), expected, rtol=1e-14)
    at_zero = weight(torch.tensor([0.0, 1e-300]).double(), epsilon)
    assert at_zero.tolist() == [0.0 if epsilon else 2.0] * 2


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize("epsilon", [0.05, 0.3])
@pytest.mark.parametrize("n_iter", [1, 2, 5])
def test_gap_bounds_the_excess_on_the_way(path, epsilon, fit_intercept, n_iter):
    design, _, Y = small_problem()
    minimum = small_minimum(10.0, epsilon, fit_intercept)
    found = IRWLS(
        10.0, epsilon, fit_intercept=fit_intercept, max_iter=n_iter, tol=0.0, **PATHS[path]
    ).minimise(design, Y)
    assert found.n_iter == n_iter or found.status == Status.STAGNATED or found.gap == 0
    excess = (found.objective - minimum) / found.objective
    # Rounding, and what L-BFGS leaves.
    assert -1e-10 <= excess <= found.gap + 1e-10


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize("epsilon", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("C", [0.5, 100.0])
def test_fixed_step_projects_residuals_onto_the_ball_and_is_ridge_regression(
    C, epsilon, fit_intercept
):
    design, Phi, Y = small_problem()
    W, b = np.zeros((Phi.shape[1], 2)), np.zeros(2)
    ridge = Ridge(alpha=1 / (2 * C), fit_intercept=fit_intercept, solver="cholesky")
    for n_iter in range(1, 4 if epsilon else 2):
        residual = Y.numpy() - Phi @ W - b
        outside = np.maximum(np.linalg.norm(residual, axis=1, keepdims=True), epsilon)
        ridge.fit(Phi, Y.numpy() - residual * (epsilon / outside if epsilon else 0.0))
        W, b = ridge.coef_.T, ridge.intercept_
        steps = []
        found = IRWLS(
            C, epsilon, fit_intercept=fit_intercept, max_iter=n_iter, tol=0.0, **PATHS["fixed"]
        ).minimise(design, Y, on_iteration=lambda told, steps=steps: steps.append(told.step))
        assert steps == [1.0] * n_iter  # F lies below the quadratic
        # Systems of condition 1e5 or less.
        np.testing.assert_allclose(found.coef, W, atol=1e-9, rtol=0)
        np.testing.assert_allclose(found.intercept, b, atol=1e-9, rtol=0)


@pytest.mark.parametrize("fit_intercept", [False, True])
def test_path_through_reweighted_equations_is_the_textbooks(fit_intercept):
    design, Phi, Y = small_problem()
    C, epsilon, steps = 10.0, 0.3, []
    first, second = (
        IRWLS(
            C, epsilon, fit_intercept=fit_intercept, max_iter=n, tol=0.0, **PATHS["as printed"]
        ).minimise(design, Y, on_iteration=lambda told: steps.append(told.step))
        for n in (1, 2)
    )
    W, b = first.coef.numpy(), first.intercept.numpy()
    a = naive_msvr_weights(Phi, Y.numpy(), W, b, C, epsilon)
    assert 0 < np.count_nonzero(a) < len(a)
    extended = np.column_stack([Phi, np.ones(len(Phi))])[:, : Phi.shape[1] + fit_intercept]
    penalty = np.diag([1.0] * Phi.shape[1] + [0.0] * fit_intercept)
    target = np.linalg.solve(  # Eq. (9)
        extended.T @ (a[:, None] * extended) + penalty, extended.T @ (a[:, None] * Y.numpy())
    )
    start = np.vstack([W, b])[: len(target)]
    expected = start + steps[-1] * (target - start)  # Eq. (11)
    assert 0.1 < np.abs(expected - start).max()
    reached = np.vstack([second.coef, second.intercept])[: len(target)]
    np.testing.assert_allclose(reached, expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize("epsilon", [0.0, 0.3])
def test_gradient_and_weights_are_those_of_equation_10(epsilon, fit_intercept):
    design, Phi, Y = small_problem()
    W = np.linalg.lstsq(Phi, Y.numpy(), rcond=0.1)[0]
    b = np.full(2, 0.1 * fit_intercept)
    residual = Y.numpy() - Phi @ W - b
    functional = Functional(design, 7.0, epsilon, fit_intercept)
    found = functional.gradient(torch.tensor(W), torch.tensor(residual))
    a = naive_msvr_weights(Phi, Y.numpy(), W, b, 7.0, epsilon)
    assert epsilon == 0 or 0 < np.count_nonzero(a) < len(a)
    np.testing.assert_allclose(found.weights, a, rtol=1e-12, atol=0)
    weighted = a[:, None] * residual
    np.testing.assert_allclose(found.coef, W - Phi.T @ weighted, atol=1e-10, rtol=0)
    expected = -weighted.sum(axis=0) * fit_intercept
    np.testing.assert_allclose(found.intercept, expected, atol=1e-10, rtol=0)


def bound_from(direction, W, b, C, epsilon, fit_intercept):
    """What `lower_bound` says at (W, b), and its gradient, from any direction."""
    design, Phi, Y = small_problem()
    functional = Functional(design, C, epsilon, fit_intercept)
    W, b = torch.tensor(W), torch.tensor(b)
    residual = Y - torch.tensor(Phi) @ W - b
    gradient = functional.gradient(W, residual)
    change, products = design.matvec_rmatvec(direction, functional.columns(residual, gradient))
    objective = functional.value(W, residual)
    return functional.lower_bound(objective, gradient, direction, change, products), gradient


@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.floats(-3, 1),
    away=st.floats(-3, 1),
    epsilon=st.sampled_from([0.0, 0.1, 0.3, 3.0]),
    fit_intercept=st.booleans(),
)
def test_lower_bound_holds_for_any_direction_at_any_point(seed, size, away, epsilon, fit_intercept):
    _, Phi, Y = small_problem()
    rng, C = np.random.default_rng(seed), 10.0
    W, dW = 10**away * rng.standard_normal((Phi.shape[1], 2)), rng.standard_normal((20, 2))
    b, db = 10**away * rng.standard_normal(2), rng.standard_normal(2)
    b, db = (b, db) if fit_intercept else (0 * b, 0 * db)
    direction = Coefficients(torch.tensor(10**size * dW), torch.tensor(10**size * db))
    bound, _ = bound_from(direction, W, b, C, epsilon, fit_intercept)
    minimum = small_minimum(C, epsilon, fit_intercept)
    # Sums of squares as large as 1e6 cancel.
    assert bound <= minimum + 1e-8
    naive = naive_lower_bound(
        Phi, Y.numpy(), W, b, 10**size * dW, 10**size * db, C, epsilon, fit_intercept
    )
    assert bound == pytest.approx(naive, rel=1e-9, abs=1e-8)


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize("epsilon", [0.0, 0.3])
def test_lower_bound_of_the_exact_direction_is_the_minimum_of_the_quadratic(epsilon, fit_intercept):
    design, Phi, Y = small_problem()
    W, b = np.full((Phi.shape[1], 2), 0.1), np.full(2, 0.2 * fit_intercept)
    nowhere = Coefficients(torch.zeros(len(W), 2).double(), torch.zeros(2).double())
    weak, gradient = bound_from(nowhere, W, b, 10.0, epsilon, fit_intercept)
    exact = design.equations("reweighted", 10.0, fit_intercept).direction(gradient, 0.0)
    bound, _ = bound_from(exact, W, b, 10.0, epsilon, fit_intercept)
    inner = (gradient.coef * exact.coef).sum() + (gradient.intercept * exact.intercept).sum()
    # The quadratic falls by half the decrement.
    start = naive_msvr_objective(Phi, Y.numpy(), W, b, 10.0, epsilon)
    assert bound == pytest.approx(start + 0.5 * float(inner), rel=1e-10)
    minimum = small_minimum(10.0, epsilon, fit_intercept)
    assert weak < bound <= minimum + 1e-9
    if epsilon == 0:
        assert bound == pytest.approx(minimum, rel=1e-9)


def test_solver_stops_exactly_at_its_tolerance():
    design, _, Y = small_problem()
    solver = IRWLS(10.0, 0.3, max_iter=8, tol=0.0, **PATHS["as printed"])
    gap = solver.minimise(design, Y).gap
    assert 1e-8 < gap < 0.1
    for tol, status in ((gap, Status.CONVERGED), (gap * 0.999, Status.MAX_ITER)):
        found = dataclasses.replace(solver, tol=tol).minimise(design, Y)
        assert (found.gap, found.status, found.n_iter) == (gap, status, 8)


class Rigged:
    """A design whose equations point elsewhere: `change` is applied to the right direction."""

    def __init__(self, design, fixed, others):
        changes = {"fixed": fixed, "reweighted": others, "newton": others}
        self._design, self._changes = design, changes

    def __getattr__(self, name):
        return getattr(self._design, name)

    def equations(self, kind, C, fit_intercept):
        equations = self._design.equations(kind, C, fit_intercept)
        change = self._changes[kind]

        class Changed:
            def direction(self, gradient, accuracy):
                right = equations.direction(gradient, accuracy)
                return Coefficients(change * right.coef, change * right.intercept)

        return Changed()


@pytest.mark.parametrize(
    ("path", "fixed", "others"),
    [
        *(("as it goes", factor, 1.0) for factor in (0.5, 3.0, 100.0, -1.0)),
        *((path, 1.0, factor) for path in ("newton", "as printed") for factor in (0.3, 2.5)),
    ],
)
def test_wrong_equations_do_not_change_the_minimum(path, fixed, others):
    design, _, Y = small_problem()
    steps = []
    found = IRWLS(10.0, 0.1, max_iter=3000, **PATHS[path]).minimise(
        Rigged(design, fixed, others), Y, on_iteration=lambda told: steps.append(told.step)
    )
    assert found.status == Status.CONVERGED
    assert found.objective == pytest.approx(small_minimum(10.0, 0.1, True), rel=2e-8)
    assert (np.diff(found.objectives) <= 0).all()
    assert min(steps) < 1 or max(fixed, others) < 2  # twice too far is where F rises again


def test_directions_that_only_lead_uphill_end_in_stagnation():
    design, _, Y = small_problem()
    found = IRWLS(10.0, 0.1).minimise(Rigged(design, -1.0, -1.0), Y)
    assert found.status == Status.STAGNATED
    assert found.n_iter == 0
    assert found.objectives == [found.objective]
    assert found.gap > 1e-8
    assert float(found.coef.abs().max()) == 0


class Spoilt(DenseDesign):
    """A design whose fixed Gram matrix is another one."""

    def __init__(self, wrong):
        X = torch.tensor(smooth_data(1, 60)[0])
        super().__init__(random_fourier(X, 1.0, 20, 1), X)
        self._wrong = wrong

    def weighted_gram(self, weights):
        gram = super().weighted_gram(weights)
        return self._wrong(gram) if weights is None else gram


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_badly_rounded_gram_matrix_is_only_a_worse_preconditioner(scale, noise):
    *_, Y = small_problem()

    def wrong(whole):
        source = torch.Generator().manual_seed(0)
        error = torch.randn(whole.products.shape, generator=source, dtype=torch.float64)
        products = scale * (whole.products + noise * (error + error.T))
        return Gram(products, scale * whole.sums, scale * 60)

    found = IRWLS(10.0, 0.01, max_iter=3000).minimise(Spoilt(wrong), Y)
    assert found.status == Status.CONVERGED
    assert found.objective == pytest.approx(small_minimum(10.0, 0.01, True), rel=2e-8)


def test_gram_matrix_that_is_not_positive_is_named():
    *_, Y = small_problem()
    spoilt = Spoilt(lambda gram: dataclasses.replace(gram, products=-gram.products))
    with pytest.raises(ValueError, match=r"20 x 20 system .* singular to working precision"):
        IRWLS(10.0, 0.01).minimise(spoilt, Y)


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize(("epsilon", "n"), [(1e-3, 2), (0.3, 1), (0.3, 5)])
def test_gradient_norm_is_that_of_autograd(path, fit_intercept, epsilon, n):
    blocks, Phi, Y = problem()
    found = IRWLS(
        10.0, epsilon, fit_intercept=fit_intercept, max_iter=n, tol=0.0, **PATHS[path]
    ).minimise(blocks, Y)
    W, b = found.coef.clone().requires_grad_(), found.intercept.clone().requires_grad_()
    u = (Y - torch.tensor(Phi) @ W - b).norm(dim=1)
    gradients = torch.autograd.grad(0.5 * W.square().sum() + 10.0 * loss(u, epsilon).sum(), (W, b))
    counted = torch.cat([g.ravel() for g in gradients[: 1 + fit_intercept]])
    assert float(counted.norm()) > 1e-8
    assert found.grad_norm == pytest.approx(float(counted.norm()), rel=1e-6)


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize(("C", "epsilon"), [(1.0, 0.8), (1e4, 1e-6), (1e4, 0.3)])
def test_objective_never_rises(path, C, epsilon, fit_intercept):
    blocks, _, Y = problem(sigma=0.5)
    found = IRWLS(C, epsilon, fit_intercept=fit_intercept, max_iter=60, **PATHS[path]).minimise(
        blocks, Y
    )
    assert len(found.objectives) == found.n_iter + 1
    assert found.n_iter >= 1
    assert (np.diff(found.objectives) <= 0).all()
    assert found.objectives[-1] == found.objective
