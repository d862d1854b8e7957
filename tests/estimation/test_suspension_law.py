"""The law of damping: conditions of trips, what they add to parts, and what cannot be a law."""

import math

import numpy as np
import pytest

from suspnet.estimation.suspension_law import NOTE, SuspensionLaw, follows
from suspnet.ground.parameters import COMPONENTS

UNKNOWN = np.full(2, np.nan)


def test_no_law_is_noted_where_there_is_none():
    assert SuspensionLaw.noted({"commissioned": {"n_trips": 3}}) is None
    assert SuspensionLaw.noted({"seed": 0}) is None


def test_what_is_unknown_counts_as_the_mean():
    speeds = [np.array([0.1, 0.05]), np.array([0.2, 0.05]), np.array([0.1, np.nan])]
    law = SuspensionLaw.of_trips([None, 5.0, 9.0], speeds)
    assert law.healthy_c == 7.0
    assert law.healthy_m_per_s == (pytest.approx(0.1 * 2 ** (1 / 3)), None)
    np.testing.assert_array_equal(law.conditions(None, UNKNOWN), np.zeros(4))
    found = law.conditions(9.0, speeds[1])
    np.testing.assert_allclose(found, [2, 2, math.log(2) * 2 / 3, 0], atol=1e-12)
    unknown = SuspensionLaw.of_trips([None, None], [UNKNOWN, UNKNOWN])
    assert (unknown.healthy_c, unknown.healthy_m_per_s) == (None, (None, None))
    np.testing.assert_array_equal(unknown.conditions(20.0, speeds[0]), np.zeros(4))


def test_shifts_are_those_of_the_docstring():
    slopes, roots = (-0.004, -0.006, -0.3, 0.1), np.random.default_rng(0).normal(size=(4, 4))
    covariance = tuple(map(tuple, (roots @ roots.T).tolist()))
    law = SuspensionLaw(12.0, (0.1, 0.2), slopes, covariance)
    shifts, spread = law.shifts(COMPONENTS, 20.0, np.array([0.11, 0.15]))
    factors = np.zeros((len(COMPONENTS), 4))
    for i, name in enumerate(COMPONENTS):
        if name[0] == "c":
            kind = "ps".index(name[2])
            factors[i, kind] = 20.0 - 12.0
            factors[i, 2 + kind] = math.log((0.11, 0.15)[kind] / (0.1, 0.2)[kind])
    np.testing.assert_allclose(shifts, factors @ slopes)
    np.testing.assert_allclose(spread, factors @ covariance @ factors.T)


def test_dampers_of_the_other_bogie_follow_as_well():
    columns = ("k_p_axle1_left", "c_p_axle1_left", "c_s_right", "other_c_p", "other_c_s", "M_s")
    expected = [[0, 1, 0, 1, 0, 0], [0, 0, 1, 0, 1, 0]]
    np.testing.assert_array_equal(follows(columns), [*expected, *expected])


@pytest.mark.parametrize(
    ("note", "message"),
    [
        ({"healthy_c": math.nan}, "healthy_c` must be a finite number"),
        ({"healthy_c": 10.0, "slopes": [0.0]}, "slopes` must be 4 numbers"),
        ({"healthy_c": 10.0, "healthy_m_per_s": [0.1]}, "healthy_m_per_s` must be 2 numbers"),
        ({"healthy_c": 10.0, "healthy_m_per_s": [0.1, math.inf]}, "must be a finite"),
        ({"healthy_c": 10.0, "covariance": [[math.inf] * 4] * 4}, "covariance` must be a finite"),
    ],
)
def test_a_law_that_cannot_be_is_refused(note, message):
    with pytest.raises(ValueError, match=message):
        SuspensionLaw.noted({"commissioned": {NOTE: note}})
