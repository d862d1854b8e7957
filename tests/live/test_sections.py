from dataclasses import replace

import numpy as np
import pytest
from stream_signals import (
    RATES_HZ,
    STARTS_S,
    WINDOW,
    ZERO_NS,
    batch,
    disturbed,
    encoded,
    frames_of,
    gone_on,
    interleaved,
    manifest_in,
    signals,
    taken,
    with_gaps,
)

from suspnet.depot.live.sections import MAX_OPEN, LiveSettings, Sections
from suspnet.trains.recordings import cleaning
from suspnet.trains.recordings.assembler import OrderSettings
from suspnet.trains.recordings.frames import Frame, FrameError, encode

ORDER = OrderSettings(window=WINDOW)
SECTION_S = 200
SEEDS = [0, pytest.param(1, marks=pytest.mark.slow)]


@pytest.fixture(autouse=True)
def _small_windows(monkeypatch):
    monkeypatch.setattr(cleaning, "CORE_SAMPLES", 3000)


def sections(folder, **changes):
    settings = {"section_s": SECTION_S, "late_s": 10.0, "order": ORDER} | changes
    return Sections(manifest_in(folder), LiveSettings(**settings))


def batch_of_section(folder, columns, number):
    """Return what the batch makes of the samples within one section."""
    manifest, cut = manifest_in(folder), {}
    sources = {**manifest.channels, "speed": manifest.speed}
    for name, rate_hz in RATES_HZ.items():
        at_s = STARTS_S[name] + np.arange(len(columns[name])) / rate_hz
        inside = np.floor(at_s / SECTION_S + 1e-9) == number
        known = np.flatnonzero(inside & np.isfinite(columns[name]))
        inside[: known[0]] = inside[known[-1] + 1 :] = False  # a file begins with a sample
        cut[name] = columns[name][inside]
        start_s = round(at_s[inside][0] - number * SECTION_S, 9)
        sources[name] = replace(sources[name], start_s=start_s)
    return batch(replace(manifest, speed=sources.pop("speed"), channels=sources), cut)


# reference


def streamed(folder, seed, seconds, begin_s=0.0):
    """Return samples of a stream with gaps, its sections, and how many were over before its end."""
    rng, columns, parts = np.random.default_rng(seed), signals(seed, seconds), []
    for name, samples in columns.items():
        most = 8 if name == "speed" else 400
        frames = frames_of(name, samples, rng, RATES_HZ[name], n_lost=2, most=most)
        columns[name] = with_gaps(samples, frames, name, RATES_HZ[name])
        later = [replace(f, time_ns=f.time_ns + round(begin_s * 1e9)) for f in frames]
        parts.append(disturbed(later, rng))
    stream, found = sections(folder, late_s=40.0), []
    frames = encoded(interleaved(parts, rng))
    saved = set(rng.integers(len(frames), size=4).tolist())
    for k, data in enumerate(frames):
        assert taken(stream, data) in ("", "late")
        found += stream.over()
        if k in saved:
            stream = gone_on(stream, sections(folder, late_s=40.0))
    n_over = len(found)
    return columns, found + stream.close(), n_over


def assert_same(one, expected, rtol=1e-11, atol=1e-10):
    np.testing.assert_allclose(one.signals, expected.signals, rtol=rtol, atol=atol)
    np.testing.assert_array_equal(one.usable, expected.usable)
    np.testing.assert_allclose(one.speed_m_per_s, expected.speed_m_per_s, rtol=1e-12)
    assert one.start_s == expected.start_s
    assert one.duration_s == expected.duration_s
    assert [str(fault) for fault in one.faults] == [str(fault) for fault in expected.faults]


@pytest.mark.parametrize("seed", SEEDS)
def test_sections_of_the_stream_are_those_of_the_batch(tmp_path, seed):
    columns, found, n_over = streamed(tmp_path, seed, 530.0)
    assert n_over == 2
    assert [one.begin_ns // 10**9 for one in found] == [
        ZERO_NS // 10**9 + k * SECTION_S for k in range(3)
    ]
    for number, running in enumerate(found):
        assert_same(running.recording(), batch_of_section(tmp_path, columns, number))


@pytest.mark.parametrize("begin_s", [33.0, pytest.param(99.9, marks=pytest.mark.slow)])
def test_trip_shorter_than_a_section_is_one_wherever_it_begins(tmp_path, begin_s):
    columns, (one,), _ = streamed(tmp_path, 7, 95.0, begin_s)
    assert one.begin_ns // 10**9 == int(ZERO_NS / 1e9 + STARTS_S["axle_box"] + begin_s)
    cut_s = begin_s - (one.begin_ns // 10**9 - ZERO_NS // 10**9)
    manifest = manifest_in(tmp_path)
    sources = {
        name: replace(source, start_s=round(source.start_s + cut_s, 9))
        for name, source in {**manifest.channels, "speed": manifest.speed}.items()
    }
    expected = batch(
        replace(manifest, speed=sources.pop("speed"), channels=sources),
        {name: samples[: _n_known(samples)] for name, samples in columns.items()},
    )
    # a rounding of the time of a first sample may choose the neighbour of a tabulated filter
    in_first_second = max(STARTS_S.values()) + begin_s % 1 < 1
    assert_same(one.recording(), expected, *(() if in_first_second else (1e-5, 1e-3)))


def _n_known(samples):
    return int(np.flatnonzero(np.isfinite(samples))[-1]) + 1


# property


def frame(seconds, sequence, n=10, sensor="bogie"):
    time_ns = ZERO_NS + round(seconds * 1e9)
    return Frame("front left", sensor, sequence, time_ns, 250.0, "m/s2", np.ones(n, "f4"))


def test_frame_is_divided_at_the_border(tmp_path):
    stream = sections(tmp_path)
    stream.add(frame(0.0, 0))
    stream.add(frame(160.0, 1))
    stream.add(frame(199.98, 2))
    stream.add(replace(frame(400.0, 3), time_ns=ZERO_NS + 400 * 10**9 - 1))
    one, other, last = stream.close()
    assert (one.end_ns, other.begin_ns) == (ZERO_NS + 2 * 10**11,) * 2
    assert last.begin_ns == ZERO_NS + 400 * 10**9


def test_section_is_over_when_enough_frames_have_passed_it(tmp_path):
    stream = sections(tmp_path)
    for k in range(4):
        stream.add(frame(65.0 * k, k))
    stream.add(frame(201.0, 4))
    for k in range(WINDOW + 1):
        assert stream.over() == []
        stream.add(frame(261.0 + k, 5 + k))
    (one,) = stream.over()
    assert one.begin_ns == ZERO_NS
    assert stream.over() == []
    assert taken(stream, encode(frame(199.0, 100))) == "late"


def test_trip_is_over_when_frames_come_after_a_pause(tmp_path):
    stream = sections(tmp_path, section_s=600)
    for k in range(4):
        stream.add(frame(33.0 * k, k))
    for k in range(9 + WINDOW + 1):  # at first a lagging sensor may not be through
        assert stream.over() == []
        stream.add(frame(99.04 + 301.0 + k, 4 + k))
    (one,) = stream.over()
    assert (one.begin_ns, one.n_frames) == (ZERO_NS, 4)
    assert taken(stream, encode(frame(390.0, 100))) == "late"
    (other,) = stream.close()
    assert other.begin_ns == ZERO_NS + 400_040_000_000


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0), (1, 0, 2)])
def test_begin_does_not_depend_on_the_order_of_frames(tmp_path, order):
    stream = sections(tmp_path)
    for k in order:
        stream.add(frame(0.7 * k, k))
    stream.add(frame(150.0, 3))
    stream.add(frame(200.5, 4))
    one, other = stream.close()
    assert (one.begin_ns, other.begin_ns) == (ZERO_NS, ZERO_NS + 200_500_000_000)


def speed_frame(seconds, m_per_s):
    time_ns = ZERO_NS + round(seconds * 1e9)
    samples = np.full(40, m_per_s, "f4")
    return Frame("front left", "speed", round(seconds), time_ns, 4.0, "m/s", samples)


SLOW = [pytest.param(at, lag, marks=pytest.mark.slow) for at, lag in ((430, 0), (1999, -5))]


@pytest.mark.parametrize(("begin_s", "lag_s"), [(1100, 5), *SLOW])
def test_ten_minutes_between_two_stops_are_in_one_section(tmp_path, begin_s, lag_s):
    """A logger sends all day long; `lag_s` is how much later the speed comes than the others."""
    stream, found = sections(tmp_path, section_s=1200, late_s=10.0), []
    coming = [(at, frame(at, k)) for k, at in enumerate(range(0, 4000, 5))]
    for at in range(0, 4000, 10):
        speed = 70.0 if begin_s <= at < begin_s + 600 else 0.0
        coming.append((at + lag_s, speed_frame(at, speed)))
    for k, (_, one) in enumerate(sorted(coming, key=lambda one: one[0])):
        assert taken(stream, encode(one)) == ""
        found += stream.over()
        if k % 300 == 299:
            stream = gone_on(stream, sections(tmp_path, section_s=1200, late_s=10.0))
    found += stream.close()
    begins = [(one.begin_ns - ZERO_NS) // 10**9 for one in found]
    assert begins[0] == 0
    assert len(found) >= 4
    (holds,) = {max(b for b in begins if b <= at) for at in (begin_s + 15, begin_s + 599)}
    assert all(one.end_ns - one.begin_ns <= 1500 * 10**9 for one in found)
    again = [b for b in begins if b < holds]
    assert again == [400 * k for k in range(len(again))]  # while it stands, from a third on


def test_stream_that_has_ended_may_go_on(tmp_path):
    stream = sections(tmp_path)
    for k in range(4):
        stream.add(frame(20.0 * k, k))
    (one,) = stream.close()
    assert taken(stream, encode(frame(50.0, 4))) == "late"
    stream.add(frame(60.04, 5))  # the next sample
    (other,) = stream.close()
    assert (one.end_ns, other.begin_ns) == (ZERO_NS + 60_040_000_000,) * 2


def test_clock_that_was_far_ahead_and_is_right_again_is_believed(tmp_path):
    stream, ahead_s = sections(tmp_path), 1e8
    for k in range(400):
        stream.add(frame(ahead_s + k, k))
        stream.over()
    for k in range(WINDOW):
        assert taken(stream, encode(frame(0.04 * k, 400 + k))) == "late"
    assert taken(stream, encode(frame(0.04 * WINDOW, 400 + WINDOW))) == ""


def test_frames_of_wrong_times_close_nothing_and_are_bounded(tmp_path):
    stream = sections(tmp_path)
    for k in range(200):
        assert taken(stream, encode(frame(0.04 * k, k))) == ""
        if k % 20 == 10:
            wrong = frame(1e6 * k, 1000 + k)
            assert taken(stream, encode(wrong)) == ""
        assert stream.over() == []
        assert len(stream.state()["open"]) <= MAX_OPEN
    (first, *_) = stream.close()
    assert first.begin_ns == ZERO_NS
    assert first.n_frames == 200
    assert stream.counts["dropped"] == 10 + 1 - MAX_OPEN


# failure


def test_frame_longer_than_a_section_is_refused(tmp_path):
    with pytest.raises(FrameError, match="longer than a section of 200 s"):
        sections(tmp_path).add(frame(0.0, 0, n=50001))


@pytest.mark.parametrize(
    "changes",
    [{"section_s": 10}, {"late_s": -1.0}, {"pause_s": 1.0}, {"late_s": 61.0, "pause_s": 60.0}],
)
def test_settings_out_of_range_are_refused(tmp_path, changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        sections(tmp_path, **changes)
