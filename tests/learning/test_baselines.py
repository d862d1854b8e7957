"""The methods MSVR is compared with, against scikit-learn and numpy."""

import numpy as np
import pytest
from learning_reference import naive_rbf, smooth_data
from sklearn import svm
from sklearn.exceptions import ConvergenceWarning

from suspnet.learning import MSVR, SVR, KernelRidge, LinearRegression


def small(**settings):
    return SVR(**({"C": 10.0, "sigma": 1.3, "epsilon": 0.02, "n_jobs": 1} | settings))


@pytest.mark.parametrize("epsilon", [1e-3, 0.1])
@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_svr_is_one_machine_of_scikit_learn_for_each_output(sigma, epsilon):
    X, Y = smooth_data(0)
    X_test, _ = smooth_data(1, n_samples=50)
    predicted = small(sigma=sigma, epsilon=epsilon).fit(X, Y).predict(X_test)
    for j in range(2):
        other = svm.SVR(gamma=1 / sigma**2, C=10.0, epsilon=epsilon).fit(X, Y[:, j])
        expected = other.predict(X_test)
        assert np.ptp(expected) > 0.5
        # The same machine; only the kernel sum of the prediction is ours.
        np.testing.assert_allclose(predicted[:, j], expected, rtol=0, atol=1e-9)


def test_svr_prediction_is_the_kernel_expansion():
    X, Y = smooth_data(2, n_samples=40)
    model = small().fit(X, Y)
    for j in range(2):
        kernel = naive_rbf(X, model.support_vectors_[j], 1.3)
        expected = kernel @ model.dual_coef_[j] + model.intercept_[j]
        np.testing.assert_allclose(model.predict(X)[:, j], expected, atol=1e-10, rtol=0)


def test_svr_duals_stay_in_the_box_and_residuals_in_the_tube():
    X, Y = smooth_data(3)
    model = small(C=1.0, epsilon=0.1, tol=1e-6).fit(X, Y)
    assert model.converged_
    assert 0.05 < model.support_fraction_ < 0.95
    for dual in model.dual_coef_:
        assert np.abs(dual).max() <= 1.0
        assert abs(dual.sum()) < 1e-8
    n_support = [len(dual) for dual in model.dual_coef_]
    assert model.support_fraction_ == pytest.approx(np.mean(n_support) / len(X))
    outside = np.abs(Y - model.predict(X)) > 0.1 + 1e-5
    assert (outside.sum(axis=0) <= n_support).all()


def test_linear_regression_is_least_squares():
    X, Y = smooth_data(4)
    model = LinearRegression().fit(X, Y)
    design = np.column_stack([X, np.ones(len(X))])
    solution, *_ = np.linalg.lstsq(design, Y, rcond=None)
    assert np.abs(solution).min() > 1e-3
    np.testing.assert_allclose(model.predict(X), design @ solution, atol=1e-12, rtol=0)
    np.testing.assert_allclose(model.coef_, solution[:2].T, atol=1e-12, rtol=0)


def test_kernel_ridge_is_msvr_without_a_tube():
    X, Y = smooth_data(0, 60)
    Y = Y - Y.mean(axis=0)
    found = KernelRidge(C=10.0, sigma=1.0).fit(X, Y)
    kernel = np.exp(-np.square(X[:, None] - X).sum(axis=2))
    np.testing.assert_allclose(
        found.predict(X), kernel @ np.linalg.solve(kernel + np.eye(60) / 20, Y), atol=1e-10, rtol=0
    )
    exact = MSVR(C=10.0, sigma=1.0, epsilon=0.0, feature_map="exact", fit_intercept=False)
    np.testing.assert_allclose(exact.fit(X, Y).predict(X), found.predict(X), atol=1e-9, rtol=0)


@pytest.mark.timeout(30)
def test_svr_ends_where_its_tolerance_is_below_rounding():
    X = np.random.default_rng(0).standard_normal((30, 2))
    model = SVR(C=1e3, tol=1e-16, max_iter=10_000, n_jobs=1)
    with pytest.warns(ConvergenceWarning, match="max_iter=10000"):
        model.fit(X, np.sin(X))
    assert not model.converged_


def test_svr_predicts_a_constant_output():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(30, 2))
    Y = np.column_stack([np.full(30, 2.5), X[:, 0]])
    predicted = SVR(C=10.0).fit(X, Y).predict(X)
    assert predicted[:, 0] == pytest.approx(2.5, abs=1e-3)
    assert np.abs(predicted[:, 1] - X[:, 0]).max() < 0.5
