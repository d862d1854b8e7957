import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from suspnet.depot.live.operating_conditions import MAX_STEPS, SlowValues
from suspnet.trains.recordings.frames import Frame, FrameError

SECOND = 10**9


def value(sensor, seconds, *values, unit=None, rate_hz=1.0):
    unit = unit or {"mileage": "km", "temperature": "degC"}[sensor]
    samples = np.array(values, dtype=float)
    return Frame("A", sensor, 0, seconds * SECOND, rate_hz, unit, samples)


def within(slow, begin_s, end_s):
    """Return mileage and temperature of a section that follows the one that was passed last."""
    km, celsius = slow.within(begin_s * SECOND, end_s * SECOND)
    return slow.passed_km if km is None else km, celsius


def test_first_value_in_a_section_counts_and_those_before_a_frame_are_the_manifest_s():
    slow = SlowValues(12.0, None)
    assert within(slow, 0, 10) == (12.0, None)
    slow.take(value("mileage", 14, 104.0, 105.0))
    slow.take(value("mileage", 12, 102_000.0, unit="m"))
    slow.take(value("temperature", 5, 7.0))
    assert within(slow, 10, 20) == (102.0, 7.0)
    slow.take(value("temperature", 13, 9.0, unit="°C"))
    assert within(slow, 10, 20) == (102.0, 9.0)
    slow.pass_section(20 * SECOND, 110.0)
    assert within(slow, 20, 30) == (110.0, 9.0)


@given(st.permutations(range(20)), st.integers(0, 5))
def test_order_and_repetition_of_frames_change_nothing(order, n_twice):
    frames = [value("mileage", 3 * k, 100.0 + k) for k in range(20)]
    straight, mixed = SlowValues(0.0, None), SlowValues(0.0, None)
    for one in frames:
        straight.take(one)
    for k in [*order, *order[:n_twice]]:
        mixed.take(frames[k])
    assert straight.state() == mixed.state()
    again = SlowValues(1.0, 2.0)
    again.restore(mixed.state())
    assert again.state() == straight.state()


def test_number_of_values_is_bounded_and_wrong_times_push_out_no_right_ones():
    slow = SlowValues(0.0, None)
    for k in range(200):
        far = np.full(1000, 5.0)
        slow.take(value("mileage", 10**9 + 10_000 * k, *far, rate_hz=0.1))
        slow.take(value("mileage", 10 * k, 100.0 + k))
    known = slow.state()["known"]["mileage"]
    assert len(known) == MAX_STEPS
    assert known[:200] == [(10 * k * SECOND, 100.0 + k) for k in range(200)]


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (value("mileage", 0, -1.0), "range"),
        (value("mileage", 0, 1e12), "range"),
        (value("temperature", 0, 300.0), "range"),
        (value("temperature", 0, 300.0, unit="K"), "unit"),
        (value("mileage", 0, 1.0, unit="miles"), "unit"),
    ],
)
def test_values_that_cannot_be_are_refused(frame, reason):
    slow = SlowValues(7.0, 8.0)
    with pytest.raises(FrameError) as error:
        slow.take(frame)
    assert error.value.reason == reason
    assert within(slow, 0, 10) == (7.0, 8.0)
