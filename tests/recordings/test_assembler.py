from dataclasses import replace

import numpy as np
import pytest
from stream_signals import WINDOW, ZERO_NS, disturbed, frames_of, with_gaps

from suspnet.recordings.assembler import MOST_HELD, Assembler, OrderSettings
from suspnet.recordings.frames import MOST_SAMPLES, Frame, FrameError

RATE_HZ = 250.0
SETTINGS = OrderSettings(window=WINDOW)


def assembled(frames, assembler=None):
    """Return the samples of frames, and the assembler."""
    assembler = Assembler(RATE_HZ, SETTINGS) if assembler is None else assembler
    given = [block for frame in frames for block in assembler.push(frame)]
    return np.concatenate([np.empty(0), *given, *assembler.flush()]), assembler


def in_order(n_frames, n=10):
    """Return frames of consecutive whole numbers."""
    step_ns = round(n / RATE_HZ * 1e9)
    return [
        Frame("", "body", k, ZERO_NS + k * step_ns, RATE_HZ, "m/s2", np.arange(k * n, (k + 1) * n))
        for k in range(n_frames)
    ]


def later(frame, seconds):
    return replace(frame, time_ns=frame.time_ns + round(seconds * 1e9))


# reference


@pytest.mark.parametrize("seed", range(20))
def test_frames_out_of_order_and_twice_give_the_signal_with_its_gaps(seed):
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=5000)
    frames = frames_of("bogie", samples, rng, RATE_HZ, n_lost=seed % 5, most=80)
    found, assembler = assembled(disturbed(frames, rng, duplicates=0.2))
    np.testing.assert_array_equal(found, with_gaps(samples, frames, "bogie", RATE_HZ))
    assert assembler.counts["taken"] == len(frames)
    assert assembler.counts["missing"] == seed % 5
    assert assembler.counts["gap_samples"] == np.isnan(found).sum()
    assert assembler.n_samples == len(found)


# limit


def test_frames_in_order_are_given_at_once_after_the_first_window():
    assembler = Assembler(RATE_HZ, SETTINGS)
    given = [sum(map(len, assembler.push(frame))) for frame in in_order(20)]
    assert given == [0] * WINDOW + [10 * (WINDOW + 1)] + [10] * (19 - WINDOW)


def test_window_of_zero_gives_all_at_once():
    assembler = Assembler(RATE_HZ, OrderSettings(window=0))
    assert [sum(map(len, assembler.push(f))) for f in in_order(3)] == [10, 10, 10]


# property


def test_frames_after_the_window_are_late_and_not_taken():
    frames = in_order(30)
    late = frames.pop(12)
    found, assembler = assembled([*frames[: 13 + WINDOW], late, *frames[13 + WINDOW :], late])
    assert np.isnan(found[120:130]).all()
    assert np.isnan(found).sum() == 10
    assert assembler.counts["late"] == 2
    assert assembler.counts["duplicate"] == 0
    assert assembler.counts["gap"] == 1


def test_duplicates_are_counted_and_dropped():
    frames = in_order(30)
    found, assembler = assembled([*frames, *frames[:3], frames[-1]])
    np.testing.assert_array_equal(found, np.arange(300))
    assert assembler.counts == {"taken": 30, "duplicate": 4}


def test_clock_that_jumps_backwards_is_counted_and_never_doubles_samples():
    frames = in_order(60)
    back = [later(frame, -0.5) for frame in frames[20:]]
    found, assembler = assembled([*frames[:20], *back])
    # 0.5 s are 12.5 frames: 13 are refused, and half a frame is missing before the next
    assert assembler.counts["clock"] == 13
    assert assembler.counts["gap_samples"] == 5
    assert len(found) == 200 + 5 + 270


def test_clock_that_jumps_forwards_leaves_a_gap():
    frames = in_order(30)
    found, assembler = assembled([*frames[:20], *(later(one, 0.2) for one in frames[20:])])
    assert np.isnan(found[200:250]).all()
    assert np.isfinite(found[250:]).all()
    assert assembler.counts["gap_samples"] == 50
    assert assembler.counts["missing"] == 0


def test_one_frame_far_ahead_is_refused():
    frames = in_order(30)
    found, assembler = assembled([*frames[:20], later(frames[20], 61.0), *frames[21:]])
    assert assembler.counts["far"] == 1
    assert assembler.counts["gap_samples"] == 10
    assert len(found) == 300


def test_a_long_gap_is_believed_after_a_window_of_frames():
    frames = in_order(30)
    found, assembler = assembled([*frames[:20], *(later(one, 61.0) for one in frames[20:])])
    assert assembler.counts["far"] == WINDOW
    assert len(found) == 300 + 61 * RATE_HZ
    np.testing.assert_array_equal(found[-40:], np.arange(260, 300))


def test_jitter_within_the_tolerance_makes_no_gap():
    rng = np.random.default_rng(0)
    found, assembler = assembled(later(f, rng.uniform(-1e-3, 1e-3)) for f in in_order(30))
    np.testing.assert_array_equal(found, np.arange(300))
    assert assembler.counts == {"taken": 30}


def test_sequence_that_begins_anew_goes_on_by_its_times():
    frames = in_order(40)
    anew = [replace(frame, sequence=frame.sequence - 25) for frame in frames[25:]]
    anew[0], anew[1] = anew[1], anew[0]
    found, assembler = assembled([*frames[:22], *anew])
    assert np.isnan(found[220:250]).all()
    np.testing.assert_array_equal(found[250:], np.arange(250, 400))
    assert assembler.counts == {"taken": 37, "restart": 1, "gap": 1, "gap_samples": 30}


def test_what_is_held_is_bounded():
    frames = in_order(2000)
    assembler = Assembler(RATE_HZ, OrderSettings(window=1024))
    for frame in frames[:-1:2]:
        assembler.push(frame)
        assert len(assembler._held) <= 1024
    big = [
        Frame("", "body", 2 * k, ZERO_NS, RATE_HZ, "m/s2", np.zeros(MOST_SAMPLES)) for k in range(9)
    ]
    assembler = Assembler(RATE_HZ, OrderSettings(window=1024))
    for frame in big:
        assembler.push(frame)
        assert sum(len(one.samples) for one in assembler._held.values()) <= MOST_HELD


def test_restored_state_goes_on_to_the_same_samples():
    rng = np.random.default_rng(2)
    frames = frames_of("bogie", rng.normal(size=3000), rng, RATE_HZ, n_lost=3, most=80)
    frames = disturbed(frames, rng)
    whole, _ = assembled(frames)
    first = Assembler(RATE_HZ, SETTINGS)
    given = [block for frame in frames[:31] for block in first.push(frame)]
    second = Assembler(RATE_HZ, SETTINGS)
    second.restore(first.state())
    rest, _ = assembled(frames[31:], second)
    np.testing.assert_array_equal(np.concatenate([*given, rest]), whole)


# failure


def test_frame_of_another_rate_is_refused():
    assembler = Assembler(RATE_HZ, SETTINGS)
    with pytest.raises(FrameError, match="'body' has 250 Hz, its frame 251 Hz") as error:
        assembler.push(replace(in_order(1)[0], rate_hz=251.0))
    assert error.value.reason == "rate"


@pytest.mark.parametrize("changes", [{"window": -1}, {"jitter_s": 2.0}, {"longest_gap_s": 1e4}])
def test_settings_out_of_range_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        OrderSettings(**changes)


def drifting(ppm, n_frames, rate_hz=1000.0, n=500):
    """Return frames of a logger whose clock is right and whose rate is not."""
    step_ns = 1e9 / (rate_hz * (1 + 1e-6 * ppm))
    return [
        Frame("", "body", k, ZERO_NS + round(k * n * step_ns), rate_hz, "m/s2", np.zeros(n))
        for k in range(n_frames)
    ]


@pytest.mark.parametrize("ppm", [-150, -50, 50, 150])
def test_a_slow_drift_of_the_rate_is_no_gap(ppm):
    order = Assembler(1000.0)
    given = [part for one in drifting(ppm, 600) for part in order.push(one)]
    assert order.counts == {"taken": 600}
    assert np.isfinite(np.concatenate(given)).all()


def test_a_lost_frame_is_a_gap_of_its_length_after_a_long_drift():
    order, frames = Assembler(1000.0, OrderSettings(window=0)), drifting(100, 600)
    for one in frames[:500] + frames[501:]:
        order.push(one)
    assert (order.counts["gap"], order.counts["gap_samples"]) == (1, 500)


@pytest.mark.parametrize("ppm", [-2000, 2000])
def test_a_rate_that_is_wrong_is_brought_back_in_steps_and_counted(ppm):
    order = Assembler(1000.0)
    for one in drifting(ppm, 600):
        order.push(one)
    assert order.counts["gap"] > 5
    ends_s = 600 * 0.5 / (1 + 1e-6 * ppm)
    assert abs(order.n_samples / 1000.0 - ends_s) < 0.5 + 3e-4 * ends_s
