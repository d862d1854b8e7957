"""Damping at equal temperature: naive formulas, slopes that healthy trips show, whole trips."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.temperature import (
    NOTE,
    DampingByTemperature,
    kelvins_warmer,
)

LAW = DampingByTemperature(15.0, (-0.004, -0.005), (0.002, 0.001))


# reference


@pytest.mark.parametrize("warm_c", [-20.0, 15.0, 41.5])
def test_a_trip_is_compared_as_the_formula_says(warm_c):
    names = ("k_p", "c_p", "k_s", "c_s")
    values = np.array([[1.01, 0.8, 0.97, 1.2], [0.9, 1.1, 1.0, 0.6]])
    low, high = values * [0.98, 0.9, 0.99, 0.95], values * [1.02, 1.1, 1.01, 1.08]
    found = LAW.compared(Estimate(names, values, low, high, 0.9, Flags.none(2)), warm_c)
    np.testing.assert_array_equal(found.values[:, ::2], values[:, ::2])  # springs
    np.testing.assert_array_equal(found.low[:, ::2], low[:, ::2])
    z = norm.ppf(0.95)
    for row in range(2):
        for j, b, deviation in ((1, -0.004, 0.002), (3, -0.005, 0.001)):
            log = math.log(values[row, j]) - b * (warm_c - 15.0)
            assert found.values[row, j] == pytest.approx(math.exp(log))
            common = z * deviation * abs(warm_c - 15.0)
            below = math.hypot(math.log(values[row, j] / low[row, j]), common)
            above = math.hypot(math.log(high[row, j] / values[row, j]), common)
            assert found.low[row, j] == pytest.approx(math.exp(log - below))
            assert found.high[row, j] == pytest.approx(math.exp(log + above))


# limits


def test_an_unknown_temperature_changes_nothing():
    one = Estimate(("c_p",), *np.ones((3, 1, 1)), 0.9, Flags.none(1))
    assert LAW.compared(one, None) is one
    assert DampingByTemperature.noted({"commissioned": {"n_trips": 3}}) is None
    assert DampingByTemperature.noted({"seed": 0}) is None
    assert kelvins_warmer([None, 5.0, 9.0]) == (7.0, [0.0, -2.0, 2.0])
    assert kelvins_warmer([None, None]) == (None, [0.0, 0.0])


def test_intervals_that_are_missing_or_reach_0_stay_so():
    nan = np.full((1, 1), np.nan)
    found = LAW.compared(Estimate(("c_s",), np.ones((1, 1)), nan, nan, 0.9, Flags.none(1)), 25.0)
    assert found.values[0, 0] == pytest.approx(math.exp(0.05))
    assert np.isnan([found.low, found.high]).all()
    ends = np.zeros((1, 1)), np.full((1, 1), np.inf)
    found = LAW.compared(Estimate(("c_s",), np.ones((1, 1)), *ends, 0.9, Flags.none(1)), 25.0)
    assert (found.low[0, 0], found.high[0, 0]) == (0.0, np.inf)


# misuse


@pytest.mark.parametrize(
    ("note", "message"),
    [
        ({"healthy_c": math.nan}, "healthy_c` must be a finite number"),
        ({"healthy_c": 10.0, "slopes": [0.0]}, "slopes` must be 2 numbers"),
        ({"healthy_c": 10.0, "deviations": [0.001, math.inf]}, "deviations` must be a finite"),
    ],
)
def test_a_law_that_cannot_be_is_refused(note, message):
    with pytest.raises(ValueError, match=message):
        DampingByTemperature.noted({"commissioned": {NOTE: note}})
