"""MV-GPR against scikit-learn's Gaussian process and the matrix-normal density."""

import numpy as np
import pytest
from learning_reference import draw_matrix_normal, matrix_normal_logpdf, naive_rbf, smooth_data
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from suspnet.learning import MVGPR

LENGTH, SIGNAL, NOISE = 0.9, 1.7, 0.02
OMEGA = np.array([[1.2, 0.5], [0.5, 0.8]])


def fixed(**settings):
    values = {"length_scale": LENGTH, "signal_variance": SIGNAL, "noise_variance": NOISE}
    return MVGPR(**(values | {"optimizer": None} | settings))


def covariance(X, length=LENGTH, signal=SIGNAL, noise=NOISE):
    """K' = K + sigma_n^2 I, naively."""
    return signal * naive_rbf(X, X, np.sqrt(2) * length) + noise * np.eye(len(X))


def drawn_from_the_model(n_samples, seed=0):
    """Inputs and outputs of MN(0, K', OMEGA)."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-4, 4, (n_samples, 2))
    return X, draw_matrix_normal(rng, covariance(X), OMEGA)


@pytest.fixture(scope="module")
def optimised():
    X, Y = drawn_from_the_model(250)
    model = MVGPR(n_restarts=1, length_scale=3.0, noise_variance=1e-3)
    return X, Y, model.fit(X, Y)


@pytest.fixture(scope="module")
def pair():
    """Ours and scikit-learn's process with the same kernel, and test inputs."""
    X, Y = smooth_data(1, n_samples=80)
    kernel = ConstantKernel(SIGNAL) * RBF(LENGTH) + WhiteKernel(NOISE)
    other = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None).fit(X, Y - Y.mean(axis=0))
    X_test = np.random.default_rng(2).uniform(-4, 4, (40, 2))
    return fixed().fit(X, Y), other, Y, X_test


def test_mean_is_that_of_scikit_learn(pair):
    ours, other, Y, X_test = pair
    expected = other.predict(X_test) + Y.mean(axis=0)
    assert np.abs(other.predict(X_test)).max() > 0.5
    # Two Cholesky solves of the same matrix, condition about 1e4.
    np.testing.assert_allclose(ours.predict(X_test), expected, rtol=0, atol=1e-10)


def test_std_is_that_of_scikit_learn_times_the_outputs_own(pair):
    ours, other, _, X_test = pair
    _, std = ours.predict(X_test, return_std=True)
    _, expected = other.predict(X_test, return_std=True)  # of a noisy output, one per column
    assert expected.max() > 2 * expected.min() > 0.1
    scale = np.sqrt(np.diag(ours.omega_))
    np.testing.assert_allclose(std, expected * scale, rtol=1e-9)
    # Predictive: never below the noise.
    assert (std >= np.sqrt(NOISE) * scale).all()


def test_likelihood_is_the_matrix_normal_density():
    X, Y = smooth_data(3, n_samples=12)
    model, centred = fixed().fit(X, Y), Y - Y.mean(axis=0)
    expected = matrix_normal_logpdf(centred, covariance(X), model.omega_)
    assert abs(expected) > 1
    assert model.log_marginal_likelihood_ == pytest.approx(expected, rel=1e-10)


def test_omega_maximises_the_likelihood():
    X, Y = smooth_data(3, n_samples=12)
    model, centred = fixed().fit(X, Y), Y - Y.mean(axis=0)
    omega = model.omega_
    inverse = np.linalg.inv(covariance(X))
    np.testing.assert_allclose(omega, centred.T @ inverse @ centred / len(X), rtol=1e-9)
    best = matrix_normal_logpdf(centred, covariance(X), omega)
    root, rng = np.linalg.cholesky(omega), np.random.default_rng(4)
    for _ in range(20):
        change = 0.05 * rng.standard_normal((2, 2))
        other = root @ (np.eye(2) + change + change.T) @ root.T
        assert matrix_normal_logpdf(centred, covariance(X), other) < best


def test_optimiser_recovers_the_kernel_of_the_data(optimised):
    _, _, model = optimised
    assert model.converged_
    # 250 points x 2 outputs; the inputs span 9 x 9 length scales, so about 80 independent cells
    # and over 150 residual degrees of freedom per output: relative deviations of about 5 and
    # 10 % - three of them allowed.
    assert model.length_scale_ == pytest.approx(LENGTH, rel=0.15)
    ratio = model.noise_variance_ / model.signal_variance_
    # The ratio carries the signal's deviation, sqrt(2 / 160), as well.
    assert np.log(ratio / (NOISE / SIGNAL)) == pytest.approx(0, abs=0.5)
    correlation = model.omega_[0, 1] / np.sqrt(model.omega_[0, 0] * model.omega_[1, 1])
    assert correlation == pytest.approx(0.5 / np.sqrt(1.2 * 0.8), abs=0.15)


def test_optimised_likelihood_is_not_below_that_of_the_start_or_the_truth(optimised):
    X, Y, model = optimised
    start = MVGPR(length_scale=3.0, noise_variance=1e-3, optimizer=None).fit(X, Y)
    truth = fixed().fit(X, Y)
    assert model.log_marginal_likelihood_ > start.log_marginal_likelihood_ + 10
    assert model.log_marginal_likelihood_ >= truth.log_marginal_likelihood_
    # And it is a maximum along each parameter.
    for name in ("length_scale", "noise_variance"):
        for factor in (0.9, 1.1):
            values = {
                "length_scale": model.length_scale_,
                "signal_variance": model.signal_variance_,
                "noise_variance": model.noise_variance_,
            }
            values[name] *= factor
            moved = MVGPR(optimizer=None, **values).fit(X, Y)
            assert moved.log_marginal_likelihood_ < model.log_marginal_likelihood_


def test_intervals_cover_what_they_promise():
    coverages = []
    for seed in range(5):
        X, Y = drawn_from_the_model(160, seed)
        mean, std = fixed().fit(X[:80], Y[:80]).predict(X[80:], return_std=True)
        coverages.append(np.mean(np.abs(Y[80:] - mean) < 1.96 * std))
    # One draw deviates by about 2.5 % (correlated trials), the mean of five by 1.1 %.
    assert 0.925 < np.mean(coverages) < 0.975


@pytest.mark.parametrize("factor", [0.01, 30.0])
def test_kernel_factor_moves_into_omega(factor, pair):
    ours, _, _, X_test = pair
    X, Y = smooth_data(1, n_samples=80)
    other = fixed(signal_variance=SIGNAL * factor, noise_variance=NOISE * factor).fit(X, Y)
    np.testing.assert_allclose(other.omega_, ours.omega_ / factor, rtol=1e-9)
    assert other.log_marginal_likelihood_ == pytest.approx(ours.log_marginal_likelihood_, rel=1e-9)
    for a, b in zip(
        other.predict(X_test, return_std=True), ours.predict(X_test, return_std=True), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)


def test_optimisation_on_a_part_still_conditions_on_all():
    X, Y = drawn_from_the_model(120, seed=9)
    model = MVGPR(n_optimize=60, n_restarts=0, length_scale=1.0, noise_variance=0.01).fit(X, Y)
    kernel = {
        "length_scale": model.length_scale_,
        "signal_variance": model.signal_variance_,
        "noise_variance": model.noise_variance_,
    }
    expected = MVGPR(optimizer=None, **kernel).fit(X, Y)
    np.testing.assert_array_equal(model.predict(X), expected.predict(X))
    assert model.log_marginal_likelihood_ == expected.log_marginal_likelihood_


def test_callback_hears_of_each_evaluation():
    X, Y = drawn_from_the_model(40, seed=10)
    heard = []
    MVGPR(n_restarts=0, callback=heard.append).fit(X, Y)
    assert [told.n_evaluations for told in heard] == list(range(1, len(heard) + 1))
    assert heard[0].length_scale == pytest.approx(3.0)
    assert heard[0].noise_to_signal == pytest.approx(1e-3)
    assert max(told.log_likelihood for told in heard) > heard[0].log_likelihood + 1


def test_kernel_that_is_not_positive_definite_is_refused():
    X = np.random.default_rng(14).uniform(0, 1, (200, 1))
    Y = np.column_stack([np.sin(X[:, 0]), np.cos(X[:, 0])])
    model = MVGPR(optimizer=None, length_scale=100, noise_variance=1e-18)
    with pytest.raises(ValueError, match="200 x 200 kernel matrix is singular"):
        model.fit(X, Y)


def test_too_few_iterations_warn():
    X, Y = drawn_from_the_model(60, seed=15)
    model = MVGPR(max_iter=1, n_restarts=0)
    with pytest.warns(ConvergenceWarning, match="did not converge in 1 iterations"):
        model.fit(X, Y)
    assert not model.converged_
