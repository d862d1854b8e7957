from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from suspnet.trains.recordings.frames import (
    MOST_BYTES,
    MOST_SAMPLES,
    Frame,
    FrameError,
    decode,
    encode,
)

REASONS = ("size", "foreign", "truncated", "sensor", "rate", "unit", "time", "sequence", "nan")
"""Reasons to refuse a frame by itself, whatever came before."""
SAMPLES = np.arange(1000, dtype="f4")
FRAME = Frame("front left", "axle_box", 5, 1_700_000_000_000_000_000, 5000.0, "m/s2", SAMPLES)


def stream(samples=None, names=("samples",), options=None, n_batches=1, **metadata):
    """Return an Arrow IPC stream that may be no frame."""
    array = pa.array(SAMPLES if samples is None else samples)
    said = dict(pa.ipc.open_stream(encode(FRAME)).schema.metadata)
    said |= {key.encode(): value for key, value in metadata.items()}
    said = {key: value for key, value in said.items() if value is not None}
    schema = pa.schema([pa.field(name, array.type) for name in names], metadata=said)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema, options=options) as writer:
        for _ in range(n_batches):
            writer.write_batch(pa.record_batch([array] * len(names), schema=schema))
    return sink.getvalue().to_pybytes()


# reference


def test_frame_of_pyarrow_alone_is_read():
    found = decode(stream())
    assert replace(found, samples=SAMPLES) == FRAME
    np.testing.assert_array_equal(found.samples, SAMPLES)


# property


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_frame_is_read_as_it_was_written(dtype):
    samples = np.random.default_rng(0).normal(size=333).astype(dtype)
    rate_hz = 1000 / 3
    found = decode(encode(replace(FRAME, samples=samples, rate_hz=rate_hz)))
    assert found.samples.dtype == samples.dtype
    np.testing.assert_array_equal(found.samples, samples)
    assert found.rate_hz == rate_hz
    assert found.time_ns == FRAME.time_ns


def test_largest_frame_fits_in_the_largest_size():
    long = "x" * 100
    frame = Frame(long, long, 2**53 - 1, 2**62 - 1, 0.1 + 0.2, "m/s2", np.ones(MOST_SAMPLES))
    assert len(encode(frame)) <= MOST_BYTES
    assert decode(encode(frame)).suspension == long


def test_altered_bytes_give_a_frame_or_a_reason():
    rng, good = np.random.default_rng(0), encode(FRAME)
    reasons = set()
    for _ in range(2000):
        data = bytearray(good)
        if rng.random() < 0.3:
            data = data[: rng.integers(len(data))]
        else:
            for place in rng.integers(700, size=rng.integers(1, 6)):
                data[place] = rng.integers(256)
        try:
            assert len(decode(bytes(data)).samples) <= MOST_SAMPLES
        except FrameError as error:
            reasons.add(error.reason)
    assert {"foreign", "truncated"} <= reasons <= set(REASONS)


# failure


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_compressed_batch_is_refused(compression):
    data = stream(options=pa.ipc.IpcWriteOptions(compression=compression))
    with pytest.raises(FrameError, match="not compressed") as error:
        decode(data)
    assert error.value.reason == "foreign"


@pytest.mark.parametrize(
    ("reason", "data"),
    [
        ("size", lambda: bytes(MOST_BYTES + 1)),
        ("size", lambda: stream(np.empty(0, "f4"))),
        ("foreign", lambda: b""),
        ("foreign", lambda: b'{"sensor": "bogie"}'),
        ("foreign", lambda: stream(names=("samples", "more"))),
        ("foreign", lambda: stream(names=("values",))),
        ("foreign", lambda: stream(np.arange(3))),
        ("truncated", lambda: stream(n_batches=0)),
        ("truncated", lambda: encode(FRAME)[:-2000]),
        ("sensor", lambda: stream(sensor=None)),
        ("sensor", lambda: stream(sensor=b"")),
        ("sensor", lambda: stream(sensor=b"x" * 300)),
        ("sensor", lambda: stream(sensor=b"a\nb")),
        ("sensor", lambda: stream(suspension=b"\xff")),
        ("sequence", lambda: stream(sequence=b"-1")),
        ("sequence", lambda: stream(sequence=b"9" * 30)),
        ("sequence", lambda: stream(sequence=b"1.5")),
        ("time", lambda: stream(time_ns=b"now")),
        ("time", lambda: stream(time_ns=b"-5")),
        ("rate", lambda: stream(rate_hz=b"nan")),
        ("rate", lambda: stream(rate_hz=b"0")),
        ("rate", lambda: stream(rate_hz=b"1e9")),
        ("unit", lambda: stream(unit=None)),
        ("nan", lambda: stream(np.array([1.0, np.nan]))),
        ("nan", lambda: stream(np.array([1.0, -np.inf]))),
        ("nan", lambda: stream(pa.array([1.0, None]))),
    ],
)
def test_bad_bytes_have_a_reason(reason, data):
    with pytest.raises(FrameError, match=r"`|frame|batch|stream|samples") as error:
        decode(data())
    assert error.value.reason == reason
    assert reason in REASONS
