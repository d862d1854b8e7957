"""Forward against reverse: the error that both directions show, and the intervals that hold it."""

from dataclasses import replace

import numpy as np
import pytest
from trip_records import trip

from suspnet.ground.records import Place, by_mileage
from suspnet.trains.history import History
from suspnet.trains.maintenance.directions import MOST, Z, direction_errors, opposite_pairs
from suspnet.trains.maintenance.series import Event, make_series, series_of, with_widened

NOISE = 0.007


def both_ways(n, bias=0.0, seed=0, noise=NOISE, **others):
    """Return the trips of a healthy suspension, every second one in reverse."""
    signs = np.where(np.arange(n) % 2, -1.0, 1.0)
    logs = noise * np.random.default_rng(seed).normal(size=n) + bias * signs / 2
    half = np.full(n, Z * noise)
    given = {"direction": signs} | others
    return make_series(1e3 * np.arange(n), {"c_s": np.exp(logs)}, {"c_s": half}, **given)


def held(series):
    return np.abs(np.log(series.estimates["c_s"])) <= series.half_widths["c_s"]


# reference


def test_errors_are_those_of_the_formula_evaluated_naively():
    rng = np.random.default_rng(1)
    n = 25
    signs, states = rng.choice([-1, 0, 1], n), np.sort(rng.integers(0, 3, n))
    logs, half = 0.02 * rng.normal(size=n), rng.uniform(0.01, 0.03, n)
    logs[12] += 0.4  # further than `MOST` allows
    pairs = opposite_pairs(signs, states)
    found = direction_errors(pairs, signs, np.exp(logs), half)
    clipped = 0
    for i in range(n):
        done = [(a, b) for a, b in pairs.tolist() if b <= i]
        if len(done) < 3:
            assert found[i] == 0
            continue
        h = [np.hypot(half[a], half[b]) for a, b in done]
        raw = [signs[a] * (logs[a] - logs[b]) for a, b in done]
        d = [max(-MOST * s, min(MOST * s, x)) for x, s in zip(raw, h, strict=True)]
        clipped += raw != d
        w = [1 / s**2 for s in h]
        m = sum(x * y for x, y in zip(w, d, strict=True)) / sum(w)
        v = sum(x * (y - m) ** 2 for x, y in zip(w, d, strict=True)) / ((len(d) - 1) * sum(w))
        assert found[i] == pytest.approx(np.sqrt(max(m**2 - v, 0)) / 2, rel=1e-9, abs=1e-12)
    assert clipped
    assert found.max() > 0


def test_pairs_are_neighbours_of_one_state_and_no_trip_is_in_two():
    signs = np.array([1, 1, -1, 1, 0, -1, -1, 1, -1])
    states = np.array([0, 0, 0, 0, 0, 0, 0, 1, 1])
    assert opposite_pairs(signs, states).tolist() == [[1, 2], [3, 5], [7, 8]]
    assert opposite_pairs(np.ones(5, dtype=int), np.zeros(5, dtype=int)).shape == (0, 2)


# limit


@pytest.mark.parametrize("noise", [0.003, 0.007, 0.02])
def test_a_bias_of_the_directions_is_found_and_the_intervals_hold(noise):
    series = [both_ways(30, 0.02, seed, noise) for seed in range(200)]
    late = np.arange(30) >= 8
    before = np.mean([held(one)[late] for one in series])
    after = [one.widened() for one in series]
    assert before < 0.87
    assert np.mean([held(one)[late] for one in after]) > 0.88
    errors = [np.sqrt(one.half_widths["c_s"][-1] ** 2 / Z**2 - noise**2) for one in after]
    assert np.median(errors) == pytest.approx(0.01, rel=0.2)


# property


def test_a_fault_between_two_trips_is_no_error_of_the_model():
    whole = both_ways(40)
    worn = np.where(np.arange(40) >= 21, 0.7, 1.0)  # in the middle of a pair
    changed = replace(whole, estimates=whole.estimates | {"c_s": worn * whole.estimates["c_s"]})
    ratio = changed.widened().half_widths["c_s"] / whole.half_widths["c_s"]
    assert ratio.max() < 1.05


def test_each_commissioning_has_its_own_error_and_maintenance_parts_pairs():
    whole = both_ways(40, 0.02)
    since = np.where(np.arange(40) < 20, 0.0, 2e4)
    own = replace(whole, healthy_since_km=since).widened().half_widths["c_s"]
    plain = whole.half_widths["c_s"]
    np.testing.assert_array_equal(own[20:25], plain[20:25])
    assert (own[[19, 39]] > plain[[19, 39]]).all()
    # an exchange between any two trips leaves no pair
    events = tuple(Event(1e3 * i - 500.0, "exchanged") for i in range(1, 40))
    np.testing.assert_array_equal(replace(whole, events=events).widened().half_widths["c_s"], plain)


@pytest.mark.parametrize("others", [{"flagged": True}, {"direction": np.nan}, {"direction": 1.0}])
def test_flagged_trips_and_one_direction_show_nothing(others):
    whole = both_ways(30, 0.02, **others)
    np.testing.assert_array_equal(whole.widened().half_widths["c_s"], whole.half_widths["c_s"])


def test_results_series_and_history_have_the_same_intervals(tmp_path):
    place, results = Place("x"), []
    for i in range(14):
        one = trip(i, place=place, with_curves=False, half_widths={"c_s": 0.01})
        c_s = np.exp(0.01 * (-1) ** i + 0.001 * np.sin(i))
        quality = replace(one.quality, direction=("forward", "reverse")[i % 2])
        results.append(replace(one, estimates=one.estimates | {"c_s": c_s}, quality=quality))
    series = series_of(results)
    assert (series.half_widths["c_s"][6:] > 0.015).all()
    found = by_mileage(with_widened(results[::-1], []))
    assert [one.trip for one in found] == series.trip.tolist()
    assert [one.half_widths["c_s"] for one in found] == series.half_widths["c_s"].tolist()
    with History(tmp_path / "history.db") as store:
        store.write(results)
        (stored,) = store.series()
        raw = store.read(stored.vehicle, place)
    np.testing.assert_array_equal(stored.half_widths["c_s"], series.half_widths["c_s"])
    np.testing.assert_array_equal(stored.direction, series.direction)
    assert {one.half_widths["c_s"] for one in raw} == {0.01}  # each trip is stored by itself
