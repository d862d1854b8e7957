"""Settings as declared: each class refuses what lies outside of a range, and says the range."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import pytest

from suspnet.cli.kinds import KINDS, class_of
from suspnet.ground.settings import Setting, check_settings, check_values, setting, settings_of
from suspnet.simulation.signals import Sensor
from suspnet.spectra.components import CurveFeatures
from suspnet.spectra.extraction import PeakFeatures

CLASSES = [
    *(class_of(place, kind) for place, kinds in KINDS.items() for kind in kinds if kind != "best"),
    *(Sensor, CurveFeatures, PeakFeatures),
]
NUMBERS = [
    pytest.param(one, id=f"{class_.__name__}-{one.name}")
    for class_ in CLASSES
    for one in settings_of(class_).values()
    if one.type in (int, float)
]


@pytest.mark.parametrize("one", NUMBERS)
def test_number_is_checked_at_both_ends_of_its_range(one):
    whole = one.type is int
    step = 1 if whole else 1e-6
    given = one.setting
    high = given.most if given.high is None else given.high
    for low, is_in in ((given.low, True), (given.above, False)):
        if low is not None:
            beyond = one.type(low - step * max(1, abs(low))) if is_in else low
            with pytest.raises(ValueError, match=f"`x` must be .*, got {beyond}"):
                one.check("x", beyond)
            one.check("x", one.type(low) if is_in else one.type(low + step * max(1, abs(low))))
    for top, is_in in ((high, True), (given.below, False)):
        if top is not None:
            beyond = one.type(top + step * max(1, abs(top))) if is_in else top
            with pytest.raises(ValueError, match=f"`x` must be .*, got {beyond}"):
                one.check("x", beyond)
            one.check("x", one.type(top) if is_in else one.type(top - step * max(1, abs(top))))


@pytest.mark.parametrize("one", NUMBERS)
def test_what_is_no_such_number_is_refused(one):
    for wrong in (math.nan, math.inf, 1e30, "7", True, [1.0], *([1.5] if one.type is int else [])):
        with pytest.raises((TypeError, ValueError), match="`x` must be"):
            one.check("x", wrong)
    if one.is_optional:
        one.check("x", None)
    else:
        with pytest.raises(TypeError, match=r"`x` must be .*, got None"):
            one.check("x", None)


@pytest.mark.parametrize("class_", CLASSES, ids=lambda one: one.__name__)
def test_choices_and_switches_take_nothing_else(class_):
    for one in settings_of(class_).values():
        for value in one.choices or ((True, False) if one.type is bool else ()):
            one.check("x", value)
        if one.choices or one.type is bool:
            for wrong in ("nonsense", 0, 1.5):
                with pytest.raises((TypeError, ValueError), match="`x` must be"):
                    one.check("x", wrong)


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
    assert [one.text for one in settings_of(Trip).values()] == [
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


def test_other_classes_declare_their_arguments_in_a_mapping():
    class Source:
        settings: ClassVar = {"poll_s": Setting("Time between two looks", "s", low=0.01, high=60)}

        def __init__(self, poll_s: float = 0.5) -> None:
            check_values(Source, poll_s=poll_s)

    assert settings_of(Source)["poll_s"].text == "Time between two looks [s; 0.01 to 60]"
    with pytest.raises(ValueError, match="`poll_s` must be"):
        Source(0.0)
