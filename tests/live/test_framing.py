"""Frames in a stream of bytes: however it is cut, and whatever is between them."""

import tracemalloc

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_frames import encoded, frame

from suspnet.depot.live.source import Splitter
from suspnet.trains.recordings.frames import MOST_BYTES, MOST_SAMPLES, encode

FRAMES = [
    *encoded(3),
    encode(frame(3, n=1)),
    encode(frame(4, n=1000, rate_hz=0.5, suspension="Zug 1, Wagen 2, führend")),
    encode(frame(5, samples=np.arange(7.0))),
]
LATER = encode(frame(2, n=20_000))


def split(data, sizes=()):
    """Return the frames of some bytes that come in pieces, and what was counted."""
    splitter, found, at = Splitter(), [], 0
    for size in [*sizes, len(data)]:
        found += splitter.push(data[at : at + size])
        at += size
    return found + splitter.finish(), dict(splitter.counts)


def stream(arrays, fields, end=True, **metadata):
    """Return an Arrow IPC stream of some record batches."""
    schema = pa.schema([pa.field(name, pa.float32()) for name in fields], metadata=metadata or None)
    sink = pa.BufferOutputStream()
    writer = pa.ipc.new_stream(sink, schema)
    for array in arrays:
        columns = [pa.array(array, pa.float32()) for _ in fields]
        writer.write_batch(pa.record_batch(columns, schema=schema))
    if end:
        writer.close()
    return sink.getvalue().to_pybytes()


@given(st.lists(st.integers(1, 900), max_size=40))
def test_frames_are_found_however_the_stream_is_cut(sizes):
    assert split(b"".join(FRAMES), sizes) == (FRAMES, {})


@given(
    st.lists(st.tuples(st.sampled_from(FRAMES), st.binary(min_size=0, max_size=30)), max_size=8),
    st.lists(st.integers(1, 900), max_size=20),
)
def test_frames_are_found_whatever_is_between_them(parts, sizes):
    data = b"".join(noise + one for one, noise in parts)
    found, counts = split(data, sizes)
    assert found == [one for one, _ in parts]
    assert sum(counts.values()) == sum(bool(noise) for _, noise in parts)


@settings(max_examples=50)
@given(st.data())
def test_damaged_frame_costs_no_other_one(data):
    damaged = bytearray(FRAMES[1])
    kind = data.draw(st.sampled_from(["cut", "changed", "filled"]))
    at = data.draw(st.integers(0, len(damaged) - 1))
    if kind == "cut":
        del damaged[at : at + data.draw(st.integers(1, len(damaged)))]
    elif kind == "changed":
        damaged[at] ^= data.draw(st.integers(1, 255))
    else:
        damaged[at:at] = data.draw(st.binary(min_size=1, max_size=50))
    # more bytes follow than a damaged length can claim
    after = [LATER] * (MOST_BYTES // len(LATER) + 1)
    found, counts = split(FRAMES[0] + bytes(damaged) + b"".join(after), [4096] * 200)
    assert found[0] == FRAMES[0]
    assert found[-len(after) :] == after
    assert len(found) <= len(after) + 2
    assert sum(counts.values()) <= 2


@given(st.binary(max_size=2000), st.lists(st.integers(1, 300), max_size=10))
def test_any_bytes_come_to_an_end(data, sizes):
    found, counts = split(data, sizes)
    assert found == []
    assert bool(counts) == bool(data)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (FRAMES[0][:-1], "truncated"),
        (FRAMES[0][:5], "truncated"),
        (FRAMES[0][:-8] + bytes(8), "truncated"),
        (stream([[1.0]], ["samples"], end=False), "truncated"),
        (stream([], ["samples"]), "truncated"),
        (stream([[1.0], [2.0]], ["samples"]), "truncated"),
        (stream([np.zeros(MOST_SAMPLES)] * 1, ["a", "b", "c"]), "size"),
        (b"a text\n" * 100, "foreign"),
        (b"\xff" * 10_000, "foreign"),
        (b"\xff\xff\xff\xff\x08\x00\x00\x00" * 1000, "foreign"),
        (b"\xff\xff\xff\xff\x00\x00\x00\x00" * 1000, "foreign"),
    ],
)
def test_what_is_no_frame_is_counted_once(data, reason):
    assert split(data) == ([], {reason: 1})
    found, counts = split(data + FRAMES[2], [13, 1000])
    assert found == [FRAMES[2]]
    assert sum(counts.values()) == 1


def test_largest_frame_is_one_and_memory_is_bounded():
    largest = encode(
        frame(0, n=MOST_SAMPLES, samples=np.random.default_rng(0).random(MOST_SAMPLES))
    )
    assert len(largest) <= MOST_BYTES
    splitter, n_found, piece = Splitter(), 0, 2**16
    data = (largest[:-9] + largest) * 3
    pieces = [data[at : at + piece] for at in range(0, len(data), piece)]
    tracemalloc.start()
    for one in pieces:
        n_found += splitter.push(one).count(largest)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert n_found == 3
    assert most <= 4 * MOST_BYTES  # the buffer, which grows by steps, and a frame of it
