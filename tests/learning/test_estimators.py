"""Every estimator keeps scikit-learn's contract, on arrays as people have them."""

import importlib.util

import numpy as np
import pytest
import torch
from learning_reference import smooth_data
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.utils.estimator_checks import estimator_checks_generator, parametrize_with_checks

from suspnet.learning import (
    MSVR,
    MVGPR,
    SVR,
    CurveFit,
    KernelRidge,
    LinearRegression,
    baselines,
    msvr,
    mvgpr,
)

# The array API check is skipped, with this warning, unless array_api_compat is installed.
ESTIMATORS = [
    MSVR(n_components=64),
    SVR(),
    KernelRidge(),
    LinearRegression(),
    MVGPR(n_restarts=0, n_optimize=100),
]
MAPPED = [MSVR(feature_map=name, n_components=64) for name in ("orf", "nystroem", "exact")]
GRID = [MSVR(feature_map="equispaced")] if importlib.util.find_spec("finufft") else []


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@parametrize_with_checks(ESTIMATORS[:2])
def test_estimator_keeps_the_contract(estimator, check):
    check(estimator)


OF_A_MAP = ("check_methods_subset_invariance",)
"""Checks that depend on the feature map; the others are those of `MSVR` with any.

tests/learning/test_msvr.py has the model that is stored, for every map.
"""


def of_a_map(estimator):
    for _, check in estimator_checks_generator(estimator):
        name = check.func.__name__
        yield pytest.param(check, id=name, marks=() if name in OF_A_MAP else pytest.mark.slow)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@pytest.mark.parametrize("check", list(of_a_map(MSVR(feature_map="equispaced"))))
def test_equispaced_keeps_the_contract_with_few_inputs(check):
    pytest.importorskip("finufft")
    try:
        check(MSVR(feature_map="equispaced"))
    except (ValueError, AssertionError) as error:
        if "supports at most 3 inputs" not in f"{error} {error.__cause__} {error.__context__}":
            raise
        pytest.skip("the check gives more than three inputs")


def by_name(estimators):
    return [pytest.param(one, id=str(one).partition(", n_")[0]) for one in estimators]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("column", [0, [0], [0, 1]])
@pytest.mark.parametrize("estimator", by_name(ESTIMATORS + MAPPED + GRID))
def test_restored_model_predicts_in_the_shape_and_type_of_the_fitted_one(estimator, column, dtype):
    X, Y = (array.astype(dtype) for array in smooth_data(0, n_samples=40))
    model = clone(estimator).fit(X, Y[:, column])
    restored = clone(estimator).restore(model.state())
    expected, found = model.predict(X), restored.predict(X)
    assert expected.shape == Y[:, column].shape
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected, strict=True)
    assert {k: v.shape for k, v in restored.state().items()} == {
        k: v.shape for k, v in model.state().items()
    }


@pytest.mark.parametrize("default", [torch.float64, torch.float16])
@pytest.mark.parametrize("estimator", by_name(ESTIMATORS + MAPPED))
def test_fit_depends_on_no_global_state_of_torch_or_numpy(estimator, default):
    X, Y = smooth_data(1, n_samples=40)
    expected = clone(estimator).fit(X, Y).predict(X)
    torch.set_default_dtype(default)
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    try:
        found = clone(estimator).fit(X, Y).predict(X)
    finally:
        torch.set_default_dtype(torch.float32)
    np.testing.assert_array_equal(found, expected)


def read_only(array):
    array = array.copy()
    array.setflags(write=False)
    return array


def frame(array):
    pandas = pytest.importorskip("pandas")
    return pandas.DataFrame(array[::-1].copy())[::-1]


LAYOUTS = {
    "reversed": lambda array: array[::-1].copy()[::-1],
    "columns reversed": lambda array: array[:, ::-1].copy()[:, ::-1],
    "every second": lambda array: np.repeat(array, 2, axis=0)[::2],
    "read only": read_only,
    "big endian": lambda array: array.astype(">f8"),
    "Fortran": np.asfortranarray,
    "frame": frame,
    "list": np.ndarray.tolist,
}


@pytest.mark.filterwarnings("ignore:X (has|does not have valid) feature names")
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("estimator", by_name([*ESTIMATORS, MAPPED[1]]))
def test_memory_layout_of_the_data_does_not_matter(estimator, layout):
    X, Y = smooth_data(2, n_samples=40)
    model = clone(estimator).fit(X, Y)
    expected = model.predict(X)
    as_laid_out = LAYOUTS[layout]
    # NumPy sums a column of another layout in another order
    same = {"rtol": 0, "atol": 1e-12}
    np.testing.assert_allclose(model.predict(as_laid_out(X)), expected, **same)
    again = clone(estimator).fit(as_laid_out(X), as_laid_out(Y))
    np.testing.assert_allclose(again.predict(as_laid_out(X)), expected, **same)


@pytest.mark.parametrize("estimator", by_name(ESTIMATORS + MAPPED + GRID))
def test_prediction_in_chunks_is_the_whole(estimator, monkeypatch):
    X, Y = smooth_data(3, n_samples=40)
    model = clone(estimator).fit(X, Y)
    options = {"return_std": True} if isinstance(model, MVGPR) else {}
    whole = model.predict(X, **options)
    for module in (baselines, msvr, mvgpr):
        monkeypatch.setattr(module, "PREDICT_ROWS", 7)
    # Products of other heights may round differently; whitening magnifies that.
    np.testing.assert_allclose(model.predict(X, **options), whole, atol=1e-9, rtol=0)


@pytest.mark.parametrize("estimator", by_name([*ESTIMATORS, MAPPED[1]]))
def test_state_that_does_not_fit_is_refused(estimator):
    with pytest.raises(NotFittedError, match="not fitted yet"):
        clone(estimator).state()
    X, Y = smooth_data(4, n_samples=20)
    state = clone(estimator).fit(X, Y).state()
    for missing in state:
        others = {name: array for name, array in state.items() if name != missing}
        with pytest.raises(ValueError, match="the arrays are not those of"):
            clone(estimator).restore(others)
    # one row less of an array that others must agree with
    name = next(name for name in ("weights", "dual_coef.1", "dual_coef", "coef") if name in state)
    with pytest.raises(ValueError, match=r"shape|differ in number"):
        clone(estimator).restore(state | {name: state[name][:-1]})


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("estimator", by_name(ESTIMATORS))
def test_missing_inputs_are_refused_also_in_prediction(estimator, bad):
    X, Y = smooth_data(5, n_samples=20)
    model, spoilt = clone(estimator).fit(X, Y), X.copy()
    spoilt[3, 1] = bad
    with pytest.raises(ValueError, match=r"Input X contains (NaN|infinity)"):
        model.predict(spoilt)


@pytest.mark.parametrize(
    ("method", "setting", "error"),
    [
        *((SVR, setting, ValueError) for setting in ({"C": 0}, {"tol": 0.0}, {"epsilon": -1e-3})),
        (SVR, {"max_iter": 0}, ValueError),
        (SVR, {"C": True}, TypeError),
        (MSVR, {"C": np.nan}, ValueError),
        (MSVR, {"sigma": -1}, ValueError),
        (MSVR, {"sigma": None}, TypeError),
        (MSVR, {"epsilon": 1j}, TypeError),
        (MSVR, {"n_components": 0}, ValueError),
        (MSVR, {"max_iter": 2.5}, TypeError),
        (MSVR, {"feature_map": "fourier"}, ValueError),
        (MSVR, {"feature_map": ["rff"]}, ValueError),
        (MSVR, {"fit_intercept": "no"}, TypeError),
        (MVGPR, {"noise_variance": np.inf}, ValueError),
        (MVGPR, {"length_scale": "abc"}, TypeError),
        (MVGPR, {"n_optimize": 1}, ValueError),
        (MVGPR, {"optimizer": "adam"}, ValueError),
        (CurveFit, {"n_starts": 1.5}, TypeError),
        (CurveFit, {"tol": 0.0}, ValueError),
    ],
)
def test_setting_out_of_range_is_named(method, setting, error):
    X, Y = smooth_data(6, n_samples=20)
    (name,) = setting
    with pytest.raises(error, match=f"`{name}` must be"):
        method(**setting).fit(X, Y)
