"""MAPE and RMSE against Eqs. (14) and (15) written as loops."""

import numpy as np
import pytest
import reference

from suspnet.evaluation.metrics import METRICS, score

OUTPUTS = ("k_p", "c_p", "M_s")


@pytest.fixture
def tables():
    rng = np.random.default_rng(0)
    actual = rng.uniform(0.5, 2.0, (50, 3))
    return actual, actual + rng.normal(0, [0.01, 0.1, 1.0], (50, 3))


# reference


def test_scores_equal_naive_formulas(tables):
    actual, predicted = tables
    found = score(actual, predicted, OUTPUTS)
    assert tuple(found) == OUTPUTS
    for j, name in enumerate(OUTPUTS):
        assert tuple(found[name]) == METRICS
        a, f = actual[:, j].tolist(), predicted[:, j].tolist()
        assert found[name]["mape_percent"] == pytest.approx(reference.mape_percent(a, f))
        assert found[name]["rmse"] == pytest.approx(reference.rmse(a, f))


def test_scores_of_two_hand_made_rows():
    found = score(np.array([[0.5], [2.0]]), np.array([[0.6], [1.8]]), ["k_s"])
    # 20 % and 10 %; errors of 0.1 and 0.2
    assert found["k_s"]["mape_percent"] == pytest.approx(15.0)
    assert found["k_s"]["rmse"] == pytest.approx(np.sqrt(0.025))


# limit


def test_perfect_prediction_scores_zero_also_at_healthy():
    actual = np.ones((4, 2))
    assert score(actual, actual, ("k_p", "c_p")) == {
        name: {"mape_percent": 0.0, "rmse": 0.0} for name in ("k_p", "c_p")
    }


# property


def test_scaling_both_scales_rmse_only(tables):
    actual, predicted = tables
    once, doubled = score(actual, predicted, OUTPUTS), score(2 * actual, 2 * predicted, OUTPUTS)
    for name in OUTPUTS:
        assert doubled[name]["mape_percent"] == pytest.approx(once[name]["mape_percent"])
        assert doubled[name]["rmse"] == pytest.approx(2 * once[name]["rmse"])


# failure


def test_predictions_that_are_not_finite_are_rejected(tables):
    actual, predicted = tables
    predicted[3, 1] = np.nan
    with pytest.raises(ValueError, match="contains NaN"):
        score(actual, predicted, OUTPUTS)
