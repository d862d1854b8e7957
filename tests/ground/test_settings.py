"""Settings as declared: each class refuses what lies outside of a range, and says the range."""

import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest

from suspnet.cli.kinds import KINDS, class_of
from suspnet.curves.components import CurveFeatures
from suspnet.curves.extraction import PeakFeatures
from suspnet.ground.settings import (
    Setting,
    check_number,
    check_settings,
    setting,
    settings_of,
)
from suspnet.trains.simulation.signals import Sensor

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
CLASSES = [
    *(class_of(place, kind) for place, kinds in KINDS.items() for kind in kinds if kind != "best"),
    *(Sensor, CurveFeatures, PeakFeatures),
]


def ends(declared):
    """Yield a value beyond each end of the range of a number, and the nearest one that is valid."""
    setting, kind = declared.setting, declared.type
    step = 1 if kind is int else 1e-6
    high = setting.most if setting.high is None else setting.high
    for end, is_inside, sign in (
        *((setting.low, True, -1), (setting.above, False, -1)),
        *((high, True, 1), (setting.below, False, 1)),
    ):
        if end is not None:
            further, nearer = (kind(end + s * sign * step * max(1, abs(end))) for s in (1, -1))
            yield (further, kind(end)) if is_inside else (end, nearer)


@pytest.mark.parametrize("class_", CLASSES, ids=lambda class_: class_.__name__)
def test_each_setting_takes_what_its_declaration_says_and_nothing_else(class_):
    for declared in settings_of(class_).values():
        wrong = []
        if declared.type in (int, float):
            for beyond, valid in ends(declared):
                with pytest.raises(ValueError, match=f"`x` must be .*, got {beyond}"):
                    declared.check("x", beyond)
                declared.check("x", valid)
            wrong = [math.nan, math.inf, 1e30, "7", True, [1.0]]
            wrong += [1.5] * (declared.type is int) + [None] * (not declared.is_optional)
        elif declared.choices or declared.type is bool:
            for valid in declared.choices or (True, False):
                declared.check("x", valid)
            wrong = ["nonsense", 0, 1.5]
        for value in wrong:
            with pytest.raises((TypeError, ValueError), match="`x` must be"):
                declared.check("x", value)


@dataclass
class Trip:
    name: Annotated[str, Setting("Name", rule="text")]
    side: Literal["left", "right"] | None = setting(None, "Side of the bogie")
    rate_hz: float = setting(100.0, "Rate", "Hz", above=0, most=1e4)
    n_stops: int = setting(1, "Stops", low=0)
    places_m: tuple[float, float] = setting((0.0, 0.0), "Places", "m", low=-2, high=2)
    is_dry: bool = setting(True, "Whether the rail is dry")

    def __post_init__(self):
        check_settings(self, "trip")


def test_declaration_says_type_unit_and_range():
    comments = pytest.importorskip("config_comments", reason="needs benchmarks")
    assert [comments.text(declared) for declared in settings_of(Trip).values()] == [
        "Name [text]",
        "Side of the bogie [left or right; or null]",
        "Rate [Hz; above 0 and at most 1e4]",
        "Stops [whole number; at least 0]",
        "Places [two numbers, m; -2 to 2]",
        "Whether the rail is dry [true or false]",
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate_hz": 0.0}, r"`trip\.rate_hz` must be a finite number > 0, got 0"),
        ({"rate_hz": 2e4}, r"`trip\.rate_hz` must be at most 10000 in magnitude"),
        ({"n_stops": 1.5}, r"`trip\.n_stops` must be a whole number >= 0, got 1\.5"),
        ({"side": "top"}, r"`trip\.side` must be one of \('left', 'right', None\), got 'top'"),
        ({"places_m": (0.0, 3.0)}, r"`trip\.places_m\[1\]` must be a finite number >= -2 and <= 2"),
        ({"is_dry": "yes"}, r"`trip\.is_dry` must be True or False, got 'yes'"),
    ],
)
def test_object_with_a_wrong_setting_is_refused(changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        Trip("x", **changes)


@pytest.mark.parametrize(
    ("value", "rule"),
    [
        (-3, {"low": -3, "high": -3}),
        (0.999, {"above": 0, "below": 1}),
        (np.float32(2), {"low": 2}),
        (np.int64(2), {"low": 2, "whole": True}),
        (None, {"above": 0, "optional": True}),
    ],
)
def test_numbers_within_the_rule_pass(value, rule):
    check_number("x", value, **rule)


@pytest.mark.parametrize(
    ("value", "rule", "error", "message"),
    [
        *(
            (value, {}, ValueError, "a finite number, got")
            for value in (math.nan, math.inf, 10**400)
        ),
        *((value, {}, ValueError, "at most 1e+20 in magnitude, got") for value in (1e30, -1e300)),
        *((value, {}, TypeError, "a finite number, got") for value in (True, "1", None, 1j, [1.0])),
        (2.0, {"whole": True, "optional": True}, TypeError, "a whole number or null, got 2.0"),
        (0, {"above": 0, "below": 1}, ValueError, "a finite number > 0 and < 1, got 0"),
        (1.1, {"low": 0, "high": 1}, ValueError, "a finite number >= 0 and <= 1, got 1.1"),
        (0, {"low": 1, "whole": True}, ValueError, "a whole number >= 1, got 0"),
    ],
)
def test_message_names_setting_rule_and_value(value, rule, error, message):
    with pytest.raises(error, match=re.escape(f"`x` must be {message}")):
        check_number("x", value, **rule)
