"""Time stamps become an even stream: rate, gaps and mistakes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from suspnet.trains.recordings import sources as timeline
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.sources import Timeline


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


# uneven times

RATE_HZ = 200.0


def uneven_times(kind: str, n=4000, seed=0, low=-0.9) -> np.ndarray:
    """Return times about even ones, or with independent steps: steps of 5 +- 1.2 ms."""
    rng = np.random.default_rng(seed)
    if kind == "even grid":
        return np.arange(n) / RATE_HZ + np.clip(rng.normal(0, 0.85e-3, n), -2.4e-3, 2.4e-3)
    return np.cumsum(np.clip(1 + rng.normal(0, 0.24, n), 1 + low, 1 - low)) / RATE_HZ


def missed(times, frequency_hz, **options) -> tuple[np.ndarray, Timeline]:
    """Return the errors of a sine at the instants of the grid, NaN where it has no value."""
    got, line = even(times, np.sin(2 * np.pi * frequency_hz * times), **options)
    at = line.first_s + np.arange(len(got)) / line.rate_hz
    return got - np.sin(2 * np.pi * frequency_hz * at), line


@pytest.mark.parametrize("kind", ["even grid", "independent steps"])
@pytest.mark.parametrize(("frequency_hz", "most"), [(1.0, 1e-9), (10.0, 1e-5), (25.0, 1e-3)])
def test_signals_at_uneven_times_come_back(kind, frequency_hz, most, monkeypatch):
    times = uneven_times(kind)
    errors, line = missed(times, frequency_hz)
    assert np.sqrt(2 * np.mean(errors**2)) < most
    assert len(errors) == pytest.approx(len(times), abs=1)
    assert line.rate_hz == pytest.approx((len(times) - 1) / (times[-1] - times[0]))
    assert line.words.startswith("its times are uneven, steps of 2")
    monkeypatch.setattr(timeline, "BLOCK", 500)
    in_blocks, _ = missed(times, frequency_hz, block=7)
    assert np.sqrt(2 * np.mean(in_blocks**2)) < 2 * most


def test_interpolation_keeps_its_bound():
    times = uneven_times("independent steps", low=-0.2)
    errors, _ = missed(times, 25.0)
    longest = np.diff(times).max()
    assert longest == pytest.approx(0.006)
    bound = 105**2 / (2**8 * 40320) * (2 * np.pi * 25 * longest) ** 8
    assert 0.01 * bound < np.abs(errors[10:-10]).max() < bound


def test_a_gap_is_where_samples_are_missing():
    times, lost = uneven_times("even grid"), np.r_[1000:1002, 2000:2500]
    errors, _ = missed(np.delete(times, lost), 10.0)
    missing = np.flatnonzero(np.isnan(errors))
    np.testing.assert_array_equal(missing, lost)
    assert np.nanmax(np.abs(errors)) < 0.01
    assert not np.isnan(missed(times, 10.0)[0]).any()


def test_what_a_sensor_repeats_stays_equal():
    times = uneven_times("independent steps")
    values = np.where(times < 9, np.sin(times), 0.3)
    got, line = even(times, values)
    at = line.first_s + np.arange(len(got)) / line.rate_hz
    np.testing.assert_array_equal(got[at > 9.1], 0.3)


def test_times_too_uneven_for_the_band_are_refused():
    message = (
        r"channel 'body': its times are uneven, steps of \S+ to \S+ ms; at 25 Hz interpolation "
        "would err by [0-9]+ %, the most is 1 %; record faster, or give `rate_hz` instead of"
    )
    with pytest.raises(TripError, match=message):
        even(3 * uneven_times("independent steps"))


@pytest.mark.parametrize("resolution_s", [1e-3, 2**-11])
def test_even_times_that_were_rounded_stay_even(resolution_s):
    times = np.round(np.arange(9000) / 300 / resolution_s) * resolution_s
    got, line = even(times)
    np.testing.assert_array_equal(got, np.arange(9000))
    assert line.words == ""


def steps_by_turns(one_ms, other_ms, is_other) -> np.ndarray:
    return np.cumsum(np.where(is_other, other_ms, one_ms)) / 1e3


TURNS = np.arange(60_000)
LATE = TURNS >= 30_000
OFF_A_LINE = {
    "another rate": steps_by_turns(5, 1000 / 190, LATE),
    "a little slower": steps_by_turns(5, 1000 / 199.9, LATE),
    "20 ppm slower": steps_by_turns(5, 5.0001, LATE),
    "alternating": steps_by_turns(4, 6, TURNS % 2),
    "a long step now and then": steps_by_turns(5, 7.4, TURNS % 100 == 99),
    "a gap of half a sample": steps_by_turns(5, 12.5, TURNS % 200 == 199),
    "a twentieth longer": steps_by_turns(4.9, 6.9, TURNS % 20 == 19),
    "rounded": np.round(np.cumsum(np.random.default_rng(0).normal(5, 0.4, 60_000))) / 1e3,
}


@pytest.mark.parametrize("n_block", [10_000, 25_000, timeline.BLOCK])
@pytest.mark.parametrize("times", OFF_A_LINE.values(), ids=OFF_A_LINE)
def test_times_off_a_line_are_uneven(times, n_block, monkeypatch):
    monkeypatch.setattr(timeline, "BLOCK", n_block)
    errors, line = missed(times, 10.0)
    assert line.words.startswith("its times are uneven, steps of")
    assert np.nanmax(np.abs(errors)) < 0.01
    assert np.isnan(errors).mean() < 0.01


def test_a_gap_between_even_and_uneven_times_stays_a_gap(monkeypatch):
    monkeypatch.setattr(timeline, "BLOCK", 2000)
    even_times = np.arange(2000) / RATE_HZ
    errors, line = missed(np.append(even_times, 20.001 + uneven_times("even grid", 2000)), 10.0)
    assert line.words
    missing = np.flatnonzero(np.isnan(errors))
    np.testing.assert_allclose([missing[0], missing[-1], len(missing)], [2000, 4000, 2000], atol=2)
    assert np.nanmax(np.abs(errors)) < 0.01


@pytest.mark.parametrize(
    "times",
    [
        np.arange(60_000) / 333.3 + 5000,
        np.arange(60_000, dtype=np.float32) / np.float32(50),
        np.floor(np.arange(60_000) * 1000 / 512) / 1000,
        np.round(np.arange(60_000) / 200.01, 3),
        np.round(np.arange(60_000) / 300.07, 3),
        np.round(TURNS / 200 + np.random.default_rng(0).uniform(4.5e-4, 5.5e-4, 60_000), 3),
    ],
    ids=["odd rate", "single precision", "cut off", "near a multiple", "odd, rounded", "jitter"],
)
def test_times_on_a_line_stay_even(times, monkeypatch):
    monkeypatch.setattr(timeline, "BLOCK", 7000)
    got, line = even(times)
    np.testing.assert_array_equal(got, np.arange(60_000))
    assert line.words == ""
