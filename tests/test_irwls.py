"""The IRWLS solver on its own functional, against other people's optimisers."""

import numpy as np
import pytest
import torch
from learning_reference import lbfgs_msvr, naive_msvr_objective, smooth_data
from sklearn.linear_model import Ridge
from sklearn.svm import LinearSVR

from suspnet.learning.feature_maps import FeatureBlocks, random_fourier
from suspnet.learning.irwls import Status, irwls
from suspnet.learning.loss import loss

N_COMPONENTS = 40


def problem(sigma=1.0, seed=0, n_samples=150):
    """Blocks of random features, the same as a matrix, and targets."""
    X, Y = smooth_data(seed, n_samples)
    X = torch.tensor(X)
    phi = random_fourier(X, sigma, N_COMPONENTS, seed)
    return FeatureBlocks(phi, X), phi(X).numpy(), torch.tensor(Y)


@pytest.mark.parametrize("epsilon", [1e-6, 1e-3, 0.05, 0.3])
@pytest.mark.parametrize("sigma", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("C", [1.0, 10.0, 100.0])
def test_minimum_is_that_of_lbfgs(C, sigma, epsilon):
    blocks, Phi, Y = problem(sigma)
    _, _, minimum = lbfgs_msvr(Phi, Y.numpy(), C, epsilon)
    assert minimum > 0.1
    found = irwls(blocks, Y, C, epsilon, fit_intercept=False, max_iter=1000)
    assert found.status == Status.CONVERGED
    assert found.objective == pytest.approx(minimum, rel=1e-6)
    # F is at least its quadratic model with the reweighted Hessian, so the gap is a bound, not
    # only an estimate; 1e-12 is rounding in sums of 150 terms.
    excess = (found.objective - minimum) / found.objective
    assert excess <= found.gap + 1e-12


@pytest.mark.parametrize("epsilon", [1e-3, 0.3])
@pytest.mark.parametrize("n_iter", [1, 2, 4])
def test_gap_bounds_the_excess_on_the_way(epsilon, n_iter):
    blocks, Phi, Y = problem()
    _, _, minimum = lbfgs_msvr(Phi, Y.numpy(), 10.0, epsilon)
    found = irwls(blocks, Y, 10.0, epsilon, fit_intercept=False, max_iter=n_iter, tol=0.0)
    excess = (found.objective - minimum) / found.objective
    assert -1e-9 <= excess <= found.gap + 1e-12


@pytest.mark.parametrize("epsilon", [0.0, 1e-3, 0.3])
def test_minimum_with_intercept_is_that_of_lbfgs(epsilon):
    blocks, Phi, Y = problem()
    W, b, minimum = lbfgs_msvr(Phi, Y.numpy(), 10.0, epsilon, fit_intercept=True)
    found = irwls(blocks, Y, 10.0, epsilon, tol=1e-13, max_iter=5000)
    assert np.abs(b).max() > 0.1
    assert found.objective == pytest.approx(minimum, rel=1e-9)
    # |W - W*|^2 <= 2 (F - F*): relative 1e-12 in F of order 10 leaves 1e-5 in W.
    np.testing.assert_allclose(found.coef, W, atol=2e-5, rtol=0)
    np.testing.assert_allclose(found.intercept, b, atol=2e-5, rtol=0)


def test_objective_is_equation_7():
    blocks, Phi, Y = problem(n_samples=60)
    found = irwls(blocks, Y, 10.0, 0.05)
    naive = naive_msvr_objective(
        Phi, Y.numpy(), found.coef.numpy(), found.intercept.numpy(), 10.0, 0.05
    )
    assert found.objective == pytest.approx(naive, rel=1e-10)
    start = naive_msvr_objective(Phi, Y.numpy(), np.zeros_like(found.coef), np.zeros(2), 10.0, 0.05)
    assert found.objectives[0] == pytest.approx(start, rel=1e-12)


@pytest.mark.parametrize("C", [0.5, 10.0])
def test_without_tube_and_intercept_it_is_ridge(C):
    blocks, Phi, Y = problem()
    ridge = Ridge(alpha=1 / (2 * C), fit_intercept=False, solver="cholesky").fit(Phi, Y.numpy())
    found = irwls(blocks, Y, C, 0.0, fit_intercept=False, tol=1e-14)
    assert found.n_iter == 1
    assert np.abs(ridge.coef_).max() > 0.1
    # One linear system of condition 1e4 or less, solved twice.
    np.testing.assert_allclose(found.coef, ridge.coef_.T, rtol=0, atol=1e-10)


def test_without_tube_but_with_intercept_it_is_ridge_with_free_intercept():
    blocks, Phi, Y = problem()
    ridge = Ridge(alpha=1 / 20, solver="cholesky").fit(Phi, Y.numpy())
    found = irwls(blocks, Y, 10.0, 0.0, tol=1e-14)
    np.testing.assert_allclose(found.coef, ridge.coef_.T, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.intercept, ridge.intercept_, rtol=0, atol=1e-10)


@pytest.mark.parametrize("epsilon", [1e-3, 0.2])
@pytest.mark.parametrize("C", [1.0, 10.0])
def test_one_output_is_linear_svr_with_squared_loss(C, epsilon):
    blocks, Phi, Y = problem()
    y = Y[:, 0].numpy()
    other = LinearSVR(
        C=C,
        epsilon=epsilon,
        loss="squared_epsilon_insensitive",
        fit_intercept=False,
        dual=False,
        tol=1e-12,
        max_iter=100_000,
    ).fit(Phi, y)
    found = irwls(blocks, Y[:, :1], C, epsilon, fit_intercept=False, tol=1e-13, max_iter=5000)
    reference = naive_msvr_objective(Phi, y[:, None], other.coef_[:, None], np.zeros(1), C, epsilon)
    assert found.objective == pytest.approx(reference, rel=1e-8)
    # liblinear stops at a relative gradient of 1e-12, whose effect here is below 1e-5.
    np.testing.assert_allclose(Phi @ found.coef[:, 0].numpy(), other.predict(Phi), atol=1e-5)


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize("epsilon", [1e-3, 0.3])
def test_gradient_norm_is_that_of_autograd(fit_intercept, epsilon):
    blocks, Phi, Y = problem()
    found = irwls(blocks, Y, 10.0, epsilon, fit_intercept=fit_intercept, max_iter=2, tol=0.0)
    W, b = found.coef.clone().requires_grad_(), found.intercept.clone().requires_grad_()
    u = (Y - torch.tensor(Phi) @ W - b).norm(dim=1)
    gradients = torch.autograd.grad(0.5 * W.square().sum() + 10.0 * loss(u, epsilon).sum(), (W, b))
    counted = torch.cat([g.ravel() for g in gradients[: 1 + fit_intercept]])
    assert float(counted.norm()) > 1e-8
    assert found.grad_norm == pytest.approx(float(counted.norm()), rel=1e-6)


def test_everything_inside_the_tube_gives_the_zero_model():
    blocks, _, Y = problem()
    found = irwls(blocks, Y, 10.0, 1e3)
    assert found.status == Status.CONVERGED
    assert found.n_iter == 0
    assert found.objective == 0
    assert found.support_fraction == 0
    assert float(found.coef.abs().max()) == 0


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize("epsilon", [1e-6, 0.05, 0.3, 0.8])
@pytest.mark.parametrize("C", [1.0, 1e4])
def test_objective_never_rises(C, epsilon, fit_intercept):
    blocks, _, Y = problem(sigma=0.5)
    found = irwls(blocks, Y, C, epsilon, fit_intercept=fit_intercept, max_iter=300)
    assert len(found.objectives) == found.n_iter + 1
    assert found.n_iter >= 1
    assert (np.diff(found.objectives) <= 0).all()
    assert found.objectives[-1] == found.objective


def test_support_fraction_counts_samples_outside_the_tube():
    blocks, Phi, Y = problem()
    found = irwls(blocks, Y, 10.0, 0.1, max_iter=1000)
    u = np.linalg.norm(Y.numpy() - Phi @ found.coef.numpy() - found.intercept.numpy(), axis=1)
    assert 0.05 < found.support_fraction < 0.95
    assert found.support_fraction == pytest.approx(np.mean(u > 0.1), abs=1e-12)


def test_status_and_gap_tell_of_an_early_end():
    blocks, _, Y = problem()
    found = irwls(blocks, Y, 100.0, 0.3, max_iter=1)
    assert found.status == Status.MAX_ITER
    assert found.n_iter == 1
    assert found.gap > 1e-8


def test_targets_stay_untouched():
    blocks, _, Y = problem()
    before = Y.clone()
    irwls(blocks, Y, 10.0, 0.05)
    assert torch.equal(Y, before)


def test_blocks_of_any_height_give_the_same_solution():
    blocks, _, Y = problem()
    small = FeatureBlocks(blocks.feature_map, blocks.X, 11)
    whole, pieces = (irwls(b, Y, 10.0, 0.05, tol=1e-12, max_iter=2000) for b in (blocks, small))
    # Sums in another order, through as many iterations.
    np.testing.assert_allclose(pieces.coef, whole.coef, atol=1e-7, rtol=0)
