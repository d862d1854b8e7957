"""MAPE and RMSE against Eqs. (14) and (15) written as loops; coverage and width of intervals."""

import numpy as np
import pytest
import reference

from suspnet.learning.metrics import METRICS, interval_scores, score, score_where

OUTPUTS = ("k_p", "c_p", "M_s")


@pytest.fixture
def tables():
    rng = np.random.default_rng(0)
    actual = rng.uniform(0.5, 2.0, (50, 3))
    return actual, actual + rng.normal(0, [0.01, 0.1, 1.0], (50, 3))


@pytest.fixture
def limits(tables):
    """Limits about the predictions, and wider ones for all outputs at once."""
    _, predicted = tables
    half = np.array([0.01, 0.15, 0.5])
    return (predicted - half, predicted + half), (predicted - 2 * half, predicted + 2.5 * half)


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


def test_interval_scores_equal_naive_counts(tables, limits):
    actual, _ = tables
    found = interval_scores(actual, *limits, OUTPUTS)
    (low, high), (box_low, box_high) = limits
    assert set(found) == {"outputs", "joint_coverage_percent"}
    assert tuple(found["outputs"]) == OUTPUTS
    for j, name in enumerate(OUTPUTS):
        held = [low[i, j] <= actual[i, j] <= high[i, j] for i in range(50)]
        half = [(high[i, j] - low[i, j]) / 2 / actual[i, j] for i in range(50)]
        assert 0 < sum(held) < 50
        values = found["outputs"][name]
        assert values["coverage_percent"] == pytest.approx(100 * sum(held) / 50)
        assert values["half_width_percent"] == pytest.approx(100 * sum(half) / 50)
    held = [
        all(box_low[i, j] <= actual[i, j] <= box_high[i, j] for j in range(3)) for i in range(50)
    ]
    assert 0 < sum(held) < 50
    assert found["joint_coverage_percent"] == pytest.approx(100 * sum(held) / 50)


# limit


# property


# failure


def test_predictions_that_are_not_finite_are_rejected(tables):
    actual, predicted = tables
    predicted[3, 1] = np.nan
    with pytest.raises(ValueError, match="contains NaN"):
        score(actual, predicted, OUTPUTS)


def test_scores_where_a_part_is_varied_or_degraded_are_those_of_these_rows():
    actual = np.array([[0.5, 1.0], [2.0, 1.0], [1.0, 1.0]])
    predicted = np.array([[0.6, 1.1], [1.0, 1.0], [9.0, 1.0]])
    found = score_where(actual, predicted, ("k_p", "c_p"))
    assert found["varied"]["k_p"]["mape_percent"] == pytest.approx(35)
    assert found["degraded"]["k_p"] == pytest.approx({"mape_percent": 20, "rmse": 0.1})
    assert found["degraded"]["c_p"] == {"mape_percent": None, "rmse": None}
