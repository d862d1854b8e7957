"""Frames in the content of a file, whatever is between them."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_frames import encoded, frame

from suspnet.depot.live.drop_folder import split
from suspnet.trains.recordings.frames import MOST_BYTES, MOST_SAMPLES, encode

FRAMES = [
    *encoded(3),
    encode(frame(3, n=1)),
    encode(frame(4, n=1000, rate_hz=0.5, suspension="Zug 1, Wagen 2, führend")),
    encode(frame(5, samples=np.arange(7.0))),
]


def stream(arrays, fields, end=True):
    """Return an Arrow IPC stream of some record batches."""
    schema = pa.schema([pa.field(name, pa.float32()) for name in fields])
    sink = pa.BufferOutputStream()
    writer = pa.ipc.new_stream(sink, schema)
    for array in arrays:
        columns = [pa.array(array, pa.float32()) for _ in fields]
        writer.write_batch(pa.record_batch(columns, schema=schema))
    if end:
        writer.close()
    return sink.getvalue().to_pybytes()


@given(st.lists(st.tuples(st.sampled_from(FRAMES), st.binary(min_size=0, max_size=30)), max_size=8))
def test_frames_are_found_whatever_is_between_them(parts):
    found, problem = split(b"".join(noise + one for one, noise in parts))
    assert found == [one for one, _ in parts]
    assert bool(problem) == any(noise for _, noise in parts)


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
    after = [FRAMES[2]] * 3
    found, _ = split(FRAMES[0] + bytes(damaged) + b"".join(after))
    assert found[0] == FRAMES[0]
    assert found[-len(after) :] == after
    assert len(found) <= len(after) + 2


@given(st.binary(max_size=2000))
def test_any_bytes_come_to_an_end(data):
    found, problem = split(data)
    assert found == []
    assert bool(problem) == bool(data)


@pytest.mark.parametrize(
    "data",
    [
        FRAMES[0][:-1],
        FRAMES[0][:5],
        FRAMES[0][:-8] + bytes(8),
        stream([[1.0]], ["samples"], end=False),
        stream([], ["samples"]),
        stream([[1.0], [2.0]], ["samples"]),
        stream([np.zeros(MOST_SAMPLES)] * 1, ["a", "b", "c"]),
        b"a text\n" * 100,
        b"\xff" * 10_000,
        b"\xff\xff\xff\xff\x08\x00\x00\x00" * 1000,
        b"\xff\xff\xff\xff\x00\x00\x00\x00" * 1000,
    ],
)
def test_what_is_no_frame_is_a_problem_at_its_place(data):
    assert split(FRAMES[2] + data) == ([FRAMES[2]], f"it is damaged at byte {len(FRAMES[2])}")
    assert split(data + FRAMES[2]) == ([FRAMES[2]], "it is damaged at byte 0")


def test_largest_frame_is_one():
    samples = np.random.default_rng(0).random(MOST_SAMPLES)
    largest = encode(frame(0, n=MOST_SAMPLES, samples=samples))
    assert len(largest) <= MOST_BYTES
    assert split((largest[:-9] + largest) * 2)[0] == [largest] * 2
