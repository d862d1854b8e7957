"""Logarithm and standardisation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sklearn.preprocessing import StandardScaler

from suspnet.learning import Scaling

seeded = settings(derandomize=True, deadline=None, max_examples=100)


def values(seed=0):
    return np.random.default_rng(seed).uniform([0.5, 3.0, 1e-3], [2.0, 4.0, 5e-3], (40, 3))


@pytest.mark.parametrize("log", [True, False])
def test_scaling_is_that_of_scikit_learn(log):
    V = values()
    expected = StandardScaler().fit_transform(np.log(V) if log else V)
    np.testing.assert_allclose(Scaling.of(V, log).apply(V), expected, atol=1e-12, rtol=0)


@given(arrays(np.float64, (5, 3), elements=st.floats(1e-3, 1e3)), st.booleans())
@seeded
def test_undo_reverses_apply(other, log):
    scaling = Scaling.of(values(), log)
    # |z| reaches 1e6 for the narrow third column, whose error comes back times its deviation.
    np.testing.assert_allclose(scaling.undo(scaling.apply(other)), other, rtol=1e-11)


def test_units_do_not_matter_with_or_without_logarithm():
    V, units = values(), np.array([1e3, 1e-6, 7.0])
    for log in (True, False):
        plain = Scaling.of(V, log).apply(V)
        other = Scaling.of(V * units, log).apply(V * units)
        np.testing.assert_allclose(other, plain, atol=1e-11, rtol=0)


@pytest.mark.parametrize("log", [True, False])
def test_constant_columns_are_named(log):
    V = values()
    V[:, [0, 2]] = 1.0
    with pytest.raises(ValueError, match=r"columns \[0, 2\] are constant"):
        Scaling.of(V, log)


@pytest.mark.parametrize(
    ("bad", "message"),
    [(0.0, "positive for a logarithmic"), (-1.0, "positive for a log"), (np.nan, "must be finite")],
)
def test_logarithm_needs_positive_values(bad, message):
    V = values()
    V[3, 1] = bad
    with pytest.raises(ValueError, match=message):
        Scaling.of(V)


def test_relative_changes_are_ratios_less_one_or_their_logarithms():
    ratios = np.array([[1.0, 2.0], [0.5, 1.0]])
    for log, expected in ((False, ratios - 1), (True, np.log(ratios))):
        scaling = Scaling.relative_changes(2, log)
        np.testing.assert_array_equal(scaling.apply(ratios), expected)
        np.testing.assert_allclose(scaling.undo(expected), ratios, rtol=1e-15)
