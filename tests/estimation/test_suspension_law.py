"""The law of a suspension: conditions of trips, what they do to parts, and what cannot be a law."""

import math

import numpy as np
import pytest

from suspnet.estimation.suspension_law import (
    SLOPES,
    SuspensionLaw,
    beyond_pairs,
    by_dampers,
    follows,
)
from suspnet.ground.parameters import COMPONENTS, DAMPERS, PARAMETERS, kind_of

UNKNOWN = np.full(2, np.nan)


def by_condition(warmer, primary, secondary):
    """Return the condition of each slope."""
    of = {"temperature": warmer, "primary speed": primary, "secondary speed": secondary}
    return [of[slope.condition] for slope in SLOPES]


def test_what_is_unknown_counts_as_the_mean():
    speeds = [np.array([0.1, 0.05]), np.array([0.2, 0.05]), np.array([0.1, np.nan])]
    law = SuspensionLaw.of_trips([None, 5.0, 9.0], speeds)
    assert law.healthy_c == 7.0
    assert law.healthy_m_per_s == (pytest.approx(0.1 * 2 ** (1 / 3)), None)
    np.testing.assert_array_equal(law.conditions(None, UNKNOWN), by_condition(0, 0, 0))
    found = law.conditions(9.0, speeds[1])
    np.testing.assert_allclose(found, by_condition(2, math.log(2) * 2 / 3, 0), atol=1e-12)
    unknown = SuspensionLaw.of_trips([None, None], [UNKNOWN, UNKNOWN])
    assert (unknown.healthy_c, unknown.healthy_m_per_s) == (None, (None, None))
    np.testing.assert_array_equal(unknown.conditions(20.0, speeds[0]), by_condition(0, 0, 0))


def test_slopes_correct_a_part_by_the_speed_of_its_own_damper_and_their_errors_are_shared():
    n, rng = len(SLOPES), np.random.default_rng(0)
    roots, faster = rng.normal(size=(n, n)), rng.normal(size=len(DAMPERS))
    covariance, slopes = roots @ roots.T, tuple(rng.normal(size=n).tolist())
    law = SuspensionLaw(12.0, (0.1, 0.2), slopes, tuple(map(tuple, covariance.tolist())))
    conditions = law.conditions(20.0, np.array([0.11, 0.15]))
    differences, found = law.beside(COMPONENTS, conditions, faster)
    own = [faster[DAMPERS.index(f"c{n[1:]}")] if n != "M_s" else 0.0 for n in COMPONENTS]

    def weight(i, k):
        if kind_of(COMPONENTS[i]) != SLOPES[k].number:
            return 0.0
        return conditions[k] + (own[i] if SLOPES[k].condition != "temperature" else 0.0)

    for i, j in np.ndindex(found.shape):
        pairs = np.ndindex(n, n)
        expected = sum(weight(i, k) * covariance[k, m] * weight(j, m) for k, m in pairs)
        assert found[i, j] == pytest.approx(expected)
    for i, name in enumerate(COMPONENTS):
        each = [
            slopes[k] * own[i]
            for k, slope in enumerate(SLOPES)
            if slope.number == kind_of(name) and slope.condition != "temperature"
        ]
        assert differences[i] == pytest.approx(sum(each))
    # where all of a kind are one, it is the mean of their dampers that counts
    kinds, _ = law.beside(PARAMETERS, conditions, faster)
    for kind, difference in zip(PARAMETERS, kinds, strict=True):
        of_kind = [i for i, name in enumerate(COMPONENTS) if kind_of(name) == kind]
        assert difference == pytest.approx(differences[of_kind].mean())


def test_fitted_slopes_are_in_deviations_of_the_prior():
    law, n = SuspensionLaw(12.0, (0.1, 0.2)), 2
    own_speeds = np.linspace(-3.0, -2.0, len(DAMPERS))
    found = law.fitted(np.array([1.0, -2.0]), np.array([[0.5, 0.1], [0.1, 0.3]]), own_speeds)
    assert found.own_speeds == tuple(own_speeds)
    for i, slope in enumerate(SLOPES):
        size = (1.0, -2.0)[i] if i < n else 0.0
        expected = slope.mean + size * slope.deviation if i < n else 0.0
        assert found.slopes[i] == pytest.approx(expected)
    spread = np.array(found.covariance)
    assert spread[0, 1] == pytest.approx(0.1 * SLOPES[0].deviation * SLOPES[1].deviation)
    assert not spread[n:].any()
    assert found.healthy_m_per_s == (None, None)
    prior, speeds = (np.zeros(len(SLOPES)), np.eye(len(SLOPES))), np.zeros(len(DAMPERS))
    every = SuspensionLaw(None, (0.1, 0.2)).fitted(*prior, speeds)
    assert every == SuspensionLaw(None, (0.1, 0.2))
    assert SuspensionLaw(None).fitted(np.zeros(2), np.eye(2), speeds) is None


def test_parts_of_the_other_bogie_follow_as_well():
    columns = ("k_p_axle1_left", "c_p_axle1_left", "c_s_right", "other_c_p", "rubber_loss", "M_s")
    whose = {"k_p": [0], "c_p": [1, 3], "k_s": [], "c_s": [2], "rubber_loss": [4]}
    for slope, row in zip(SLOPES, follows(columns), strict=True):
        assert np.flatnonzero(row).tolist() == whose[slope.number]


def test_springs_and_dampers_of_both_bogies_follow_the_speeds_of_their_own_dampers():
    columns = ("k_p_axle1_left", "c_p_axle1_left", "other_c_s_right", "other_c_p", "M_s")
    beside = {0: "c_p_axle1_left", 1: "c_p_axle1_left", 2: "other_c_s_right"}
    found = by_dampers(columns)
    for (k, d, column), value in np.ndenumerate(found):
        slope, kind = SLOPES[k], columns[column].removeprefix("other_")[:3]
        is_own = DAMPERS[d] == beside.get(column) and slope.number == kind
        assert value == (is_own and slope.condition != "temperature")
    own, conditions = np.arange(12.0), np.array(by_condition(50.0, 3.0, 7.0))
    pairs = [3.0 if "_p_" in name else 7.0 for name in DAMPERS]
    np.testing.assert_array_equal(beyond_pairs(own, conditions), own - pairs)


@pytest.mark.parametrize(
    ("note", "message"),
    [
        ({"healthy_c": math.nan}, "healthy_c` must be a finite number"),
        ({"healthy_c": 10.0, "slopes": [0.0]}, "slopes` must be 7 numbers"),
        ({"healthy_c": 10.0, "own_speeds": [0.1] * 6}, "own_speeds` must be 12 numbers"),
        ({"healthy_c": 10.0, "healthy_m_per_s": [0.1]}, "healthy_m_per_s` must be 2 numbers"),
        ({"healthy_c": 10.0, "healthy_m_per_s": [0.1, math.inf]}, "must be a finite"),
        ({"healthy_c": 10.0, "covariance": ((math.inf,) * 7,) * 7}, "covariance` must be a finite"),
    ],
)
def test_a_law_that_cannot_be_is_refused(note, message):
    with pytest.raises(ValueError, match=message):
        SuspensionLaw(**note)
