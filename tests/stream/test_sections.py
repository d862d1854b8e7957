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

from suspnet.recordings import cleaning
from suspnet.stream import Frame, FrameError, Sections, encode
from suspnet.stream.assembler import OrderSettings
from suspnet.stream.sections import MOST_OPEN

ORDER = OrderSettings(window=WINDOW)
SECTION_S = 100
FIRST = ZERO_NS // 10**9 // SECTION_S


@pytest.fixture(autouse=True)
def _small_windows(monkeypatch):
    monkeypatch.setattr(cleaning, "CORE_SAMPLES", 3000)


def sections(folder, **changes):
    return Sections(manifest_in(folder), **({"section_s": SECTION_S, "order": ORDER} | changes))


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


@pytest.mark.parametrize("seed", range(4))
def test_sections_of_the_stream_are_those_of_the_batch(tmp_path, seed):
    rng, columns, parts = np.random.default_rng(seed), signals(seed, 330.0), []
    for name, samples in columns.items():
        most = 8 if name == "speed" else 400
        frames = frames_of(name, samples, rng, RATES_HZ[name], n_lost=2, most=most)
        columns[name] = with_gaps(samples, frames, name, RATES_HZ[name])
        parts.append(disturbed(frames, rng))
    stream, found = sections(tmp_path, late_s=40.0), []
    frames = encoded(interleaved(parts, rng))
    saved = set(rng.integers(len(frames), size=4).tolist())
    for k, data in enumerate(frames):
        taken(stream, data)
        found += stream.over()
        if k in saved:
            stream = gone_on(stream, sections(tmp_path, late_s=40.0))
    assert 1 <= len(found) <= 3
    found += stream.close()
    assert [one.zero_ns for one in found] == [ZERO_NS + k * 10**11 for k in range(4)]
    for number, running in enumerate(found[:3]):
        expected, one = batch_of_section(tmp_path, columns, number), running.recording()
        np.testing.assert_allclose(one.signals, expected.signals, rtol=1e-11, atol=1e-10)
        np.testing.assert_array_equal(one.usable, expected.usable)
        np.testing.assert_allclose(one.speed_m_per_s, expected.speed_m_per_s, rtol=1e-12)
        assert one.start_s == expected.start_s
        assert [str(fault) for fault in one.faults] == [str(fault) for fault in expected.faults]


# property


def frame(seconds, sequence, n=10, sensor="bogie"):
    time_ns = ZERO_NS + round(seconds * 1e9)
    return Frame("front left", sensor, sequence, time_ns, 250.0, "m/s2", np.ones(n, "f4"))


def test_frame_is_divided_at_the_border(tmp_path):
    stream = sections(tmp_path)
    parts = list(stream._parts(frame(99.98, 0)))
    assert [(k - FIRST, len(part.samples)) for k, part in parts] == [(0, 5), (1, 5)]
    assert parts[1][1].time_ns == ZERO_NS + 100 * 10**9
    early = replace(frame(100.0, 0), time_ns=ZERO_NS + 100 * 10**9 - 1)
    ((number, part),) = stream._parts(early)
    assert number == FIRST + 1
    assert part.time_ns == ZERO_NS + 100 * 10**9
    assert len(part.samples) == 10


def test_section_is_over_when_enough_frames_have_passed_it(tmp_path):
    stream = sections(tmp_path)
    stream.add(frame(50.0, 0))
    for k in range(WINDOW + 1):
        assert stream.over() == []
        stream.add(frame(110.0 + k, 1 + k))
    assert [one.zero_ns for one in stream.over()] == [ZERO_NS]
    assert stream.over() == []
    assert taken(stream, encode(frame(99.0, 100))) == "late"


def test_frames_of_wrong_times_close_nothing_and_are_bounded(tmp_path):
    stream = sections(tmp_path)
    for k in range(200):
        assert taken(stream, encode(frame(0.04 * k, k))) == ""
        if k % 20 == 10:
            wrong = frame(1e6 * k, 1000 + k)
            assert taken(stream, encode(wrong)) == ""
        assert stream.over() == []
        assert len(stream._open) <= MOST_OPEN
    (first, *_) = stream.close()
    assert first.zero_ns == ZERO_NS
    assert first.n_frames == 200
    assert stream.counts["dropped"] == 10 + 1 - MOST_OPEN


def test_stream_that_has_ended_gives_all_and_then_nothing(tmp_path):
    stream = sections(tmp_path)
    stream.add(frame(50.0, 0))
    assert len(stream.close()) == 1
    assert stream.close() == []


# failure


def test_frame_longer_than_a_section_is_refused(tmp_path):
    with pytest.raises(FrameError, match="longer than a section of 100 s"):
        sections(tmp_path).add(frame(0.0, 0, n=25001))


def test_refused_frames_open_no_section(tmp_path):
    stream = sections(tmp_path)
    assert taken(stream, encode(frame(0.0, 0, sensor="cabin"))) == "sensor"
    assert stream.close() == []


@pytest.mark.parametrize("changes", [{"section_s": 10}, {"late_s": -1.0}])
def test_settings_out_of_range_are_refused(tmp_path, changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        sections(tmp_path, **changes)
