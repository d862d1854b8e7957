"""Journeys against numerical integration of their speed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid

from suspnet.trains.simulation.signals import Journey, service_journey

KNOTS = np.array([0.0, 3.0, 10.0, 10.5, 20.0])
SPEEDS = np.array([2.0, 8.0, 8.0, 0.0, 5.0])


def stretches(journey):
    """Return start and end of each stretch between stands of 2 minutes."""
    standing = (journey.speeds_m_per_s[1:] == 0) & (journey.speeds_m_per_s[:-1] == 0)
    ends = journey.times_s[:-1][standing]
    starts = journey.times_s[1:][standing]
    return np.concatenate([[0.0], starts]), np.concatenate([ends, [journey.duration_s]])


# reference


def test_position_is_the_integral_of_speed_and_acceleration_its_slope():
    journey = Journey(KNOTS, SPEEDS)
    times = np.linspace(0, 20, 20_001)  # every knot is one of them
    position, speed, acceleration = journey.at(times)
    np.testing.assert_allclose(speed, np.interp(times, KNOTS, SPEEDS), atol=1e-12)
    # the trapezium rule is exact for straight lines
    expected = cumulative_trapezoid(speed, times, initial=0)
    assert expected[-1] > 50
    np.testing.assert_allclose(position, expected, atol=1e-9)
    middle = 0.5 * (times[1:] + times[:-1])
    np.testing.assert_allclose(
        journey.at(middle)[2], np.diff(speed) / np.diff(times), rtol=1e-6, atol=1e-8
    )
    assert journey.distance_m == pytest.approx(expected[-1], rel=1e-12)
    assert journey.duration_s == 20.0
    assert acceleration[0] == pytest.approx(2.0)


# limit


def test_speed_goes_on_as_it_is_before_and_after():
    journey = Journey(KNOTS, SPEEDS)
    position, speed, acceleration = journey.at(np.array([-4.0, -1e-9, 25.0]))
    np.testing.assert_allclose(speed, [2.0, 2.0, 5.0])
    assert not acceleration.any()
    np.testing.assert_allclose(position, [-8.0, -2e-9, journey.distance_m + 25.0], rtol=1e-12)


# property


@given(st.lists(st.floats(0, 90), min_size=2, max_size=6), st.integers(0, 1000))
def test_position_never_falls_and_speed_never_jumps(speeds, seed):
    speeds[0] += 1.0
    knots = np.cumsum(np.random.default_rng(seed).uniform(0.5, 30, len(speeds)))
    journey = Journey(knots - knots[0], np.array(speeds))
    times = np.linspace(-1, journey.duration_s + 1, 5001)
    position, speed, acceleration = journey.at(times)
    assert (np.diff(position) >= -1e-9).all()
    assert speed.min() >= -1e-9
    steepest = np.abs(np.diff(journey.speeds_m_per_s) / np.diff(journey.times_s)).max()
    step_s = times[1] - times[0]
    assert np.abs(np.diff(speed)).max() <= steepest * step_s + 1e-9
    assert np.abs(acceleration).max() <= steepest + 1e-12


@pytest.mark.parametrize("n_stops", [0, 1, 3])
@pytest.mark.parametrize("seed", range(2))
def test_service_journey_stands_at_its_ends_and_as_often_as_asked(n_stops, seed):
    journey = service_journey(60.0, 3600.0, n_stops, seed)
    assert journey.times_s[0] == 0
    assert journey.duration_s == pytest.approx(3600.0, abs=1e-6)
    assert journey.speeds_m_per_s[[0, -1]].tolist() == [0.0, 0.0]
    starts, ends = stretches(journey)
    assert len(starts) == n_stops + 1
    stretch_s = (3600 - 120 * n_stops) / (n_stops + 1)
    np.testing.assert_allclose(ends - starts, stretch_s, atol=1e-6)
    np.testing.assert_allclose(starts[1:] - ends[:-1], 120.0, atol=1e-6)
    # nowhere else does it stand
    assert np.count_nonzero(journey.speeds_m_per_s == 0) == 2 * (n_stops + 1)


@pytest.mark.parametrize("seed", range(5))
def test_service_journey_keeps_to_its_speeds_and_accelerations(seed):
    cruise, ripple = 50.0, 0.01
    journey = service_journey(cruise, 5400.0, 3, seed, ripple)
    times = np.arange(0, 5400.0, 0.5)
    _, speed, acceleration = journey.at(times)
    assert speed.max() <= cruise
    assert speed.min() >= 0
    # speeds up at 0.4 and brakes at 0.6, up to a wander of four times `ripple`
    assert acceleration.max() == pytest.approx(0.4, rel=0.05)
    assert acceleration.min() == pytest.approx(-0.6, rel=0.05)
    for start, end in zip(*stretches(journey), strict=True):
        inside = (times >= start) & (times <= end)
        top = speed[inside].max()
        assert 0.6 * cruise * (1 - 4 * ripple) < top <= cruise
        # cruising fills what the ramps leave
        ramps = top / 0.4 + top / 0.6
        share = np.mean(speed[inside] > top * (1 - 8 * ripple))
        assert share == pytest.approx(1 - ramps / (end - start), abs=0.05)


def test_about_every_fifth_stretch_is_slow():
    slow, wander = [], []
    for seed in range(150):
        journey = service_journey(40.0, 5400.0, 3, seed)
        for start, end in zip(*stretches(journey), strict=True):
            inside = (journey.times_s > start) & (journey.times_s < end)
            cruise = journey.speeds_m_per_s[inside]
            slow.append(cruise.max() < 0.95 * 40.0)
            if slow[-1]:  # not cut at the cruising speed
                wander.append(np.std(cruise[:-1], ddof=1) / cruise.mean())
                assert 0.6 * 0.98 < cruise.mean() / 40.0 < 0.9 * 1.02
    # 600 stretches: a standard error of sqrt(0.2 * 0.8 / 600) = 0.016
    assert np.mean(slow) == pytest.approx(0.2, abs=0.065)
    assert np.mean(wander) == pytest.approx(0.01, rel=0.1)


# failure


@pytest.mark.parametrize(
    ("times", "speeds", "message"),
    [
        ([0.0], [1.0], "at least two instants"),
        ([0.0, 1.0], [1.0, 1.0, 1.0], "at least two instants"),
        ([[0.0, 1.0]], [[1.0, 1.0]], "at least two instants"),
        ([1.0, 2.0], [1.0, 1.0], "must ascend from 0"),
        ([0.0, 2.0, 1.0], [1.0, 1.0, 1.0], "must ascend from 0"),
        ([0.0, 1.0, 1.0], [1.0, 1.0, 1.0], "must ascend from 0"),
        ([0.0, math.nan], [1.0, 1.0], "must ascend from 0"),
        ([0.0, 1.0], [1.0, -1.0], "must be >= 0 and finite, one of them > 0"),
        ([0.0, 1.0], [0.0, 0.0], "must be >= 0 and finite, one of them > 0"),
        ([0.0, 1.0], [1.0, math.nan], "must be >= 0 and finite, one of them > 0"),
        ([0.0, 1.0], [1.0, math.inf], "must be >= 0 and finite, one of them > 0"),
    ],
)
def test_impossible_journeys_are_rejected(times, speeds, message):
    with pytest.raises(ValueError, match=message):
        Journey(np.array(times), np.array(speeds))


def test_stretches_too_short_to_reach_the_speed_are_rejected():
    # 60 m/s take 150 s to reach and 100 s to brake from; two minutes of cruising besides
    assert service_journey(60.0, 370.0, 0, seed=0).distance_m > 0
    with pytest.raises(ValueError, match=r"0 stops in 369 s leave 369 s .* take 250 s"):
        service_journey(60.0, 369.0, 0, seed=0)
    with pytest.raises(ValueError, match=r"3 stops in 1200 s leave 210 s"):
        service_journey(60.0, 1200.0, 3, seed=0)
