"""The law of damping over temperature: what is noted of it, and what cannot be one."""

import math

import pytest

from suspnet.estimation.temperature import NOTE, DampingByTemperature, kelvins_warmer


def test_an_unknown_temperature_counts_as_the_mean():
    assert DampingByTemperature.noted({"commissioned": {"n_trips": 3}}) is None
    assert DampingByTemperature.noted({"seed": 0}) is None
    assert kelvins_warmer([None, 5.0, 9.0]) == (7.0, [0.0, -2.0, 2.0])
    assert kelvins_warmer([None, None]) == (None, [0.0, 0.0])


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
