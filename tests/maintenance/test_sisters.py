"""Sister suspensions side by side: the odd one has an alarm, common changes have none."""

import math
from dataclasses import replace

import numpy as np
import pytest
from trip_records import HALF_WIDTHS, trip

from suspnet.ground.parameters import Cause, Severity
from suspnet.ground.records import Place
from suspnet.trains.maintenance.series import N_LAST, Event, of_same_car, series_of
from suspnet.trains.maintenance.sisters import (
    CORRELATION,
    OF_MEAN,
    Sister,
    SisterSettings,
    alarms_of_sisters,
    sister_alarms,
)

GAP_KM = 2000.0
SETTINGS = SisterSettings()
Z = 1.645
SPREAD, QUIET = 0.001, 1e-6
"""Standard deviations of trips; the second, so small that words show no rounding."""
CORNERS = [
    Place("x", bogie, side) for bogie in ("leading", "trailing") for side in ("left", "right")
]


def errors(rng, n_sisters, n_trips, correlation):
    """Return normal errors of variance 1, correlated from trip to trip."""
    found = rng.normal(size=(n_sisters, n_trips))
    for k in range(1, n_trips):
        step = math.sqrt(1 - correlation**2) * found[:, k]
        found[:, k] = correlation * found[:, k - 1] + step
    return found


def car(changes, n_trips=60, seed=0, correlation=0.3, intervals=True, common=1.0, spread=SPREAD):
    """Return sisters whose values change by a factor (a number, or one for each trip)."""
    logs = spread * errors(np.random.default_rng(seed), len(changes), n_trips, correlation)
    km = GAP_KM * np.arange(1, n_trips + 1)
    halves = np.full(n_trips, Z * spread if intervals else np.nan)
    return [
        Sister(km, np.exp(one) * change * common, halves)
        for one, change in zip(logs, changes, strict=True)
    ]


def after(factor, k, n_trips=60):
    """Return a step at the k-th trip."""
    return np.where(np.arange(n_trips) < k, 1.0, factor)


def first(sister, n):
    return Sister(sister.mileage_km[:n], sister.values[:n], sister.half_widths[:n])


def counts(sisters, settings=SETTINGS):
    return [len(own) for own in sister_alarms("k_p", sisters, settings)]


# reference


def test_variance_of_a_mean_is_that_of_simulated_trips():
    found = errors(np.random.default_rng(0), 20_000, N_LAST, CORRELATION).mean(axis=1)
    assert pytest.approx(found.var(), rel=0.05) == OF_MEAN


@pytest.mark.every_value
@pytest.mark.parametrize("n_sisters", [2, 3, 4])
@pytest.mark.parametrize("intervals", [True, False])
def test_false_alarms_are_at_most_those_stated(n_sisters, intervals):
    settings = SisterSettings(km_per_false_alarm=40_000.0, least_percent={"k_p": 0.0})
    n_cars, n_trips, n_alarms = 25, 100, {}
    for correlation in (0.0, 0.5):
        cars = (
            car([1.0] * n_sisters, n_trips, seed, correlation, intervals) for seed in range(n_cars)
        )
        n_alarms[correlation] = sum(sum(counts(sisters, settings)) for sisters in cars)
    expected = n_cars * n_sisters * n_trips * GAP_KM / settings.km_per_false_alarm
    assert n_alarms[0.0] < n_alarms[0.5]
    assert 0.02 * expected < n_alarms[0.5] < 0.6 * expected  # the largest correlation allowed for


# property


@pytest.mark.parametrize("intervals", [True, False])
def test_the_odd_one_of_four_has_an_alarm_soon_after_its_step(intervals):
    sisters = car([1.0, after(0.959, 40), 1.0, 1.0], intervals=intervals)
    alarms = sister_alarms("k_p", sisters, SETTINGS)
    assert [len(one) for one in alarms] == [0, 1, 0, 0]
    (alarm,) = alarms[1]
    assert (alarm.parameter, alarm.cause, alarm.is_open) == ("k_p", Cause.SISTER, True)
    assert alarm.severity == Severity.NOTICE
    assert 41 * GAP_KM <= alarm.begin_km <= (41 + N_LAST) * GAP_KM
    assert (alarm.words.kind, alarm.words.values["n"]) == ("sister-below", 3)


@pytest.mark.parametrize(
    ("changes", "n_alarms", "kind", "numbers"),
    [
        ([after(1.05, 30), 1.0, 1.0], [1, 0, 0], "sister-above", [5.0, 105.0, 100.0, 2, 2]),
        # of a pair and of two pairs, which is odd is not known
        ([after(0.96, 30), 1.0], [1, 1], "sister-below-one", [4.0, 96.0, 100.0, 1, 1]),
        (
            [after(0.96, 30), 1.0, 1.0, after(0.96, 30)],
            [1, 1, 1, 1],
            "sister-below-some",
            [4.0, 96.0, 100.0, 2, 3],
        ),
    ],
)
def test_words_say_how_far_a_suspension_is_from_how_many_sisters(changes, n_alarms, kind, numbers):
    alarms = sister_alarms("k_p", car(changes, spread=QUIET), SETTINGS)
    assert [len(one) for one in alarms] == n_alarms
    words = alarms[0][0].words
    assert (words.kind, words.values["part"]) == (kind, "k_p")
    names = ("percent", "own", "other", "n_apart", "n")
    assert [words.values[name] for name in names] == pytest.approx(numbers, abs=0.01)


def test_common_and_small_differences_raise_nothing():
    cold = 1 + 0.05 * np.sin(np.arange(60) / 8)
    assert counts(car([1.0] * 4, common=cold)) == [0] * 4
    sisters = car([1.0, 1.0, 1.0, after(0.985, 30)])
    assert counts(sisters) == [0] * 4
    assert counts(sisters, SisterSettings(least_percent={"k_p": 1.0}))[3] == 1


def test_an_alarm_ends_once_the_sisters_are_alike_again_and_later_trips_do_not_change_it():
    step = np.where((np.arange(60) >= 20) & (np.arange(60) < 40), 0.95, 1.0)
    (alarm,) = sister_alarms("c_p", car([step * step, 1.0, 1.0, 1.0]), SETTINGS)[0]
    assert 41 * GAP_KM <= alarm.end_km <= (41 + N_LAST) * GAP_KM
    assert alarm.words.values["percent"] == pytest.approx(9.75, abs=0.3)
    whole = car([1.0, 1.0, step, after(0.93, 50)])
    begins = [a.begin_km for a in sister_alarms("k_p", whole, SETTINGS)[2]]
    for n in (18, 30, 45):
        early = [
            a.begin_km for a in sister_alarms("k_p", [first(s, n) for s in whole], SETTINGS)[2]
        ]
        assert early == [km for km in begins if km <= n * GAP_KM]


def test_trips_at_other_mileages_are_compared_and_old_ones_are_not():
    sisters = car([1.0, after(0.95, 30), 1.0])
    moved = [replace(s, mileage_km=s.mileage_km + 300.0 * i) for i, s in enumerate(sisters)]
    assert counts(moved) == [0, 1, 0]
    assert counts([first(sisters[0], 20), sisters[1], first(sisters[2], 20)]) == [0] * 3


def test_missing_values_are_left_out_and_wide_intervals_decide_nothing():
    sisters = car([after(0.95, 30), 1.0, 1.0])
    gaps = sisters[0].values.copy()
    gaps[::3] = np.nan
    assert counts([replace(sisters[0], values=gaps), *sisters[1:]]) == [1, 0, 0]
    for half_width in (0.2, np.inf):
        unsure = replace(sisters[0], half_widths=np.full(60, half_width))
        assert counts([unsure, *sisters[1:]]) == [0] * 3


@pytest.mark.parametrize("n", [0, 1, 2, 4])
def test_too_few_trips_or_sisters_raise_nothing(n):
    assert counts([first(s, n) for s in car([1.0, 0.5])]) == [0, 0]
    assert counts(car([0.5])) == [0]
    assert sister_alarms("M_s", car([0.5, 1.0]), SETTINGS) == [[], []]


# suspensions of a car


@pytest.fixture(scope="module")
def series():
    """Four suspensions of a car; k_s of the last is 8 % low from the 15th trip on."""
    several = []
    for i, place in enumerate(CORNERS):
        changes = [{"k_s": 0.92 if i == 3 and n >= 15 else 1.0} for n in range(30)]
        made = [
            trip(100 * i + n, change, with_curves=False, place=place, half_widths=HALF_WIDTHS)
            for n, change in enumerate(changes)
        ]
        several.append(
            series_of([replace(r, mileage_km=2e3 * (n + 1)) for n, r in enumerate(made)])
        )
    return several


def test_suspensions_of_a_car_are_together(series):
    named = [replace(one, place=replace(one.place, car="7")) for one in series]
    moved = replace(named[0], place=replace(named[0].place, suspension="y"))
    other = replace(series[0], place=replace(series[0].place, suspension="z"))
    assert [len(one) for one in of_same_car([*series, *named, moved, other])] == [4, 5]


def test_the_odd_suspension_of_a_car_has_an_alarm_from_its_usable_trips(series):
    alarms = alarms_of_sisters(series, SETTINGS)
    assert list(alarms) == [("AM96 217", CORNERS[3])]
    (alarm,) = alarms["AM96 217", CORNERS[3]]
    assert (alarm.parameter, alarm.is_open, alarm.words.kind) == ("k_s", True, "sister-below")
    assert 15 * 2000 < alarm.begin_km <= 21 * 2000
    # neither flagged trips nor those before maintenance count
    late = [replace(one, events=(Event(59_000.0, "exchanged"),)) for one in series]
    assert alarms_of_sisters([*series[:3], late[3]], SETTINGS) == {}
    doubtful = replace(series[3], flagged=np.ones(30, dtype=bool))
    assert alarms_of_sisters([*series[:3], doubtful], SETTINGS) == {}


# failure


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"km_per_false_alarm": 0}, "`km_per_false_alarm` must be"),
        ({"max_apart_km": -1.0}, "`max_apart_km` must be"),
        ({"level": 1.0}, "`level` must be"),
        ({"least_percent": {"k_p": 100}}, r"`least_percent\.k_p` must be"),
    ],
)
def test_wrong_settings_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        SisterSettings(**fields)
