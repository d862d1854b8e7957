from dataclasses import replace

import numpy as np
import pytest
import torch
from stream_signals import (
    RATES_HZ,
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

from suspnet.curves.welch import Welch
from suspnet.depot.live.journal import StateError, dump_state, load_state
from suspnet.trains.recordings import cleaning
from suspnet.trains.recordings.assembler import OrderSettings
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.frames import Frame, encode
from suspnet.trains.recordings.running import Running
from suspnet.trains.spectra.segments import recording_segments

ORDER = OrderSettings(window=WINDOW)
FAST, SLOW = range(1), range(1, 230)


@pytest.fixture(autouse=True)
def _small_windows(monkeypatch):
    """Let windows of cleaning be as many in these short signals as in long ones."""
    monkeypatch.setattr(cleaning, "CORE_SAMPLES", 3000)


def running(folder, **changes):
    return Running(manifest_in(folder), ZERO_NS, order=ORDER, **changes)


def case(folder, seed):
    """Return the batch's recording and the encoded frames of the same samples."""
    rng = np.random.default_rng(seed)
    columns, parts = signals(seed), []
    for name, samples in columns.items():
        most = int(rng.choice([20, 60, 400, 3000]) if name != "speed" else 20)
        n_lost = int(rng.integers(0, 3)) if len(samples) > 4 * most else 0
        frames = frames_of(name, samples, rng, RATES_HZ[name], n_lost, most=most)
        columns[name] = with_gaps(samples, frames, name, RATES_HZ[name])
        parts.append(disturbed(frames, rng))
    return batch(manifest_in(folder), columns), encoded(interleaved(parts, rng)), rng


def assert_same(found, expected):
    np.testing.assert_allclose(found.signals, expected.signals, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found.usable, expected.usable)
    np.testing.assert_array_equal(found.speed_m_per_s, expected.speed_m_per_s)
    assert found.start_s == expected.start_s
    assert found.duration_s == expected.duration_s
    # sums over blocks are those of the batch, as the windows are: words agree to the last digit
    assert found.faults == expected.faults


def check_case(folder, seed):
    expected, frames, rng = case(folder, seed)
    stream = running(folder)
    saved = set(rng.integers(len(frames), size=3).tolist())
    for k, data in enumerate(frames):
        assert taken(stream, data) == ""
        if k in saved:
            stream = gone_on(stream, running(folder))
    stream.flush()
    assert_same(stream.recording(), expected)
    return stream, expected


# reference


@pytest.mark.parametrize("seed", FAST)
def test_stream_equals_batch_under_any_chunking(tmp_path, seed):
    stream, expected = check_case(tmp_path, seed)
    assert 0 < expected.usable.mean() < 1
    for name, counts in stream.sensors.items():
        assert counts["taken"] > 0
        assert counts["clock"] == counts["far"] == counts["restart"] == counts["late"] == 0
        assert counts["gap"] <= counts["missing"], name
    assert_same_cross_spectra(stream, expected)


def assert_same_cross_spectra(stream, expected):
    welch = Welch(segment_s=10.0)
    found, wanted = (recording_segments(r, welch) for r in (stream.recording(), expected))
    assert len(wanted.values) >= 3
    assert torch.equal(found.first, wanted.first)
    every = torch.ones(len(wanted.values), dtype=torch.bool)
    for one, other in zip(
        (found.average(every).auto, found.average(every).cross),
        (wanted.average(every).auto, wanted.average(every).cross),
        strict=True,
    ):
        assert float((one - other).abs().amax()) <= 1e-10 * float(other.abs().amax())


def test_recording_so_far_is_that_of_the_samples_so_far_and_changes_nothing(tmp_path):
    rng, columns = np.random.default_rng(5), signals(5)
    parts = {n: frames_of(n, s, rng, RATES_HZ[n], most=20) for n, s in columns.items()}
    stream = running(tmp_path)
    cut_s = 80.0
    later = []
    for name, frames in parts.items():
        end_ns = ZERO_NS + cut_s * 1e9
        early = [f for f in frames if f.time_ns < end_ns]
        later += frames[len(early) :]
        columns[name] = columns[name][: sum(len(f.samples) for f in early)]
        for frame in early:
            stream.add(frame)
    assert_same(stream.recording(), batch(manifest_in(tmp_path), columns))
    for frame in later:
        stream.add(frame)
    assert_same(stream.recording(), batch(manifest_in(tmp_path), signals(5)))


def test_frames_of_the_other_axle_are_those_of_its_sensor(tmp_path):
    manifest, columns = manifest_in(tmp_path), signals(3)
    box = manifest.channels["axle_box"]
    channels = {**manifest.channels, "axle_box": (box, replace(box, axle=2))}
    stream = Running(replace(manifest, channels=channels), ZERO_NS, order=ORDER)
    rng = np.random.default_rng(0)
    for name, samples in columns.items():
        for frame in frames_of(name, samples, rng, RATES_HZ[name], most=400):
            stream.add(frame)
            if name == "axle_box":
                stream.add(replace(frame, sensor="axle_box axle2"))
    stream.flush()
    found = stream.recording()
    expected = batch(manifest_in(tmp_path), columns)
    np.testing.assert_allclose(found.signals, expected.signals, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found.elsewhere["axle_box axle2"], found.signals[0])


def test_rate_of_a_column_of_times_is_near_the_stated_one(tmp_path):
    manifest = manifest_in(tmp_path)
    bogie = replace(manifest.channels["bogie"], time="t")
    stream = Running(replace(manifest, channels={**manifest.channels, "bogie": bogie}), ZERO_NS)
    assert taken(stream, encode(replace(GOOD, rate_hz=260.0))) == "rate"
    assert taken(stream, encode(replace(GOOD, rate_hz=249.5))) == ""
    assert taken(stream, encode(replace(GOOD, rate_hz=250.0, sequence=1))) == "rate"


# property


def test_memory_of_pending_samples_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(cleaning, "CORE_SAMPLES", 2000)
    stream = running(tmp_path)
    for frame in frames_of("axle_box", signals()["axle_box"], np.random.default_rng(0), 400.0):
        stream.add(frame)
        pending = stream.state()["sensors"]["axle_box"]["cleaner"]["pending"]
        assert len(pending) <= 2000 + 4 * 400 + 300  # a core, its context and a frame


def test_saved_state_of_an_empty_recording_is_restored(tmp_path):
    assert gone_on(running(tmp_path), running(tmp_path)).n_frames == 0


# failure

GOOD = Frame("front left", "bogie", 0, ZERO_NS + 10**9, 250.0, "m/s2", np.ones(10, "f4"))


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("sensor", {"sensor": "cabin"}),
        ("sensor", {"suspension": "rear left"}),
        ("unit", {"unit": "g"}),
        ("unit", {"unit": "furlong"}),
        ("rate", {"rate_hz": 251.0}),
        ("time", {"time_ns": ZERO_NS - 1}),
        ("time", {"time_ns": ZERO_NS + 10**13}),
    ],
)
def test_bad_frames_have_a_reason_and_the_stream_goes_on(tmp_path, reason, change):
    stream = running(tmp_path)
    assert taken(stream, encode(replace(GOOD, **change))) == reason
    assert taken(stream, encode(GOOD)) == ""


def test_bad_frames_in_between_do_not_change_the_result(tmp_path):
    expected, frames, rng = case(tmp_path, 3)
    stream = running(tmp_path)
    bad = [encode(replace(GOOD, sensor="cabin")), b"", b"ARROW1", frames[0][:-30]]
    for data in frames:
        taken(stream, data)
        if rng.random() < 0.3:
            assert taken(stream, bad[rng.integers(len(bad))])
    stream.flush()
    assert_same(stream.recording(), expected)


def test_recording_without_a_sensor_is_refused(tmp_path):
    stream = running(tmp_path)
    stream.add(GOOD)
    stream.flush()
    with pytest.raises(TripError, match="nothing has come from axle_box, body, speed"):
        stream.recording()


def test_manifests_that_no_stream_can_follow_are_refused(tmp_path):
    manifest = manifest_in(tmp_path)
    channels = {**manifest.channels, "body": replace(manifest.channels["body"], unit=None)}
    with pytest.raises(TripError, match="'body' has a `range`; write its `unit`"):
        Running(replace(manifest, channels=channels), ZERO_NS)
    with pytest.raises(TripError, match="'speed' needs"):
        Running(manifest_in(tmp_path, RATES_HZ | {"speed": 100.0}), ZERO_NS)


def test_state_of_other_settings_or_damaged_is_refused(tmp_path):
    stream = running(tmp_path)
    saved = dump_state(stream.identity, stream.state())
    other = Running(manifest_in(tmp_path), ZERO_NS + 10**9, order=ORDER)
    with pytest.raises(StateError, match="another stream"):
        load_state(saved, other.identity)
    with pytest.raises(StateError, match="is no state of a stream"):
        load_state(saved[:50], stream.identity)
