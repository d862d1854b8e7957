"""Every estimator keeps scikit-learn's contract."""

import pytest
from sklearn.utils.estimator_checks import parametrize_with_checks

from suspnet.learning import MSVR, MVGPR, SVR, LinearRegression


# The array API check is skipped, with this warning, unless array_api_compat is installed.
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@parametrize_with_checks([MSVR(), SVR(), LinearRegression(), MVGPR()])
def test_estimator_keeps_the_contract(estimator, check):
    check(estimator)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@parametrize_with_checks([MSVR(feature_map="equispaced")])
def test_equispaced_keeps_the_contract_with_few_inputs(estimator, check):
    pytest.importorskip("finufft")
    try:
        check(estimator)
    except (ValueError, AssertionError) as error:
        if "supports at most 3 inputs" not in f"{error} {error.__cause__} {error.__context__}":
            raise
        pytest.skip("the check gives more than three inputs")
