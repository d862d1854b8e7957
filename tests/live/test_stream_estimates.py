from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stream_signals import ZERO_NS, disturbed, encoded, interleaved, taken
from trip_fixtures import OUTPUTS, RATES_HZ, model_at, signal, write_trips

from suspnet.recordings import cleaning
from suspnet.recordings.frames import Frame
from suspnet.recordings.manifest import CHANNELS
from suspnet.recordings.manifest_files import read_manifest
from suspnet.recordings.recording import load_recording
from suspnet.recordings.running import Running

WINDOW = 16


@pytest.fixture(scope="module")
def trip(tmp_path_factory) -> Path:
    return write_trips(tmp_path_factory.mktemp("trip"), seed=3)[0]


def cut(name, samples, rate_hz, rng):
    """Return the frames of a channel, cut at random places."""
    starts = np.unique([0, *rng.integers(len(samples), size=200)])
    return [
        Frame("front left", name, k, ZERO_NS + round(start / rate_hz * 1e9), rate_hz, "m/s2", part)
        for k, (start, part) in enumerate(zip(starts, np.split(samples, starts[1:]), strict=True))
    ]


@pytest.mark.slow  # test_the_history_of_a_stream_is_that_of_the_files
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
def test_estimate_of_the_stream_is_that_of_the_batch(trip, tmp_path, monkeypatch, seed):
    monkeypatch.setattr(cleaning, "CORE_SAMPLES", 2**13)
    rng, model = np.random.default_rng(seed), model_at()
    read = read_manifest(trip)
    manifest = replace(read, suspension="front left")
    parts = [
        disturbed(cut(name, signal(trip, name), rate_hz, rng), rng, WINDOW)
        for name, rate_hz in zip(CHANNELS, RATES_HZ, strict=True)
    ]
    manifest = replace(manifest, speed=70.0)
    stream = Running(manifest, ZERO_NS)
    for data in encoded(interleaved(parts, rng)):
        assert taken(stream, data) == ""
    stream.flush()
    expected = model.estimate(load_recording(manifest))
    found = model.estimate(stream.recording())
    assert found.names == expected.names == OUTPUTS
    for one, other in (
        (found.values, expected.values),
        (found.low, expected.low),
        (found.high, expected.high),
    ):
        np.testing.assert_allclose(one, other, rtol=1e-10)
    assert found.flags.reasons == expected.flags.reasons
