"""Time stamps become an even stream: rate, gaps and mistakes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from suspnet.recordings import sources as timeline
from suspnet.recordings.errors import TripError
from suspnet.recordings.sources import Timeline


def even(times, values=None, block=1000, rate_hz=None) -> tuple[np.ndarray, Timeline]:
    times = np.asarray(times, dtype=np.float64)
    values = np.arange(len(times), dtype=np.float64) if values is None else values
    line = Timeline("trip.yaml: channel 'body'", rate_hz)
    blocks = ((times[i : i + block], values[i : i + block]) for i in range(0, len(times), block))
    return np.concatenate(list(line.even(blocks))), line


@given(
    st.floats(10, 10_000),
    st.floats(-1e4, 1e4),
    st.sets(st.integers(1, 2998), max_size=400),
    st.sampled_from([1, 7, 256, 4000]),
)
def test_dropped_samples_leave_nan_in_their_place(rate_hz, start_s, dropped, block):
    kept = np.array(sorted(set(range(3000)) - dropped))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(timeline, "BLOCK", 256)
        got, line = even(start_s + kept / rate_hz, kept.astype(float), block)
    expected = np.full(3000, np.nan)
    expected[kept] = kept
    np.testing.assert_array_equal(got, expected)
    assert line.rate_hz == pytest.approx(rate_hz, rel=1e-6)
    assert line.first_s == start_s + kept[0] / rate_hz


@given(st.integers(0, 2**32 - 1))
def test_gaps_of_any_length_do_not_shift_the_clock(seed):
    rng = np.random.default_rng(seed)
    steps = np.full(4000, 1 / 333.3)
    steps[rng.choice(4000, 200, replace=False)] += rng.uniform(1, 40, 200) / 333.3
    times = np.cumsum(steps)
    got, line = even(times, times)
    at = times[0] + np.arange(len(got)) / line.rate_hz
    known = np.isfinite(got)
    assert np.abs(got[known] - at[known]).max() < 0.51 / 333.3


def test_rounded_times_give_the_mean_rate():
    times = np.round(np.arange(20_480) / 2048, 4)  # steps of 0.4 and 0.5 ms
    got, line = even(times, rate_hz=2048.0)
    assert len(got) == len(times)
    assert line.rate_hz == pytest.approx(2048, rel=1e-4)


@pytest.mark.parametrize("block", [1, 3, 1000])
@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, 1, 2, 2, 3], "times must rise, but 2 s follows 2 s; are they rounded"),
        ([0, 1, 2, 1.5, 3], "times must rise, but 1.5 s follows 2 s"),
        ([0, 1, np.nan, 3], "its times hold an empty or infinite value"),
        ([np.inf, 1, 2, 3], "its times hold an empty or infinite value"),
        ([0, 1, 2, 5000, 5001], "its times leave out 4998 s at once; the most is 1800 s"),
    ],
)
def test_wrong_times_are_named(times, message, block, monkeypatch):
    monkeypatch.setattr(timeline, "BLOCK", 3)
    with pytest.raises(TripError, match=rf"channel 'body': {message}"):
        even(times, block=block)


def test_single_precision_times_are_refused():
    times = (np.arange(100_000) / 5000 + 3000).astype(np.float32)
    with pytest.raises(TripError, match="stored in single precision"):
        even(times)


def test_rate_that_disagrees_is_named():
    times = np.arange(3000) / 2000
    assert even(times, rate_hz=2019.0)[1].rate_hz == pytest.approx(2000)
    with pytest.raises(TripError, match=r"`rate_hz` says 2021 Hz, its times say 2000 Hz.*1 %"):
        even(times, rate_hz=2021.0)
