"""Intervals on a regression whose scatter is known: learnt residual scale, coverage, storage."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from suspnet.estimation.intervals import (
    SMALLEST_SHARE,
    Conformal,
    Intervals,
    ResidualScale,
    residuals,
)

LEVEL = 0.9
MEAN_LOG_NORMAL = -(np.euler_gamma + math.log(2)) / 2
"""Mean of log abs(e), e standard normal."""


def samples(n, seed):
    """Return inputs (n, 3), residuals (n, 2) and the deviations the residuals were drawn with."""
    rng = np.random.default_rng(seed)
    inputs = rng.standard_normal((n, 3))
    deviations = np.stack(
        [0.02 * np.exp(0.8 * inputs[:, 0]), 0.1 * np.exp(np.sin(inputs[:, 1]))], axis=1
    )
    return inputs, deviations * rng.standard_normal((n, 2)), deviations


@pytest.fixture(scope="module")
def learnt():
    inputs, wrong, _ = samples(3000, seed=0)
    return ResidualScale.learnt(inputs, wrong)


@pytest.fixture(scope="module")
def intervals():
    inputs, wrong, _ = samples(6000, seed=1)
    return Intervals.learnt(inputs, wrong, log=True)


# reference


def test_residual_scale_is_the_mean_logarithm_of_the_residual(learnt):
    inputs, _, deviations = samples(4000, seed=2)
    found = np.log(learnt.predict(inputs))
    expected = np.log(deviations) + MEAN_LOG_NORMAL
    for j in range(2):
        assert expected[:, j].std() > 0.6
        assert np.corrcoef(found[:, j], expected[:, j])[0, 1] > 0.95
    # 3000 logarithms that scatter by 1.1, and a penalty that draws towards their mean
    np.testing.assert_allclose((found - expected).mean(axis=0), 0.0, atol=0.06)


def test_coverage_is_that_asked_for_at_every_residual_scale(intervals):
    inputs, wrong, deviations = samples(10_000, seed=3)
    truth = np.ones_like(wrong)
    estimates = np.exp(wrong)
    low, high = intervals.ends(estimates, intervals.residual_scale.predict(inputs), LEVEL)
    within = (low <= truth) & (truth <= high)
    plain = Conformal.of(samples(1500, seed=1)[1], np.ones((1500, 2))).factors(LEVEL)
    unnormalised = np.abs(wrong) <= plain
    for j in range(2):
        slices = np.array_split(np.argsort(deviations[:, j]), 5)
        # 1500 calibration and 2000 test samples: 0.8 % and 0.7 %; four of their root sum
        assert within[:, j].mean() == pytest.approx(LEVEL, abs=0.034)
        assert unnormalised[:, j].mean() == pytest.approx(LEVEL, abs=0.034)
        by_slice = [within[rows, j].mean() for rows in slices]
        # and what the residual scale is wrong by, up to 15 % at the rim of the samples: 5 % of them
        np.testing.assert_allclose(by_slice, LEVEL, atol=0.06)
        blind = [unnormalised[rows, j].mean() for rows in slices]
        assert blind[0] > 0.98
        assert blind[-1] < 0.8
    box = intervals.ends(estimates, intervals.residual_scale.predict(inputs), LEVEL, joint=True)
    both = ((box[0] <= truth) & (truth <= box[1])).all(axis=1)
    assert both.mean() == pytest.approx(LEVEL, abs=0.034)
    assert within.all(axis=1).mean() < 0.85


@pytest.mark.parametrize("log", [True, False])
@pytest.mark.parametrize("joint", [True, False])
def test_ends_are_the_estimate_and_its_half_width(log, joint):
    scores = np.arange(1.0, 20.0)[:, None] * [0.1, 0.2]
    intervals = Intervals(Conformal(scores), log, None)
    estimates, scales = np.array([[1.2, 0.7], [0.5, 2.0]]), np.array([[0.1, 0.3], [1.0, 2.0]])
    low, high = intervals.ends(estimates, scales, 0.5, joint)
    factors = [2.0, 2.0] if joint else [1.0, 2.0]  # the tenth of nineteen
    for i in range(2):
        for j in range(2):
            half = scales[i, j] * factors[j]
            x = estimates[i, j]
            expected = (x / math.exp(half), x * math.exp(half)) if log else (x - half, x + half)
            assert (low[i, j], high[i, j]) == pytest.approx(expected, rel=1e-14)


def test_residuals_are_differences_or_those_of_logarithms():
    estimates, truth = np.array([[1.2, 0.7]]), np.array([[1.0, 1.4]])
    np.testing.assert_allclose(residuals(estimates, truth, log=False), [[0.2, -0.7]])
    logs = [[math.log(1.2), math.log(0.5)]]
    np.testing.assert_allclose(residuals(estimates, truth, log=True), logs)
    for log in (True, False):
        intervals = Intervals(Conformal(np.ones((1, 2))), log, None)
        found = residuals(estimates, truth, intervals.log)
        np.testing.assert_array_equal(found, residuals(estimates, truth, log))


# limit


def test_intervals_are_endless_where_so_few_samples_cannot_tell():
    intervals = Intervals(Conformal(np.ones((8, 1))), False, None)
    low, high = intervals.ends(np.ones((3, 1)), np.ones((3, 1)), LEVEL)
    assert np.isneginf(low).all()
    assert np.isposinf(high).all()
    low, high = Intervals(Conformal(np.ones((8, 1))), True, None).ends(
        np.ones((3, 1)), np.ones((3, 1)), LEVEL
    )
    assert (low == 0).all()
    assert np.isposinf(high).all()


@pytest.mark.parametrize(
    ("nothing", "typical"), [(np.s_[::7], np.median), (np.s_[:200], np.mean)], ids=["few", "most"]
)
def test_residuals_of_nothing_are_taken_as_a_share_of_the_typical_one(nothing, typical):
    inputs, wrong, _ = samples(300, seed=4)
    wrong[nothing] = 0.0
    raised = wrong.copy()
    raised[nothing] = -SMALLEST_SHARE * typical(np.abs(wrong), axis=0)
    found, expected = (ResidualScale.learnt(inputs, r).predict(inputs) for r in (wrong, raised))
    np.testing.assert_array_equal(found, expected)
    assert (found > 0).all()


# property


@given(
    estimate=st.floats(0.3, 3.0),
    truth=st.floats(0.3, 3.0),
    scale=st.floats(0.01, 2.0),
    log=st.booleans(),
)
def test_interval_holds_the_truth_where_the_score_is_within_the_factor(estimate, truth, scale, log):
    intervals = Intervals(Conformal(np.linspace(0.0, 2.0, 21)[:, None]), log, None)
    tables = np.array([[estimate]]), np.array([[scale]])
    low, high = intervals.ends(*tables, 0.5)
    score = abs(residuals(tables[0], np.array([[truth]]), intervals.log)[0, 0]) / scale
    if abs(score - 1.0) > 1e-9:  # the eleventh of twenty-one is 1
        assert (low[0, 0] <= truth <= high[0, 0]) == (score < 1.0)


def test_residual_scale_grows_with_the_residuals_and_forgets_their_signs(learnt):
    inputs, wrong, _ = samples(3000, seed=0)
    new = samples(50, seed=5)[0]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], wrong.shape)
    found = ResidualScale.learnt(inputs, 3.0 * signs * wrong).predict(new)
    np.testing.assert_allclose(found, 3.0 * learnt.predict(new), rtol=1e-6)


def test_one_output_and_one_row_keep_their_shape():
    inputs, wrong, _ = samples(200, seed=6)
    learnt = ResidualScale.learnt(inputs, wrong[:, :1])
    assert learnt.predict(inputs[:1]).shape == (1, 1)
    intervals = Intervals(Conformal.of(wrong[:, :1], learnt.predict(inputs)), True, learnt)
    restored = Intervals.restored(intervals.state())
    assert restored.residual_scale.predict(inputs).shape == (200, 1)


@pytest.mark.parametrize("log", [True, False])
def test_intervals_without_a_learnt_residual_scale_are_restored_too(log):
    intervals = Intervals(Conformal(np.arange(12.0).reshape(6, 2)), log, None)
    restored = Intervals.restored(intervals.state())
    assert restored.residual_scale is None
    assert restored.log is log
    np.testing.assert_array_equal(restored.conformal.scores, intervals.conformal.scores)


# failure


@pytest.mark.parametrize(
    ("value", "message"), [(1.0, "are constant; nothing can be learnt"), (0.0, "must be positive")]
)
def test_residuals_that_are_all_alike_are_rejected(value, message):
    inputs, wrong, _ = samples(100, seed=9)
    wrong[:, 1] = value
    with pytest.raises(ValueError, match=message):
        ResidualScale.learnt(inputs, wrong)


@pytest.mark.parametrize(
    "name",
    ["scores", "log", "size_mean", "size_scale", "residual_scale.coef", "residual_scale.intercept"],
)
def test_missing_arrays_are_named(intervals, name):
    arrays = intervals.state()
    del arrays[name]
    with pytest.raises((KeyError, ValueError), match=name.removeprefix("residual_scale.")):
        Intervals.restored(arrays)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("scores", np.ones(4), "`scores` must be a table"),
        ("scores", np.ones((0, 2)), "`scores` must be a table"),
        ("scores", np.array([[1.0, -1.0]]), "`scores` must be a table"),
        ("scores", np.array([[1.0, math.nan]]), "`scores` must be a table"),
        ("scores", np.array([[1.0, math.inf]]), "`scores` must be a table"),
        ("scores", np.ones((4, 3)), "has 3 outputs, the residual scale"),
        ("log", np.ones(0), "`log` must be one number"),
        ("size_mean", np.ones(3), "has 2 outputs, the residual scale"),
        ("size_scale", np.ones((2, 1)), "has 2 outputs, the residual scale"),
        ("residual_scale.coef", np.ones((4, 2)), r"coef has shape \(4, 2\)"),
        ("residual_scale.intercept", np.ones(3), "coef has shape"),
    ],
)
def test_arrays_that_do_not_fit_are_rejected(intervals, name, array, message):
    with pytest.raises(ValueError, match=message):
        Intervals.restored(intervals.state() | {name: array})
