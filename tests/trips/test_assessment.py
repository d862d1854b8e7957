"""Words: every combination of change, level, last trips and flags makes sense read aloud."""

import re
from dataclasses import replace
from itertools import cycle, product

import numpy as np
import pytest

from suspnet.ground.findings import Finding, parts_of
from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Severity
from suspnet.runs.language import speaking
from suspnet.runs.language import spoken as spoken_in_language
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.maintenance.assessment import (
    ALL_FLAGGED,
    assess,
    overall,
    spoken,
    worst_first,
)
from suspnet.trains.maintenance.judge import LastTrips, last_trips
from suspnet.trains.maintenance.series import make_series
from suspnet.trains.maintenance.trend import ParameterTrend, Shape, Step, flagged_trend

LIMITS = DEFAULT_LIMITS["k_s"]
N_TRIPS = 30
KM = 1e4 * np.arange(1, N_TRIPS + 1)
STEP = Step(155_000.0, 10_000.0, 15, -20.0, 1e-9, True)
HAS_STEP = (Shape.STEP, Shape.STEADY, Shape.GRADUAL, Shape.RETURNED)
ENDINGS = {
    "within": [1.0, 1.0, 1.0, 1.0, 1.0],
    "odd_before": [1.0, 1.0, 1.0, 1.5, 1.0],
    "newest_notice": [1.0, 1.0, 1.0, 1.0, 1.15],
    "newest_act": [1.0, 1.0, 1.0, 1.0, 1.5],
    "two_act": [1.0, 1.0, 1.0, 1.5, 1.5],
    "all_act": [0.6, 0.6, 0.6, 0.6, 0.6],
    "back": [1.5, 1.5, 1.5, 1.5, 1.0],
}
FLAGS = {"none": [], "newest": [4], "three": [2, 3, 4], "all": [0, 1, 2, 3, 4]}


def made_up(shape, first, last, **changes):
    """Return a trend of a shape; numbers that the shape does not need are plausible."""
    n = 4 if shape == Shape.TOO_FEW else N_TRIPS
    step = STEP if shape in HAS_STEP else None
    change = 100 * (last - first)
    options = {"shape": shape, "step": step, "n_ends": min(5, n // 2)} | changes
    return ParameterTrend("k_s", n, 10, first, last, change, 0.2, 0.5, **options)


def ending(name, flags="none", half=0.01):
    values = np.array(ENDINGS[name])
    flagged = np.isin(np.arange(5), FLAGS[flags])
    low, high = values * np.exp(-half), values * np.exp(half)
    return LastTrips(values, low, high, flagged, flags == "all")


COMBINATIONS = list(product(Shape, (1.0, 0.6), ENDINGS, FLAGS, (0.01, 0.3, np.nan)))


@pytest.mark.parametrize("shape", Shape)
def test_no_combination_contradicts_itself(shape):
    for _, first, name, flags, half in (c for c in COMBINATIONS[::3] if c[0] == shape):
        last = ending(name, flags, half)
        counts = {"flagged_last": len(FLAGS[flags]), "flagged_first": 5 * (flags == "all")}
        found = assess(made_up(shape, first, np.median(last.values), **counts), last, LIMITS)
        words = found.words
        case = (shape, first, name, flags, half, found.severity, words)
        assert not words.startswith(("; ", ", ")), case
        assert not words.endswith(("; ", ":")), case
        assert not {"nan", "inf"} & set(words.split()), case
        if not LIMITS.notice[0] <= last.values[-1] <= LIMITS.notice[1]:
            assert found.severity > Severity.NONE, case
        if "above the" in words or "below the" in words:
            assert found.severity > Severity.NONE, case
            for calm in ("no change", "within its limits", "ends as it began", "the newest not"):
                assert calm not in words, case
        elif flags != "all":
            assert found.severity == Severity.NONE, case
        if flags == "all":
            assert ALL_FLAGGED in words, case
            assert words.count("flagged") == 1, case
            assert found.severity >= Severity.UNKNOWN, case
        if found.severity == Severity.ACT:
            assert " act limit of " in words, case
        if found.severity == Severity.UNKNOWN:
            assert "within" not in words.replace("back within it", ""), case
            assert "too uncertain to judge" in words or flags == "all", case
        assert found.is_named == (found.severity > Severity.NONE or found.trend.changed), case


def read(values, half=0.01, flagged=(), parameter="k_s"):
    """Return the assessment of a series that is said to scatter by 0.1 %."""
    values = np.array(values) * (1 + 2e-4 * np.random.default_rng(1).normal(size=len(values)))
    km, flags = KM[: len(values)], np.isin(np.arange(len(values)), flagged)
    last = last_trips(
        make_series(km, {parameter: values}, {parameter: half + 0 * values}, flags), parameter
    )
    found = replace(flagged_trend(parameter, km, values, flags), spread_percent=0.1)
    return assess(found, last, DEFAULT_LIMITS.get(parameter))


ONES = np.ones(N_TRIPS)


def ends_with(*last, n=N_TRIPS):
    return np.append(np.ones(n - len(last)), last)


def parts(words):
    """Yield the findings that a text is made of, the outer ones first, without plain numbers."""
    for one in parts_of(words):
        if isinstance(one, Finding):
            if not one.kind.startswith(("level", "percent")):
                yield one
            for value in one.values.values():
                yield from parts(value) if isinstance(value, str) else ()


ACT = "last-trip-of-healthy last-trips-beyond"
NOTICE = "last-trip-beyond above-notice-limit too-few-lasting"


@pytest.mark.parametrize(
    ("found", "severity", "kinds", "numbers"),
    [
        (read(ONES), "none", "no-change", {}),
        (
            read(np.where(KM < 245_000, 1, 0.99)),
            *("none", "within-limits-words about falls", {"km": 240e3}),
        ),
        (
            read(ends_with(1.5, 1.5, n=12)),
            *("act", f"{ACT} above-act-limit too-few-lasting", {"run": 2, "limit": 125}),
        ),
        (
            read(ends_with(1.5, 1.5)),
            *("act", f"{ACT} above-act-limit change-began", {"run": 2, "km": 280e3}),
        ),
        (read([1.5]), "act", "last-trip-beyond above-act-limit", {"limit": 125}),
        (  # a fall that eight trips show beyond doubt is not one that they cannot show
            read([1, 1, 1, 1, 0.88, 0.755, 0.63, 0.51], parameter="c_s"),
            *("act", f"{ACT} below-act-limit first-trips", {"limit": 70, "n": 4, "percent": 100}),
        ),
        (
            read(ends_with(1.5, 1.5, 1.5, 1)),
            "act",
            "trips-level-beyond above-act-limit last-trip-level about rises-to",
            {"count": 3, "n_last": 5, "percent": 150, "km": 260e3},
        ),
        (read(ends_with(1.5, 1)), "none", "no-change some-beyond", {"n": 1, "n_last": 5}),
        (read(ends_with(1.07)), "none", "no-change last-trip-at", {"percent": 107}),
        (read(ONES[:4]), "none", "too-few-to-find", {"n_trips": 4, "n_needed": 10}),
        (read(ends_with(3.0), flagged=[29]), "notice", f"flagged-trip {NOTICE}", {"limit": 110}),
        (read(ends_with(1.3), half=np.nan), "notice", f"without-interval {NOTICE}", {}),
        (
            read(ends_with(1.3), half=0.4),
            *("unknown", "interval-reaches-back last-trip-beyond above-notice-limit", {}),
        ),
        (read(ONES, flagged=range(N_TRIPS)), "unknown", "not-judged", {}),
        (
            read(0.6 * ONES, flagged=range(N_TRIPS)),
            *("act", f"inspect-first {ACT} below-act-limit since-first-trips", {"run": 5}),
        ),
        (
            read(np.where(KM < 255_000, 1, 0.6), flagged=range(25, N_TRIPS)),
            "act",
            f"inspect-first {ACT} below-act-limit about falls-to flagged-last",
            {"n": 5, "n_ends": 5},
        ),
        (
            read(np.where(KM < 155_000, 1, 0.9), flagged=range(N_TRIPS), parameter="c_s"),
            *("unknown", "not-judged about falls-to", {"percent": 90, "km": 160e3}),
        ),
        (
            read(ONES, flagged=[0, 29]),
            *("none", "no-change flagged-both", {"n_first": 1, "n_last": 1}),
        ),
        (
            read(np.where(KM < 155_000, 1, 1.2), parameter="M_s"),
            *("none", "payload about rises-to", {"percent": 120}),
        ),
        (read([np.nan, np.nan]), "unknown", "", {}),
        (  # the odd flagged trips are left out
            read(
                np.where(np.isin(KM, [12e4, 29e4]), 1.9, 1 - 0.01 * (KM > 245e3)), flagged=[11, 28]
            ),
            *("none", "within-limits-words without-flagged about falls some-beyond", {}),
        ),
    ],
)
def test_reason_has_the_kinds_and_numbers_of_the_trips(found, severity, kinds, numbers):
    pieces = list(parts(found.words))
    assert (str(found.severity), " ".join(one.kind for one in pieces)) == (severity, kinds)
    values = {}
    for one in pieces:
        values |= one.values
    assert {name: values[name] for name in numbers} == pytest.approx(numbers, abs=0.05)


def test_parameter_without_limits_raises_no_alarm():
    found = assess(made_up(Shape.STEP, 1.0, 0.6), ending("all_act"), None)
    assert (found.severity, found.limited) == (Severity.NONE, False)
    assert found.words.startswith("falls to 60 % of healthy (median of the last 5 trips) at")
    assert overall([found])[1] == "No parameter has limits; 1 of 1 parameters changed:"


# the sentence on all parameters


def one(parameter, severity=Severity.NONE, shape=Shape.NONE):
    named = replace(read(ONES), severity=severity, words="words")
    step = STEP if shape == Shape.STEP else None
    return replace(named, trend=replace(named.trend, parameter=parameter, shape=shape, step=step))


@pytest.mark.parametrize(
    ("severities", "shapes", "sentence"),
    [
        ("0000", "0000", "Nothing stands out. No parameter is beyond its limits, and none changed"),
        ("0000", "0100", "No parameter is beyond its limits; 1 of 4 parameters changed:"),
        ("0000", "2000", "limits; some parameters have too few trips to find a change."),
        ("0000", "2222", "limits; there are too few trips to find a change."),
        ("0100", "1000", "No alarm, but 1 of 4 parameters cannot be judged:"),
        ("0120", "0000", "Notice: 1 of 4 parameters is to be looked at:"),
        ("2020", "0000", "Notice: 2 of 4 parameters are to be looked at:"),
        ("0300", "0000", "Act: 1 of 4 parameters is beyond the act limit:"),
        (
            "3302",
            "1111",
            "Act: 2 of 4 parameters are beyond the act limit, 1 more to be looked at:",
        ),
    ],
)
def test_sentence_on_all_parameters(severities, shapes, sentence):
    shape = (Shape.NONE, Shape.STEP, Shape.TOO_FEW)
    found = [
        one(name, Severity(int(s)), shape[int(t)])
        for name, s, t in zip(("k_p", "c_p", "k_s", "c_s"), severities, shapes, strict=True)
    ]
    body_mass = one("M_s", Severity.NONE, Shape.STEP)
    severity, words = overall([*found, body_mass])
    assert severity == int(max(severities))
    assert sentence in words
    told = worst_first([*found, body_mass])
    assert words.endswith(":") == bool(told)
    assert [a.severity for a in told] == sorted((a.severity for a in told), reverse=True)
    assert spoken(found).splitlines()[0] == words
    assert len(spoken(found).splitlines()) == 1 + len({a.severity for a in told})


def test_last_trips_are_those_of_largest_mileage_with_an_estimate():
    km = np.array([5.0, 1.0, 3.0, np.nan, 2.0, 6.0, 4.0, 7.0])
    values = np.array([0.5, 0.1, 0.3, 9.0, 0.2, 0.6, 0.4, np.nan])

    def last_of(values, flagged):
        return last_trips(make_series(km, {"k_s": values}, {"k_s": 0.01 + 0 * km}, flagged), "k_s")

    last = last_of(values, km == 3.0)
    np.testing.assert_array_equal(last.values, [0.2, 0.3, 0.4, 0.5, 0.6])
    np.testing.assert_allclose(np.log(last.high / last.low), 0.02)
    np.testing.assert_array_equal(last.flagged, [False, True, False, False, False])
    assert not last.all_flagged
    assert last_of(values, np.ones(8)).all_flagged
    assert not last_of(np.nan * values, np.ones(8)).all_flagged


ENGLISH = re.compile(
    r"\b(the|trips?|of|is|are|with|within|healthy|limits?|and|but|by|to|not|flagged|change|no|it)\b"
)


@pytest.mark.slow
def test_no_reason_keeps_an_english_word_in_german():
    """Of every reason, with alarms and doubts, and of the sentence on all parameters."""
    alarms = [
        Alarm("k_s", Cause.LIMIT, Severity.ACT, 5e4, np.nan, Finding("was-beyond", km=12e3, level=
        Finding("over-percent-of", percent=1e3), beyond=Finding("below-act-limit", limit=70.0))),
        Alarm("k_s", Cause.CHANGE, Severity.NOTICE, 5e4, np.nan, Finding("change-goes-on",
        change=Finding("fell", percent=3.5, km=12e3), percent=6.0, n_last=5)),
    ]  # fmt: skip
    reasons = set()
    for (shape, first, name, flags, half), n in zip(
        COMBINATIONS[::3], cycle(range(4)), strict=False
    ):
        last = ending(name, flags, half)
        counts = {"flagged_last": len(FLAGS[flags]), "flagged_first": n, "without_flagged": n == 1}
        doubt = Finding("all-last-flagged", n=5) if n == 2 else ""
        found = made_up(shape, first, np.median(last.values), **counts)
        for limits in (LIMITS, None):
            one = assess(found, last, limits, alarms[:n] if n < 3 else alarms[1:], doubt)
            reasons |= {one.words, overall([one])[1], overall([one, one])[1]}
    assert len(reasons) > 200
    with speaking("de"):
        left = {words: spoken_in_language(words) for words in reasons}
    assert {english: said for english, said in left.items() if ENGLISH.search(said)} == {}
