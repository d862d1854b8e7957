"""Conformal intervals against sorted scores, two independent packages and exact coverage."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sklearn.base import BaseEstimator, RegressorMixin

from suspnet.estimation.intervals import Conformal

LEVELS = ("0.28", "0.5", "0.7", "0.8", "0.9", "0.95", "0.99")
TABLES = hnp.arrays(
    np.float64,
    st.tuples(st.integers(1, 30), st.integers(1, 3)),
    elements=st.floats(0, 1e6, allow_subnormal=False),
)
NUMBERS = st.floats(0.01, 0.99)


class Column(RegressorMixin, BaseEstimator):
    """A fitted regressor that reads its answer from a column."""

    def __init__(self, column=0):
        self.column = column
        self.n_features_in_ = 2

    def fit(self, X, y):
        return self

    def predict(self, X):
        return np.asarray(X)[:, self.column]


def heteroscedastic(n, seed, n_outputs=2):
    """Return residuals and the standard deviations they were drawn with."""
    rng = np.random.default_rng(seed)
    deviations = rng.uniform(0.5, 2.0, (n, n_outputs))
    return deviations * rng.standard_normal((n, n_outputs)), deviations


def exact_rank(n, level):
    """Return ceil((n + 1) level) in whole numbers; `level` as it is written."""
    return math.ceil((n + 1) * Fraction(level))


# reference


@pytest.mark.parametrize("level", LEVELS)
def test_factor_is_the_kth_smallest_score(level):
    for n in (*range(1, 60), 99, 100, 999):
        residuals, scales = heteroscedastic(n, seed=n)
        found = Conformal.of(residuals, scales).factors(float(level))
        k = exact_rank(n, level)
        for j in range(2):
            scores = sorted(abs(r) / d for r, d in zip(residuals[:, j], scales[:, j], strict=True))
            assert found[j] == (scores[k - 1] if k <= n else math.inf)


@pytest.mark.parametrize("level", LEVELS)
def test_joint_factor_is_that_of_the_largest_score_of_each_sample(level):
    residuals, scales = heteroscedastic(150, seed=1, n_outputs=3)
    largest = sorted(
        max(abs(r) / d for r, d in zip(*rows, strict=True))
        for rows in zip(residuals.tolist(), scales.tolist(), strict=True)
    )
    found = Conformal.of(residuals, scales).joint_factor(float(level))
    assert found == largest[exact_rank(150, level) - 1]


@pytest.mark.parametrize("n", [50, 100, 333])
@pytest.mark.parametrize("level", [0.5, 0.8, 0.9, 0.95])
def test_half_widths_are_those_of_crepes(n, level):
    # crepes rounds (1 - level) (n + 1) down, one too low where it is whole: here it never is
    crepes = pytest.importorskip("crepes")
    residuals, scales = heteroscedastic(n, seed=2)
    new = np.array([0.3, 1.0, 4.0])
    found = Conformal.of(residuals, scales).factors(level)
    for j in range(2):
        other = crepes.ConformalRegressor().fit(residuals[:, j], sigmas=scales[:, j])
        limits = other.predict_int(np.zeros(3), sigmas=new, confidence=level)
        np.testing.assert_allclose(limits[:, 1], new * found[j], rtol=1e-14)
        np.testing.assert_allclose(limits[:, 0], -new * found[j], rtol=1e-14)


@pytest.mark.parametrize("n", [19, 50, 99, 333])
@pytest.mark.parametrize("level", [0.5, 0.8, 0.9])
def test_half_widths_are_those_of_mapie(n, level):
    regression = pytest.importorskip("mapie.regression")
    scores = pytest.importorskip("mapie.conformity_scores")
    residuals, scales = heteroscedastic(n, seed=3, n_outputs=1)
    normalised = scores.ResidualNormalisedScore(Column(1), prefit=True, sym=True)
    other = regression.SplitConformalRegressor(
        Column(0), confidence_level=level, conformity_score=normalised, prefit=True
    )
    other.conformalize(np.column_stack([np.zeros(n), scales]), residuals[:, 0])
    new = np.array([0.3, 1.0, 4.0])
    _, limits = other.predict_interval(np.column_stack([np.zeros(3), new]))
    half = new * Conformal.of(residuals, scales).factors(level)
    np.testing.assert_allclose(limits[:, :, 0], np.column_stack([-half, half]), rtol=1e-14)


@pytest.mark.parametrize(("n", "level"), [(9, 0.9), (20, 0.9), (20, 0.5), (99, 0.95), (100, 0.9)])
def test_coverage_is_exactly_the_rank_over_one_more_than_the_samples(n, level):
    """Of n + 1 exchangeable scores the new one is among the k smallest with k / (n + 1)."""
    n_draws = 40_000  # columns, each a calibration of its own
    drawn = np.random.default_rng(n).exponential(size=(n + 1, n_draws))
    covered = (drawn[-1] <= Conformal(drawn[:-1]).factors(level)).mean()
    exact = exact_rank(n, str(level)) / (n + 1)
    assert level <= exact < level + 1 / (n + 1)
    assert covered == pytest.approx(exact, abs=4 * math.sqrt(exact * (1 - exact) / n_draws))


def test_joint_coverage_on_correlated_outputs_is_exact_too():
    n, level, n_draws = 39, 0.8, 4000
    rng = np.random.default_rng(4)
    covariance = np.array([[1.0, 0.9, -0.5], [0.9, 1.0, -0.4], [-0.5, -0.4, 1.0]])
    drawn = rng.multivariate_normal(np.zeros(3), covariance, (n_draws, n + 1)) * [1.0, 5.0, 0.1]
    joint, each = [], []
    for residuals in drawn:
        conformal = Conformal.of(residuals[:-1], np.ones((n, 3)) * [1.0, 5.0, 0.1])
        new = np.abs(residuals[-1]) / [1.0, 5.0, 0.1]
        joint.append((new <= conformal.joint_factor(level)).all())
        each.append((new <= conformal.factors(level)).all())
    error = 4 * math.sqrt(level * (1 - level) / n_draws)
    assert np.mean(joint) == pytest.approx(32 / 40, abs=error)
    assert np.mean(each) < level - 0.1  # limits of each output are too narrow for all at once


# limit


def test_level_too_high_for_so_few_samples_gives_infinity():
    scores = np.arange(1.0, 10.0)[:, None] * [1.0, 2.0]
    assert Conformal(scores).factors(0.9).tolist() == [9.0, 18.0]
    assert Conformal(scores[:-1]).factors(0.9).tolist() == [math.inf, math.inf]
    assert Conformal(scores[:-1]).joint_factor(0.9) == math.inf


# property


@given(scores=TABLES, level=NUMBERS)
def test_at_least_the_rank_of_the_scores_lie_within_the_factor(scores, level):
    n, k = len(scores), math.ceil((len(scores) + 1) * level - 1e-9)
    found = Conformal(scores).factors(level)
    if k > n:
        assert np.isinf(found).all()
        return
    assert ((scores <= found).sum(axis=0) >= k).all()
    assert ((scores < found).sum(axis=0) < k).all()


# failure


@pytest.mark.parametrize(
    ("residual", "scale", "message"),
    [
        (math.nan, 1.0, "must be finite"),
        (math.inf, 1.0, "must be finite"),
        (1.0, math.nan, "must be finite"),
        (1.0, math.inf, "must be finite"),
        (1.0, 0.0, "scales must be positive"),
        (1.0, -1.0, "scales must be positive"),
    ],
)
def test_values_without_a_score_are_rejected(residual, scale, message):
    residuals, scales = np.ones((4, 2)), np.ones((4, 2))
    residuals[2, 1], scales[2, 1] = residual, scale
    with pytest.raises(ValueError, match=message):
        Conformal.of(residuals, scales)


@pytest.mark.parametrize(
    ("first", "second"), [((4, 2), (4, 1)), ((4, 2), (3, 2)), ((4,), (4,)), ((0, 2), (0, 2))]
)
def test_shapes_that_do_not_fit_are_rejected(first, second):
    with pytest.raises(ValueError, match=r"one shape \(n_calibration, n_outputs\), got \("):
        Conformal.of(np.ones(first), np.ones(second))


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1, 90.0, math.nan])
def test_level_out_of_range_is_rejected(level):
    conformal = Conformal(np.ones((20, 2)))
    with pytest.raises(ValueError, match="`level` must be a finite number > 0 and < 1, got"):
        conformal.factors(level)
    with pytest.raises(ValueError, match="`level` must be a finite number > 0 and < 1, got"):
        conformal.joint_factor(level)
