"""Trends: steps and fades are found, what does not change stays quiet, odd data do not fail."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from suspnet.trains.maintenance.trend import LEVEL, Shape, flagged_trend, steps, trend

N_TRIPS = 30
MILEAGE_KM = 10_000.0 * np.arange(1, N_TRIPS + 1)


def series(change, spread, seed):
    return 1 + change + spread * np.random.default_rng(seed).normal(size=np.shape(change))


def best_split(values, min_size=3):
    """Return the trips before the best step, and its corrected p value, by trying all splits."""
    splits = range(min_size, len(values) - min_size + 1)
    squares = [
        np.sum((values[:n] - values[:n].mean()) ** 2)
        + np.sum((values[n:] - values[n:].mean()) ** 2)
        for n in splits
    ]
    best = splits[int(np.argmin(squares))]
    test = stats.ttest_ind(values[:best], values[best:], equal_var=True)
    return best, min(1.0, test.pvalue * len(splits))


@pytest.mark.parametrize("seed", range(5))
def test_steps_and_trend_agree_with_trying_every_split(seed):
    values = series(np.where(MILEAGE_KM < 95_000, 0.0, 0.003), 0.002, seed)
    step = steps(MILEAGE_KM, values)
    n_before, p_value = best_split(values)
    assert step.n_before == n_before
    assert step.p_value == pytest.approx(p_value, rel=1e-6)
    assert step.mileage_km == MILEAGE_KM[n_before - 1] + 5_000
    assert step.size_percent == pytest.approx(
        100 * (np.median(values[n_before:]) - np.median(values[:n_before]))
    )
    # the p value is the smaller of both tests, corrected for two
    ends = stats.ttest_ind(values[:5], values[-5:], equal_var=False).pvalue
    expected = min(1.0, 2 * min(ends, p_value))
    assert trend("k_p", MILEAGE_KM, values).p_value == pytest.approx(expected, rel=1e-6)


def test_spread_is_the_standard_deviation_about_a_step_and_a_drift():
    n = 4000
    change = np.where(np.arange(n) < 1500, 0.0, 0.3) - 0.2 * np.arange(n) / n
    found = trend("k_p", np.arange(n), series(change, 0.002, 0))
    assert found.spread_percent == pytest.approx(0.2, rel=0.06)  # three standard errors


@pytest.mark.parametrize("heavy_tails", [False, True])
def test_what_does_not_change_changed_in_at_most_one_of_a_hundred(heavy_tails):
    rng = np.random.default_rng(7)
    noise = rng.standard_t(3, size=(800, 30)) if heavy_tails else rng.normal(size=(800, 10))
    found = [trend("k_p", np.arange(len(row)), 1 + 0.002 * row) for row in noise]
    three_errors = 3 * math.sqrt(LEVEL * (1 - LEVEL) / len(found))
    assert np.mean([t.changed for t in found]) <= LEVEL + three_errors
    assert np.mean([t.p_value < 0.1 for t in found]) > 0.01  # the tests are not merely dead


@pytest.mark.parametrize(
    ("change", "spread", "step_km"),
    [
        (np.where(MILEAGE_KM < 255_000, 0.0, -0.01), 0.001, 255_000),
        (np.where(MILEAGE_KM < 275_000, 0.0, -0.02), 0.002, 275_000),
        (-0.02 * np.clip((np.arange(N_TRIPS) - 19) / 10, 0, 1), 0.002, None),
    ],
    ids=["one percent", "three trips ago", "slow fade"],
)
def test_change_is_found_where_it_is(change, spread, step_km):
    for seed in range(20):
        found = trend("k_p", MILEAGE_KM, series(change, spread, seed))
        assert found.changed
        if step_km:
            assert found.step.mileage_km == pytest.approx(step_km, abs=10_000)
        if spread == 0.001:
            assert found.change_percent == pytest.approx(-1.0, abs=0.25)
            assert found.shape == Shape.STEP


@pytest.mark.parametrize(
    ("change", "shape"),
    [
        (np.where(MILEAGE_KM < 155_000, 0, -0.4), Shape.STEP),
        (np.where(MILEAGE_KM < 155_000, 0, 0.05), Shape.STEP),
        (-0.05 * MILEAGE_KM / 3e5, Shape.STEADY),
        (-0.4 * np.clip(MILEAGE_KM / 1e5 - 2, 0, 1), Shape.GRADUAL),
        (0 * MILEAGE_KM, Shape.NONE),
        (0 * MILEAGE_KM - 0.4, Shape.NONE),
    ],
)
def test_shape_is_that_of_the_series(change, shape):
    assert trend("k_p", MILEAGE_KM, series(change, 0.0003, 3)).shape == shape


def test_a_rise_and_fall_that_ends_as_it_began_is_told_from_a_change():
    values = series(np.where((np.arange(40) >= 10) & (np.arange(40) < 35), 0.05, 0.0), 0.001, 0)
    found = trend("k_p", np.arange(40) * 1e4, values)
    assert found.changed
    assert found.shape == Shape.RETURNED
    assert abs(found.change_percent) < 0.5


@pytest.mark.parametrize("position", [0, 15, 29])
def test_one_odd_trip_is_no_change(position):
    values = series(np.zeros(N_TRIPS), 0.002, 1)
    values[position] = 5.0
    assert not trend("k_p", MILEAGE_KM, values).changed


def test_body_mass_never_changed():
    found = trend("M_s", MILEAGE_KM, series(np.where(MILEAGE_KM < 155_000, 0.0, 0.2), 0.002, 0))
    assert (found.changed, found.shape) == (False, Shape.STEP)


@settings(max_examples=10)
@given(
    st.lists(st.sampled_from([0.9, 1.0, 1.001, 1.3, math.nan, math.inf]), max_size=40),
    st.integers(0, 2**16),
)
def test_any_series_gives_a_verdict_whatever_its_order(values, seed):
    mileage_km = 1e4 * np.arange(len(values))
    order = np.random.default_rng(seed).permutation(len(values))
    found = trend("k_p", mileage_km, values)
    shuffled = trend("k_p", mileage_km[order], np.array(values, dtype=float)[order])
    assert repr(found) == repr(shuffled)  # NaN equals NaN
    assert found.shape in Shape
    assert found.n_trips == np.isfinite(values).sum()


@given(st.lists(st.integers(0, N_TRIPS), max_size=10))
def test_trips_without_estimate_or_mileage_change_nothing(positions):
    values = series(np.where(MILEAGE_KM < 155_000, 0.0, -0.02), 0.002, 0)
    with_gaps = np.insert(values, positions, np.nan)
    mileage_km = np.insert(MILEAGE_KM, positions, 1.0)
    unplaced = np.insert(values, positions, 7.0)
    unknown_km = np.insert(MILEAGE_KM, positions, np.nan)
    expected = trend("k_p", MILEAGE_KM, values)
    assert trend("k_p", mileage_km, with_gaps) == expected
    assert trend("k_p", unknown_km, unplaced) == expected


@pytest.mark.parametrize("n_trips", [0, 1, 2, 9])
def test_too_few_trips_say_so(n_trips):
    found = trend("k_p", np.arange(n_trips), np.ones(n_trips))
    assert found.shape == Shape.TOO_FEW
    assert (found.n_trips, found.n_needed) == (n_trips, 10)
    assert not found.changed
    assert math.isnan(found.p_value)
    assert math.isnan(found.first_median) == (n_trips < 2)


def test_estimates_without_any_spread_are_compared():
    constant = trend("k_p", MILEAGE_KM, np.ones(N_TRIPS))
    assert (constant.changed, constant.p_value, constant.spread_percent) == (False, 1.0, 0.0)
    assert steps(MILEAGE_KM, np.ones(N_TRIPS)).p_value == 1.0
    halved = trend("k_p", MILEAGE_KM, np.where(MILEAGE_KM < 155_000, 1.0, 0.5))
    assert (halved.changed, halved.p_value) == (True, 0.0)
    rounding = trend("k_p", MILEAGE_KM, 1 + 1e-15 * (MILEAGE_KM > 155_000))
    assert not rounding.changed


def test_series_without_room_for_a_step():
    at_one_mileage = np.full(N_TRIPS, 5e4)
    assert not trend("k_p", at_one_mileage, series(np.zeros(N_TRIPS), 0.002, 0)).changed
    assert steps(np.arange(5), np.ones(5)) is None
    assert steps(np.arange(6), np.arange(6)).n_before == 3


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match=r"one number for each trip, got shapes \(3,\) and \(2,\)"):
        trend("k_p", [1, 2, 3], [1, 1])


# flagged trips


def flags(*places):
    return np.isin(np.arange(N_TRIPS), places)


def test_flagged_trips_count_and_the_verdict_says_so():
    """A damper that fades below the range trained for must not vanish from the trend."""
    values = series(-0.7 * np.clip((np.arange(N_TRIPS) - 15) / 14, 0, 1), 0.002, 0)
    whole = trend("c_s", MILEAGE_KM, values)
    found = flagged_trend("c_s", MILEAGE_KM, values, flags(26, 27, 28, 29))
    assert found.last_median == whole.last_median < 0.5
    assert found.changed
    assert (found.n_ends, found.flagged_first, found.flagged_last) == (5, 0, 4)


@pytest.mark.parametrize(
    ("places", "counts"),
    [((), (0, 0)), ((12, 15), (0, 0)), ((0,), (1, 0)), ((0, 29), (1, 1)), (range(30), (5, 5))],
)
def test_flagged_trips_at_the_ends_are_counted(places, counts):
    values = series(np.zeros(N_TRIPS), 0.002, 1)
    found = flagged_trend("k_p", MILEAGE_KM, values, flags(*places))
    assert (found.flagged_first, found.flagged_last) == counts
    assert replace(found, flagged_first=0, flagged_last=0) == trend("k_p", MILEAGE_KM, values)


def test_trips_without_an_estimate_are_not_among_the_ends():
    values = series(np.zeros(N_TRIPS), 0.002, 1)
    values[27:] = np.nan
    found = flagged_trend("k_p", MILEAGE_KM[::-1], values[::-1], flags(2, 7)[::-1])
    assert (found.flagged_first, found.flagged_last) == (1, 0)
    few = flagged_trend("k_p", MILEAGE_KM[:4], values[:4], flags(2)[:4])
    assert (few.n_ends, few.flagged_first, few.flagged_last) == (2, 0, 1)


def test_odd_flagged_trips_do_not_hide_a_change_of_the_others():
    values = series(np.where(MILEAGE_KM < 245_000, 0, -0.01), 0.001, 2)
    values[[11, 28]] = 0.27, 1.9
    assert not trend("k_p", MILEAGE_KM, values).changed
    found = flagged_trend("k_p", MILEAGE_KM, values, flags(11, 28))
    assert found.changed
    assert found.n_trips == N_TRIPS - 2
    assert (found.shape, found.without_flagged) == (Shape.STEP, True)
    assert found.change_percent == pytest.approx(-1.1, abs=0.05)
    assert not flagged_trend("k_p", MILEAGE_KM, values, flags(3)).changed


FADE = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.62, 0.55)


@pytest.mark.parametrize(
    ("last", "shape"),
    [(FADE, Shape.GRADUAL), (FADE[:6], Shape.GRADUAL), ((0.6,) * 4, Shape.STEP)],
)
def test_a_fade_that_began_lately_is_no_step(last, shape):
    change = np.concatenate([np.zeros(8), np.array(last) - 1])
    for seed in range(20):
        values = series(change, 0.005, seed)
        assert trend("c_p", 1900.0 * np.arange(len(values)), values).shape == shape
