"""Sister suspensions side by side: the odd one is told, healthy ones and common changes are not."""

import math

import numpy as np
import pytest

from suspnet.ground.parameters import Cause, Severity
from suspnet.maintenance.sisters import (
    CORRELATION,
    N_LAST,
    OF_MEAN,
    Sister,
    SisterSettings,
    sister_alarms,
)

GAP_KM = 2000.0
SETTINGS = SisterSettings()
Z = 1.645
SPREAD, QUIET = 0.001, 1e-6
"""Standard deviations of trips; the second, so small that words show no rounding."""


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


# reference


def test_variance_of_a_mean_is_that_of_simulated_trips():
    found = errors(np.random.default_rng(0), 20_000, N_LAST, CORRELATION).mean(axis=1)
    assert OF_MEAN == pytest.approx(found.var(), rel=0.05)


@pytest.mark.every_value
@pytest.mark.parametrize("n_sisters", [2, 3, 4])
@pytest.mark.parametrize("intervals", [True, False])
def test_false_alarms_are_at_most_those_stated(n_sisters, intervals):
    settings = SisterSettings(km_per_false_alarm=40_000.0, least_percent={"k_p": 0.0})
    n_cars, n_trips, n_alarms = 25, 100, {}
    for correlation in (0.0, 0.5):
        n_alarms[correlation] = 0
        for seed in range(n_cars):
            sisters = car([1.0] * n_sisters, n_trips, seed, correlation, intervals)
            n_alarms[correlation] += sum(map(len, sister_alarms("k_p", sisters, settings)))
    expected = n_cars * n_sisters * n_trips * GAP_KM / settings.km_per_false_alarm
    assert n_alarms[0.0] < n_alarms[0.5]
    assert 0.02 * expected < n_alarms[0.5] < 0.6 * expected  # the largest correlation allowed for


def test_uncertain_healthy_values_are_allowed_for():
    rng, settings = np.random.default_rng(1), SisterSettings(40_000.0, {"k_p": 0.0})
    counts = {}
    for known in (0.0, 0.01):
        counts[known] = 0
        for seed in range(20):
            offsets = np.exp(0.01 / Z * rng.normal(size=4))
            sisters = [
                Sister(one.mileage_km, one.values, one.half_widths, known)
                for one in car(offsets, seed=seed)
            ]
            counts[known] += sum(map(len, sister_alarms("k_p", sisters, settings)))
    assert counts[0.0] > 40
    assert counts[0.01] < 5


# property


@pytest.mark.parametrize("intervals", [True, False])
def test_the_odd_one_of_four_is_told_soon_after_its_step(intervals):
    sisters = car([1.0, after(0.959, 40), 1.0, 1.0], intervals=intervals)
    found = sister_alarms("k_p", sisters, SETTINGS)
    assert [len(one) for one in found] == [0, 1, 0, 0]
    (alarm,) = found[1]
    assert alarm.is_open
    assert (alarm.parameter, alarm.cause) == ("k_p", Cause.SISTER)
    assert alarm.severity == Severity.NOTICE
    assert 41 * GAP_KM <= alarm.begin_km <= (41 + N_LAST) * GAP_KM
    assert alarm.words.endswith("% below its sisters (median of 3)")


def test_of_three_the_odd_one_alone_is_told():
    found = sister_alarms("k_p", car([1.0, 1.0, after(1.05, 30)], spread=QUIET), SETTINGS)
    assert [len(one) for one in found] == [0, 0, 1]
    assert found[2][0].words == "k_p is 5.0 % above its sisters (median of 2)"


def test_of_a_pair_and_of_two_pairs_which_is_odd_is_not_known():
    pair = car([after(0.96, 30), 1.0], spread=QUIET)
    first, second = sister_alarms("k_p", pair, SETTINGS)
    assert first[0].words == (
        "k_p is 4.0 % below that of its one sister (96.0 and 100.0 % of healthy): which of them "
        "changed is not known"
    )
    assert second[0].words.startswith("k_p is 4.2 % above that of its one sister (100.0 and 96.0 %")
    step = after(0.96, 30)
    found = sister_alarms("k_p", car([step, 1.0, 1.0, step], spread=QUIET), SETTINGS)
    assert [len(one) for one in found] == [1, 1, 1, 1]
    assert "below 2 of its 3 sisters (96.0 and 100.0 % of healthy): which" in found[0][0].words


def test_what_comes_to_all_sisters_is_not_told():
    cold = 1 + 0.05 * np.sin(np.arange(60) / 8)
    assert sister_alarms("k_p", car([1.0] * 4, common=cold), SETTINGS) == [[]] * 4


def test_a_difference_below_the_least_is_not_told():
    sisters = car([1.0, 1.0, 1.0, after(0.985, 30)])
    assert sister_alarms("k_p", sisters, SETTINGS) == [[]] * 4
    closer = SisterSettings(least_percent={"k_p": 1.0})
    assert len(sister_alarms("k_p", sisters, closer)[3]) == 1


def test_an_alarm_ends_once_the_sisters_are_alike_again():
    step = np.where((np.arange(60) >= 20) & (np.arange(60) < 40), 0.95, 1.0)
    (alarm,) = sister_alarms("c_p", car([step * step, 1.0, 1.0, 1.0]), SETTINGS)[0]
    assert 41 * GAP_KM <= alarm.end_km <= (41 + N_LAST) * GAP_KM
    assert alarm.words.startswith("c_p is 9.")


def test_later_trips_do_not_change_earlier_alarms():
    step = np.where((np.arange(60) >= 12) & (np.arange(60) < 25), 0.95, 1.0)
    whole = car([1.0, 1.0, step, after(0.93, 50)])
    for n in (18, 30, 45, 60):
        part = [Sister(*(a[:n] for a in (s.mileage_km, s.values, s.half_widths))) for s in whole]
        found = sister_alarms("k_p", part, SETTINGS)[2]
        assert [a.begin_km for a in found] == [
            a.begin_km for a in sister_alarms("k_p", whole, SETTINGS)[2]
        ]


def test_trips_at_other_mileages_are_compared_and_old_ones_are_not():
    sisters = car([1.0, after(0.95, 30), 1.0])
    moved = [
        Sister(one.mileage_km + 300.0 * i, one.values, one.half_widths)
        for i, one in enumerate(sisters)
    ]
    assert [len(one) for one in sister_alarms("k_p", moved, SETTINGS)] == [0, 1, 0]
    ended = [Sister(s.mileage_km[:20], s.values[:20], s.half_widths[:20]) for s in sisters[::2]]
    assert sister_alarms("k_p", [ended[0], sisters[1], ended[1]], SETTINGS) == [[]] * 3


def test_missing_values_are_left_out_and_wide_intervals_tell_nothing():
    sisters = car([after(0.95, 30), 1.0, 1.0])
    gaps = sisters[0].values.copy()
    gaps[::3] = np.nan
    holed = Sister(sisters[0].mileage_km, gaps, sisters[0].half_widths)
    assert [len(one) for one in sister_alarms("k_p", [holed, *sisters[1:]], SETTINGS)] == [1, 0, 0]
    wide = Sister(sisters[0].mileage_km, sisters[0].values, np.full(60, 0.2))
    endless = Sister(sisters[0].mileage_km, sisters[0].values, np.full(60, np.inf))
    for unsure in (wide, endless):
        assert sister_alarms("k_p", [unsure, *sisters[1:]], SETTINGS) == [[]] * 3


@pytest.mark.parametrize("n", [0, 1, 2, 4])
def test_too_few_trips_or_sisters_raise_nothing(n):
    sisters = [Sister(s.mileage_km[:n], s.values[:n], s.half_widths[:n]) for s in car([1.0, 0.5])]
    assert sister_alarms("k_p", sisters, SETTINGS) == [[], []]
    assert sister_alarms("k_p", car([0.5]), SETTINGS) == [[]]
    assert sister_alarms("M_s", car([0.5, 1.0]), SETTINGS) == [[], []]


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
