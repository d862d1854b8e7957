"""MSVR as an estimator: references, invariances, failures."""

import json
from pathlib import Path

import numpy as np
import pytest
from learning_reference import lbfgs_msvr, naive_rbf, smooth_data
from sklearn.exceptions import ConvergenceWarning

from suspnet.learning import MSVR, SVR

PEER = Path(__file__).parent / "data" / "msvr_peer.json"
"""Predictions of a public MSVR (IPL-UV/simpleR under GNU Octave 7); the file names its source."""


def small(**settings):
    return MSVR(**({"C": 10.0, "sigma": 1.0, "n_components": 40} | settings))


def test_predictions_are_those_of_a_public_msvr_where_it_is_right():
    peer = json.loads(PEER.read_text())
    X, Y, X_test = (np.array(peer[key]) for key in ("X", "Y", "X_test"))
    assert peer["cases"]
    for case in peer["cases"]:
        setting = {key: case[key] for key in ("C", "sigma", "epsilon")}
        model = MSVR(feature_map="exact", fit_intercept=False, **setting).fit(X, Y)
        expected = np.array(case["prediction"])
        assert np.abs(expected).max() > 0.1
        # at such epsilon the peer is within 1e-5 of the optimum.
        np.testing.assert_allclose(model.predict(X_test), expected, atol=1e-4, rtol=0)


def test_rff_approaches_exact_with_the_root_of_the_number_of_components():
    X, Y = smooth_data(4)
    X_test, _ = smooth_data(5, n_samples=60)
    setting = {"C": 10.0, "sigma": 1.0, "epsilon": 1e-3}
    exact = MSVR(feature_map="exact", **setting).fit(X, Y).predict(X_test)
    sizes = [64, 128, 256, 512]
    errors = []
    for n_components in sizes:
        models = [
            MSVR(n_components=n_components, random_state=seed, **setting).fit(X, Y)
            for seed in range(8)
        ]
        squares = [np.mean((model.predict(X_test) - exact) ** 2) for model in models]
        errors.append(np.sqrt(np.mean(squares)))
    exponent = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    # -1/2 for many components; a little steeper before, and 8 seeds leave about +-0.1.
    assert -0.75 < exponent < -0.3
    assert errors[-1] < 0.1


def test_callback_hears_of_each_iteration():
    X, Y = smooth_data(13)
    heard = []
    model = small(epsilon=0.05, callback=heard.append).fit(X, Y)
    assert model.n_iter_ > 1
    assert [told.n_iter for told in heard] == list(range(1, model.n_iter_ + 1))
    assert [told.objective for told in heard] == model.objectives_[1:]
    assert heard[-1].grad_norm == model.grad_norm_
    assert heard[-1].support_fraction == model.support_fraction_
    assert all(0 < told.step <= 1 for told in heard)


def test_too_few_iterations_warn():
    X, Y = smooth_data(18)
    model = small(epsilon=0.3, max_iter=1)
    with pytest.warns(ConvergenceWarning, match=r"after 1 iterations \(max_iter reached\)"):
        model.fit(X, Y)
    assert not model.converged_
    assert model.n_iter_ == 1
    assert model.gap_ > model.tol


def test_state_of_another_map_is_refused():
    X, Y = smooth_data(21, n_samples=20)
    state = small(feature_map="nystroem").fit(X, Y).state()
    with pytest.raises(ValueError, match="not those of an MSVR model"):
        small(feature_map="rff").restore(state)


def test_singular_system_is_named():
    X = np.random.default_rng(0).standard_normal((200, 3))
    with pytest.raises(ValueError, match=r"singular to working precision.*lower C"):
        MSVR(C=1e17, n_components=200).fit(X, X[:, :2])


def test_kernel_tol_decides_the_number_of_landmarks():
    X, Y = smooth_data(22)
    sizes = [
        len(small(feature_map="nystroem", kernel_tol=tol, n_components=150).fit(X, Y).coef_)
        for tol in (1e-1, 1e-3, 1e-6)
    ]
    assert sizes[0] < sizes[1] < sizes[2] < 150


def test_sigma_scale_is_that_of_sklearns_gamma():
    X, Y = smooth_data(3, n_samples=60)
    X = 2.5 * X + 1
    gamma = 1 / (X.shape[1] * X.var())
    chosen = small(sigma="scale", feature_map="exact").fit(X, Y)
    same = small(sigma=gamma**-0.5, feature_map="exact").fit(X, Y)
    assert np.allclose(chosen.predict(X), same.predict(X), rtol=1e-9)
    restored = small(sigma="scale", feature_map="exact").restore(chosen.state())
    assert np.array_equal(restored.predict(X), chosen.predict(X))


def test_exact_kernel_of_many_samples_warns(monkeypatch):
    monkeypatch.setattr("suspnet.learning.msvr.MOST_EXACT", 50)
    X, Y = smooth_data(3, n_samples=60)
    with pytest.warns(UserWarning, match="feature_map='exact' takes .* GB and more for 60 samples"):
        small(feature_map="exact").fit(X, Y)
    small(feature_map="exact").fit(X[:50], Y[:50])


@pytest.mark.parametrize("epsilon", [0.0, 1e-3, 0.1])
@pytest.mark.parametrize("feature_map", ["rff", "nystroem", "exact"])
def test_constant_outputs_are_predicted_without_a_warning(feature_map, epsilon):
    X, _ = smooth_data(3, n_samples=40)
    Y = np.tile([1e6 / 3, -0.1], (len(X), 1))
    model = small(feature_map=feature_map, epsilon=epsilon).fit(X, Y)  # a warning is an error
    assert np.array_equal(model.predict(X), Y)


@pytest.mark.parametrize(
    ("C", "sigma", "n_outputs"), [(10.0, 0.3, 2), (10.0, 2.0, 1), (1.0, 2.0, 3)]
)
def test_exact_kernel_in_a_tube_starts_near_the_minimum(C, sigma, n_outputs):
    # a wide kernel has a low rank, a narrow one has not
    rng = np.random.default_rng(0)
    X = rng.uniform(-2, 2, (450, 3))
    Y = np.sin(X @ rng.normal(size=(3, n_outputs))) + 0.1 * rng.normal(size=(450, n_outputs))
    setting = {"C": C, "sigma": sigma, "epsilon": 0.3, "feature_map": "exact", "tol": 1e-10}
    quick = MSVR(**setting).fit(X, Y)
    printed = MSVR(**setting, solver="irwls").fit(X, Y)  # no warning
    assert quick.objective_ == pytest.approx(printed.objective_, rel=1e-9)
    np.testing.assert_allclose(quick.predict(X), printed.predict(X), atol=1e-4, rtol=0)
    assert quick.grad_norm_ < 1e-6
    assert quick.n_iter_ <= min(10, printed.n_iter_ / 3)


@pytest.mark.parametrize(
    ("solver", "fit_intercept"), [("newton", True), ("newton", False), ("irwls", True)]
)
def test_one_output_in_a_tube_of_half_the_samples(solver, fit_intercept):
    X, Y = smooth_data(2, n_samples=60, noise=0.3)
    setting = {"C": 5.0, "sigma": 1.5, "epsilon": 0.25}
    model = MSVR(
        feature_map="exact",
        fit_intercept=fit_intercept,
        solver=solver,
        tol=1e-10,
        max_iter=3000,
        **setting,
    ).fit(X, Y[:, 0])
    predicted = model.predict(X)
    outside = np.abs(Y[:, 0] - predicted) > setting["epsilon"]
    assert 0.35 < outside.mean() == model.support_fraction_ < 0.65
    # L-BFGS on the same functional, with a root of the kernel as features
    values, vectors = np.linalg.eigh(naive_rbf(X, X, setting["sigma"]))
    Phi = vectors * np.sqrt(values.clip(min=0))
    W, b, minimum = lbfgs_msvr(Phi, Y[:, :1], setting["C"], setting["epsilon"], fit_intercept)
    assert model.objective_ == pytest.approx(minimum, rel=1e-9)
    np.testing.assert_allclose(predicted, (Phi @ W + b)[:, 0], atol=1e-4, rtol=0)
    # the absolute loss gives another minimum, but in the same direction
    other = SVR(C=2.0, sigma=setting["sigma"], epsilon=setting["epsilon"])
    svr = other.fit(X, Y[:, 0]).predict(X)
    assert np.ptp(svr) > 4 * setting["epsilon"]
    assert np.corrcoef(predicted, svr)[0, 1] > 0.95
    assert np.abs(predicted - svr).max() < 2 * setting["epsilon"]


@pytest.mark.parametrize("shift", [0.0, 5.0])
@pytest.mark.parametrize("solver", ["newton", "irwls"])
def test_exact_kernel_with_all_samples_inside_the_tube(solver, shift):
    """With a shift, all samples are outside at the start and none at the minimum."""
    X, Y = smooth_data(2, n_samples=60)
    model = small(feature_map="exact", epsilon=4.0, solver=solver).fit(X, Y + shift)  # no warning
    assert model.support_fraction_ == 0
    assert model.objective_ == pytest.approx(0, abs=1e-12)
    assert (model.n_iter_ > 0) == (shift > 0)
    predicted = model.predict(X)
    assert np.linalg.norm(Y + shift - predicted, axis=1).max() <= 4.0 + 1e-9
    assert np.ptp(predicted, axis=0).max() < 1e-6
