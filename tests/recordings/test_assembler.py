"""Frames that are late, doubled, out of order or missing become samples at their places."""

from dataclasses import replace

import numpy as np
import pytest
from stream_signals import WINDOW, ZERO_NS, disturbed, frames_of, with_gaps

from suspnet.trains.recordings.assembler import MOST_HELD, Assembler, OrderSettings
from suspnet.trains.recordings.frames import MOST_SAMPLES, Frame, FrameError

RATE_HZ = 250.0
SETTINGS = OrderSettings(window=WINDOW)


def assembled(frames, assembler=None):
    """Return the samples of frames, and the assembler."""
    assembler = Assembler(RATE_HZ, SETTINGS) if assembler is None else assembler
    blocks = [block for frame in frames for block in assembler.push(frame)]
    return np.concatenate([np.empty(0), *blocks, *assembler.flush()]), assembler


def in_order(n_frames, n=10, step_ns=None, rate_hz=RATE_HZ):
    """Return frames of consecutive whole numbers."""
    step_ns = n / rate_hz * 1e9 if step_ns is None else step_ns
    numbers = np.arange(n_frames * n).reshape(n_frames, n)
    return [
        Frame("", "body", k, ZERO_NS + round(k * step_ns), rate_hz, "m/s2", samples)
        for k, samples in enumerate(numbers)
    ]


def late(frames, seconds):
    return [replace(f, time_ns=f.time_ns + round(seconds * 1e9)) for f in frames]


# reference


@pytest.mark.parametrize("seed", range(20))
def test_frames_out_of_order_and_twice_give_the_signal_with_its_gaps(seed):
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=5000)
    frames = frames_of("bogie", samples, rng, RATE_HZ, n_lost=seed % 5, most=80)
    result, assembler = assembled(disturbed(frames, rng, duplicates=0.2))
    np.testing.assert_array_equal(result, with_gaps(samples, frames, "bogie", RATE_HZ))
    assert assembler.counts["taken"] == len(frames)
    assert assembler.counts["missing"] == seed % 5
    assert assembler.counts["gap_samples"] == np.isnan(result).sum()
    assert assembler.n_samples == len(result)


# limit


@pytest.mark.parametrize("window", [0, WINDOW])
def test_frames_in_order_are_given_at_once_after_the_first_window(window):
    assembler = Assembler(RATE_HZ, OrderSettings(window=window))
    n_given = [sum(map(len, assembler.push(frame))) for frame in in_order(20)]
    assert n_given == [0] * window + [10 * (window + 1)] + [10] * (19 - window)


# property

FRAMES = in_order(60)
RESTARTED = [replace(f, sequence=f.sequence - 25) for f in FRAMES[25:40]]
EVENTS = {  # frames, length of the signal, missing samples, counts but the accepted frames
    "late": (
        [
            *FRAMES[:12],
            *FRAMES[13 : 14 + WINDOW],
            FRAMES[12],
            *FRAMES[14 + WINDOW : 30],
            FRAMES[12],
        ],
        *(300, range(120, 130), {"late": 2, "missing": 1, "gap": 1, "gap_samples": 10}),
    ),
    "twice": ([*FRAMES[:30], *FRAMES[:3], FRAMES[29]], 300, (), {"duplicate": 4}),
    # 0.5 s are 12.5 frames: 13 are refused, and half a frame is missing before the next
    "clock backwards": (
        [*FRAMES[:20], *late(FRAMES[20:], -0.5)],
        *(475, range(200, 205), {"clock": 13, "gap": 1, "gap_samples": 5}),
    ),
    "clock forwards": (
        [*FRAMES[:20], *late(FRAMES[20:30], 0.2)],
        *(350, range(200, 250), {"gap": 1, "gap_samples": 50}),
    ),
    "one far ahead": (
        [*FRAMES[:20], *late(FRAMES[20:21], 61.0), *FRAMES[21:30]],
        *(300, range(200, 210), {"far": 1, "gap": 1, "gap_samples": 10}),
    ),
    "all far ahead": (
        [*FRAMES[:20], *late(FRAMES[20:30], 61.0)],
        300 + round(61 * RATE_HZ),
        range(200, 200 + 10 * WINDOW + round(61 * RATE_HZ)),
        {"far": WINDOW, "gap": 1, "gap_samples": 10 * WINDOW + round(61 * RATE_HZ)},
    ),
    "restart": (
        [*FRAMES[:22], RESTARTED[1], RESTARTED[0], *RESTARTED[2:]],
        *(400, range(220, 250), {"restart": 1, "gap": 1, "gap_samples": 30}),
    ),
}


@pytest.mark.parametrize("event", EVENTS)
def test_events_are_counted_and_leave_samples_at_their_places(event):
    frames, n, missing, counts = EVENTS[event]
    result, assembler = assembled(frames)
    assert len(result) == n
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(result)), np.array(missing, int))
    assert {k: count for k, count in assembler.counts.items() if k != "taken"} == counts
    present = result[np.isfinite(result)]
    assert (np.diff(present) >= 1).all()  # no sample is returned twice
    assert present[-1] == max(frame.samples[-1] for frame in frames)


def test_jitter_within_the_tolerance_makes_no_gap():
    rng = np.random.default_rng(0)
    frames = [late([frame], rng.uniform(-1e-3, 1e-3))[0] for frame in in_order(30)]
    result, assembler = assembled(frames)
    np.testing.assert_array_equal(result, np.arange(300))
    assert assembler.counts == {"taken": 30}


def test_held_frames_and_samples_are_bounded():
    assembler = Assembler(RATE_HZ, OrderSettings(window=1024))
    for frame in in_order(2000)[:-1:2]:
        assembler.push(frame)
    assert len(assembler.state()["sizes"]) <= 1024
    assembler, zeros = Assembler(RATE_HZ, OrderSettings(window=1024)), np.zeros(MOST_SAMPLES)
    for k in range(9):
        assembler.push(Frame("", "body", 2 * k, ZERO_NS, RATE_HZ, "m/s2", zeros))
        assert len(assembler.state()["sizes"]) * MOST_SAMPLES <= MOST_HELD


def test_restored_state_continues_with_the_same_samples():
    rng = np.random.default_rng(2)
    frames = frames_of("bogie", rng.normal(size=3000), rng, RATE_HZ, n_lost=3, most=80)
    frames = disturbed(frames, rng)
    whole, _ = assembled(frames)
    first, second = Assembler(RATE_HZ, SETTINGS), Assembler(RATE_HZ, SETTINGS)
    blocks = [block for frame in frames[:31] for block in first.push(frame)]
    second.restore(first.state())
    rest, _ = assembled(frames[31:], second)
    np.testing.assert_array_equal(np.concatenate([*blocks, rest]), whole)


def drifting(ppm):
    """Return 600 frames of half a second of a logger whose clock is right and whose rate is not."""
    return in_order(600, 500, 5e8 / (1 + 1e-6 * ppm), 1000.0)


@pytest.mark.parametrize("ppm", [-150, 150])
def test_a_slow_drift_of_the_rate_is_no_gap(ppm):
    result, order = assembled(drifting(ppm), Assembler(1000.0))
    assert order.counts == {"taken": 600}
    assert np.isfinite(result).all()


def test_a_lost_frame_is_a_gap_of_its_length_after_a_long_drift():
    frames = drifting(100)
    _, order = assembled(frames[:500] + frames[501:], Assembler(1000.0, OrderSettings(window=0)))
    assert (order.counts["gap"], order.counts["gap_samples"]) == (1, 500)


@pytest.mark.parametrize("ppm", [-2000, 2000])
def test_a_wrong_rate_is_corrected_in_steps_and_counted(ppm):
    _, order = assembled(drifting(ppm), Assembler(1000.0))
    assert order.counts["gap"] > 5
    ends_s = 600 * 0.5 / (1 + 1e-6 * ppm)
    assert abs(order.n_samples / 1000.0 - ends_s) < 0.5 + 3e-4 * ends_s


# failure


def test_frame_of_another_rate_is_refused():
    with pytest.raises(FrameError, match="250 Hz, its frame 251 Hz") as error:
        Assembler(RATE_HZ, SETTINGS).push(replace(FRAMES[0], rate_hz=251.0))
    assert error.value.reason == "rate"


@pytest.mark.parametrize("changes", [{"window": -1}, {"jitter_s": 2.0}, {"longest_gap_s": 1e4}])
def test_settings_out_of_range_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        OrderSettings(**changes)
