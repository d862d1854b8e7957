"""Every estimator keeps scikit-learn's contract."""

import pytest
from sklearn.utils.estimator_checks import estimator_checks_generator, parametrize_with_checks

from suspnet.learning import MSVR, MVGPR, SVR, LinearRegression


# The array API check is skipped, with this warning, unless array_api_compat is installed.
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@parametrize_with_checks(
    [MSVR(n_components=64), SVR(), LinearRegression(), MVGPR(n_restarts=0, n_optimize=100)]
)
def test_estimator_keeps_the_contract(estimator, check):
    check(estimator)


OF_A_MAP = ("check_fit_idempotent", "check_methods_subset_invariance")
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
