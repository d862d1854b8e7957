"""Words: every combination of change, level, last trips and flags makes sense read aloud."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from suspnet.ground.findings import Finding, parts_of
from suspnet.ground.parameters import DEFAULT_LIMITS, Severity
from suspnet.trains.maintenance.alarms import watch
from suspnet.trains.maintenance.assessment import (
    ALL_FLAGGED,
    Evidence,
    ParameterTrend,
    assess,
    overall,
    spoken,
    step_words,
    worst_first,
)
from suspnet.trains.maintenance.change import Changes
from suspnet.trains.maintenance.judge import LastTrips, last_trips
from suspnet.trains.maintenance.series import make_series
from suspnet.trains.maintenance.state import State

LIMITS = DEFAULT_LIMITS["k_s"]
N_TRIPS = 40
KM = 1e4 * np.arange(1, N_TRIPS + 1)
FELL = Finding("fell", percent=3.5, km=3e5)
SHORT = Changes(n_reference=4, n_needed=20, why_not="4 of 20 trips")
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


def made_up(change, first, last, flagged=0):
    """Return what an assessment rests on; `change` is none, lasting, or not looked for yet."""
    lasting = FELL if change == "lasting" else ""
    median = float(np.median(last.values))
    numbers = (first, median, 100 * (median - first), 0.2, 5)
    trend = ParameterTrend("k_s", 30, *numbers, flagged_last=flagged, changed=bool(lasting))
    changes = SHORT if change == "short" else Changes(n_reference=30, n_needed=20)
    return Evidence(trend, last, LIMITS, lasting=lasting, changes=changes)


def ending(name, flags="none", half=0.01):
    values = np.array(ENDINGS[name])
    flagged = np.isin(np.arange(5), FLAGS[flags])
    low, high = values * np.exp(-half), values * np.exp(half)
    return LastTrips(values, low, high, flagged, flags == "all")


CHANGES = ("none", "lasting", "short")
COMBINATIONS = list(product(CHANGES, (1.0, 0.6), ENDINGS, FLAGS, (0.01, 0.3, np.nan)))


@pytest.mark.parametrize("change", CHANGES)
def test_no_combination_contradicts_itself(change):
    for _, first, name, flags, half in (c for c in COMBINATIONS[::3] if c[0] == change):
        last = ending(name, flags, half)
        found = assess(made_up(change, first, last, len(FLAGS[flags])))
        words = found.words
        case = (change, first, name, flags, half, found.severity, words)
        assert not words.startswith(("; ", ", ")), case
        assert not words.endswith(("; ", ":")), case
        assert not {"nan", "inf"} & set(words.split()), case
        if not LIMITS.notice[0] <= last.values[-1] <= LIMITS.notice[1]:
            assert found.severity > Severity.NONE, case
        if "above the" in words or "below the" in words:
            assert found.severity > Severity.NONE, case
            for calm in ("no change", "within its limits", "the newest not"):
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
    """Return the assessment of a series that scatters by 0.02 %."""
    values = np.array(values) * (1 + 2e-4 * np.random.default_rng(1).normal(size=len(values)))
    flags = np.isin(np.arange(len(values)), flagged)
    widths = {parameter: half + 0 * values}
    series = make_series(KM[: len(values)], {parameter: values}, widths, flags)
    limits = {name: DEFAULT_LIMITS[name] for name in (parameter,) if name in DEFAULT_LIMITS}
    found = State(series, limits, watch(series, limits)).assessments
    return next(one for one in found if one.parameter == parameter)


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
            *("notice", "alarm-since within-limits-words fell", {"km": 245e3}),
        ),
        (
            read(ends_with(1.5, 1.5, n=12)),
            *("act", f"{ACT} above-act-limit first-trips", {"run": 2, "limit": 125}),
        ),
        (read(ends_with(1.5, 1.5)), "act", f"{ACT} above-act-limit rose", {"run": 2, "km": 385e3}),
        (read([1.5]), "act", "last-trip-beyond above-act-limit", {"limit": 125}),
        (  # a fall that eight trips show beyond doubt is not one that they cannot show
            read([1, 1, 1, 1, 0.88, 0.755, 0.63, 0.51], parameter="c_s"),
            *("act", f"{ACT} below-act-limit first-trips", {"limit": 70, "n": 4, "percent": 100}),
        ),
        (
            read(ends_with(1.5, 1)),
            "act",
            "alarm-since was-beyond above-act-limit last-trip-level no-change some-beyond",
            {"n": 1, "n_last": 5, "km": 390e3},
        ),
        (read(ends_with(1.07)), "none", "no-change last-trip-at", {"percent": 107}),
        (
            read(np.where(KM[:12] < 75_000, 1, 0.99)),
            *("none", "within-limits-words fell", {"km": 75e3, "percent": 1.0}),
        ),
        (read(np.where(KM[:12] == 75_000, 0.99, 1)), "none", "too-few-to-find", {"n_trips": 12}),
        (read(ONES[:4]), "none", "too-few-to-find", {"n_trips": 4, "n_needed": 20}),
        (read(ends_with(3.0), flagged=[39]), "notice", f"flagged-trip {NOTICE}", {"limit": 110}),
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
            read(np.where(KM < 355_000, 1, 0.6), flagged=range(35, N_TRIPS)),
            *("act", f"inspect-first {ACT} below-act-limit not-clear flagged-last", {"n": 5}),
        ),
        (read(ONES, flagged=[0, 39]), "none", "no-change flagged-last", {"n": 1, "n_ends": 5}),
        (read(np.where(KM < 155_000, 1, 1.2), parameter="M_s"), *("none", "payload no-change", {})),
        (read([np.nan, np.nan]), "unknown", "", {}),
        (  # the odd flagged trips are left out
            read(
                np.where(np.isin(KM, [22e4, 39e4]), 1.9, 1 - 0.01 * (KM > 245e3)), flagged=[21, 38]
            ),
            *("notice", "alarm-since within-limits-words fell some-beyond flagged-last", {}),
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
    found = assess(replace(made_up("lasting", 1.0, ending("all_act")), limits=None))
    assert (found.severity, found.limited) == (Severity.NONE, False)
    assert found.words.startswith("fell by 3.5 % at about")
    assert overall([found])[1] == "No parameter has limits; 1 of 1 parameters changed:"


def test_step_is_the_best_split_by_students_t():
    """Every split by SciPy's test; half of the series have a step of three standard deviations."""
    rng, n_found = np.random.default_rng(7), 0
    for i in range(40):
        n = int(rng.integers(10, 20))
        values = 1 + 0.01 * rng.normal(size=n) + 0.03 * (i % 2) * (np.arange(n) >= n // 2)
        splits = {k: stats.ttest_ind(values[:k], values[k:]).pvalue for k in range(3, n - 2)}
        best = min(splits, key=splits.get)
        change = np.median(values[best:]) / np.median(values[:best]) - 1
        is_step = splits[best] * len(splits) < 0.01 and abs(change) > 0.01
        words = step_words(KM[:n], values, 0.5)
        assert bool(words) == is_step
        if words:
            n_found += 1
            assert words.kind == ("fell" if change < 0 else "rose")
            assert words.values["percent"] == pytest.approx(100 * abs(change))
            assert words.values["km"] == KM[best - 1 : best + 1].mean()
    assert 5 < n_found < 25
    assert step_words(KM[:9], np.repeat([1.0, 2.0], [4, 5]), 0.0) == ""


# the sentence on all parameters


def one(parameter, severity=Severity.NONE, change=0):
    named = replace(read(ONES), severity=severity, words="words", tested=change != 2)
    return replace(named, trend=replace(named.trend, parameter=parameter, changed=change == 1))


@pytest.mark.parametrize(
    ("severities", "changes", "sentence"),
    [
        ("0000", "0000", "Nothing stands out. No parameter is beyond its limits, and none changed"),
        ("0000", "0100", "No parameter is beyond its limits; 1 of 4 parameters changed:"),
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
def test_sentence_on_all_parameters(severities, changes, sentence):
    found = [
        one(name, Severity(int(s)), int(t))
        for name, s, t in zip(("k_p", "c_p", "k_s", "c_s"), severities, changes, strict=True)
    ]
    body_mass = one("M_s")
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
