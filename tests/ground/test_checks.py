"""Checks of settings: which values pass, and what a message says."""

import math

import numpy as np
import pytest

from suspnet.ground.settings import check_choice, check_number


@pytest.mark.parametrize(
    ("value", "rule"),
    [
        (0.5, {}),
        (-3, {"low": -3, "high": -3}),
        (0.999, {"above": 0, "below": 1}),
        (np.float32(2), {"low": 2}),
        (np.int64(2), {"low": 2, "whole": True}),
        (None, {"above": 0, "optional": True}),
    ],
)
def test_numbers_within_the_rule_pass(value, rule):
    check_number("x", value, **rule)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 10**400])
def test_what_is_not_finite_is_refused(value):
    with pytest.raises(ValueError, match="`x` must be a finite number, got"):
        check_number("x", value)


@pytest.mark.parametrize("value", [1e30, -1e300, 10**21])
def test_what_no_setting_can_mean_is_refused(value):
    with pytest.raises(ValueError, match=r"`x` must be at most 1e\+20 in magnitude, got"):
        check_number("x", value)


@pytest.mark.parametrize("value", [True, "1", None, 1j, [1.0]])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(TypeError, match=r"`x` must be a finite number > 0, got .*"):
        check_number("x", value, above=0)


@pytest.mark.parametrize("value", [1.5, 2.0, True])
def test_what_is_not_whole_is_refused(value):
    with pytest.raises(TypeError, match=f"`x` must be a whole number >= 1 or null, got {value}"):
        check_number("x", value, low=1, whole=True, optional=True)


@pytest.mark.parametrize(
    ("value", "rule", "message"),
    [
        (0, {"above": 0, "below": 1}, "`x` must be a finite number > 0 and < 1, got 0"),
        (1, {"above": 0, "below": 1}, "`x` must be a finite number > 0 and < 1, got 1"),
        (-0.1, {"low": 0, "high": 1}, "`x` must be a finite number >= 0 and <= 1, got -0.1"),
        (1.1, {"low": 0, "high": 1}, "`x` must be a finite number >= 0 and <= 1, got 1.1"),
        (0, {"low": 1, "whole": True}, "`x` must be a whole number >= 1, got 0"),
    ],
)
def test_message_names_setting_rule_and_value(value, rule, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        check_number("x", value, **rule)


def test_choice_must_be_one_of_those_allowed():
    check_choice("x", "a", ("a", "b"))
    with pytest.raises(ValueError, match=r"`x` must be one of \('a', 'b'\), got 'c'"):
        check_choice("x", "c", ("a", "b"))
