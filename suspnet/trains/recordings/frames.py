"""Frames: consecutive samples of one sensor, as a logger sends them.

A frame is one message of the Arrow IPC streaming format: a schema with one column ``samples`` of
float32 or float64, whose metadata hold the other fields of `Frame`, then one record batch. Frames
are not trusted: their size is limited before they are read, and compressed batches, which could
declare any size, are refused.
"""

import math
import struct
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.dates import SECOND_NS

MOST_SAMPLES = 2**16  # largest number of samples of a frame: 13 s at 5000 Hz
MOST_BYTES = 8 * MOST_SAMPLES + 2**13
"""Largest size of an encoded frame [bytes]: samples in double precision, plus 8 KiB."""
MOST_CHARACTERS = 200  # largest length of each text in a frame
MOST_SEQUENCE, MOST_NS = 2**53, 2**62
"""Bounds of sequence number and time [ns]: exact in every language, and before the year 2117."""
RATES_HZ = (0.01, 1e6)  # lowest and highest rate of a sensor, [Hz]
BORDER_SAMPLES = 1e-3
"""A sample this close before a border, [samples], counts as on it, as times are whole
nanoseconds."""


class FrameError(ValueError):
    """A frame cannot be used; the message explains why, `reason` is one word."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class Frame:
    """Consecutive samples of one sensor; FrameError if a value is out of range or not finite.

    `suspension` is written as its ``Place``: "train 1, car 2, front, left". `sensor` is the
    channel, followed by the side in a pair: "axle_box", "bogie left"; or "speed". `sequence` is one
    more than that of the sensor's previous frame. `time_ns` is that of the first sample, since 1970
    in UTC. `unit` is that of `samples` (n_samples,), float32 or float64, as files write it.
    """

    suspension: str
    sensor: str
    sequence: int
    time_ns: int
    rate_hz: float
    unit: str
    samples: FloatArray

    def __post_init__(self) -> None:
        for reason, text in (("sensor", self.suspension + self.sensor), ("unit", self.unit)):
            if not text.isprintable() or len(text) > MOST_CHARACTERS:
                raise FrameError(reason, f"`{reason}` must be short plain text, got {text[:80]!r}")
        if not self.sensor:
            raise FrameError("sensor", "`sensor` is empty")
        if not 0 <= self.sequence < MOST_SEQUENCE:
            raise FrameError("sequence", f"`sequence` must be in 0 to 2^53, got {self.sequence}")
        if not 0 <= self.time_ns < MOST_NS:
            raise FrameError("time", f"`time_ns` must be in 0 to 2^62, got {self.time_ns}")
        if not RATES_HZ[0] <= self.rate_hz <= RATES_HZ[1]:  # NaN is not
            raise FrameError("rate", f"`rate_hz` must be in 0.01 to 1e6, got {self.rate_hz}")
        if self.samples.ndim != 1 or not 1 <= len(self.samples) <= MOST_SAMPLES:
            shape = self.samples.shape
            raise FrameError("size", f"a frame has 1 to {MOST_SAMPLES} samples, got {shape}")
        if not np.isfinite(self.samples).all():
            n_bad = int(np.count_nonzero(~np.isfinite(self.samples)))
            raise FrameError("nan", f"{n_bad} of {len(self.samples)} samples are NaN or infinite")


def end_ns(frame: Frame) -> int:
    """Return the end of a frame and start of the next, [ns] since 1970."""
    return frame.time_ns + round(len(frame.samples) * SECOND_NS / frame.rate_hz)


def n_before(frame: Frame, time_ns: int) -> int:
    """Return how many samples of a frame lie before a time."""
    n = math.ceil((time_ns - frame.time_ns) * frame.rate_hz / SECOND_NS - BORDER_SAMPLES)
    return min(max(n, 0), len(frame.samples))


def frame_from(frame: Frame, n: int, border_ns: int) -> Frame | None:
    """Return a frame without its first `n` samples, which lie before a border."""
    if n >= len(frame.samples):
        return None
    if n == 0:
        return replace(frame, time_ns=max(frame.time_ns, border_ns))
    time_ns = frame.time_ns + round(n * SECOND_NS / frame.rate_hz)
    return replace(frame, time_ns=time_ns, samples=frame.samples[n:])


def encode(frame: Frame) -> bytes:
    """Return a frame as one Arrow IPC stream."""
    metadata = {
        "suspension": frame.suspension,
        "sensor": frame.sensor,
        "sequence": str(frame.sequence),
        "time_ns": str(frame.time_ns),
        "rate_hz": repr(float(frame.rate_hz)),
        "unit": frame.unit,
    }
    array = pa.array(frame.samples)
    schema = pa.schema([pa.field("samples", array.type, nullable=False)], metadata=metadata)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as writer:
        writer.write_batch(pa.record_batch([array], schema=schema))
    return bytes(sink.getvalue().to_pybytes())


def decode(data: bytes) -> Frame:
    """Return the frame of an Arrow IPC stream, as `encode` writes it.

    Raises FrameError if it is too long, truncated or of another format, or a value is out of range.
    """
    if len(data) > MOST_BYTES:
        raise FrameError("size", f"a frame has at most {MOST_BYTES} bytes, got {len(data)}")
    reader = pa.BufferReader(data)
    try:
        schema = pa.ipc.read_schema(reader)
        is_frame = schema.names == ["samples"] and schema.types[0] in (pa.float32(), pa.float64())
    except (pa.ArrowException, OSError, ValueError) as error:
        raise FrameError("foreign", f"no Arrow IPC stream: {error}") from None
    if not is_frame:
        raise FrameError("foreign", "a frame has one column `samples` of float32 or float64")
    samples = _samples(reader, schema)
    return Frame(samples=samples, **_described(schema.metadata or {}))


def _samples(reader: pa.BufferReader, schema: pa.Schema) -> FloatArray:
    try:
        message = pa.ipc.read_message(reader)
        if message.type != "record batch" or _is_compressed(bytes(message.metadata)):
            raise FrameError("foreign", "a frame has one record batch, which is not compressed")
        batch = pa.ipc.read_record_batch(message, schema)
        batch.validate(full=True)
        column = batch.column(0)
        if column.null_count:
            raise FrameError("nan", f"{column.null_count} of {len(column)} samples are missing")
        return np.asarray(column.to_numpy())
    except (pa.ArrowException, OSError, EOFError, ValueError, struct.error) as error:
        if isinstance(error, FrameError):
            raise
        raise FrameError("truncated", f"the record batch is truncated: {error}") from None


def _is_compressed(metadata: bytes) -> bool:
    """Return whether the message of a record batch declares a compression of its body.

    Messages are flatbuffers: field 2 of the table Message is the table RecordBatch, whose field 3
    is the compression (Arrow's Message.fbs). struct.error if an offset points outside.
    """
    (root,) = struct.unpack_from("<I", metadata)
    header = flatbuffer_field(metadata, root, 2)
    if header is None:
        return False
    (to_batch,) = struct.unpack_from("<I", metadata, header)
    return flatbuffer_field(metadata, header + to_batch, 3) is not None


def flatbuffer_field(buffer: bytes, table: int, number: int) -> int | None:
    """Return the offset of a field of a flatbuffer's table; None if the table lacks it."""
    (to_vtable,) = struct.unpack_from("<i", buffer, table)
    vtable = table - to_vtable
    if vtable < 0:
        raise struct.error("a table begins before the message")
    (size,) = struct.unpack_from("<H", buffer, vtable)
    at = 4 + 2 * number
    if at + 2 > size:
        return None
    (offset,) = struct.unpack_from("<H", buffer, vtable + at)
    return table + int(offset) if offset else None


def _described(metadata: dict[bytes, bytes]) -> dict[str, Any]:
    """Return all fields of a frame but its samples; FrameError if one is missing or wrong."""
    fields: dict[str, Any] = {}
    kinds = {"sequence": ("sequence", int), "time_ns": ("time", int), "rate_hz": ("rate", float)}
    for name in ("suspension", "sensor", "unit", *kinds):
        reason, kind = kinds.get(name, ("unit" if name == "unit" else "sensor", str))
        try:
            text = metadata[name.encode()].decode()
            if len(text) > MOST_CHARACTERS:
                raise ValueError(f"{len(text)} characters")
            fields[name] = kind(text)
        except (KeyError, ValueError) as error:
            problem = f"`{name}` is missing or no {kind.__name__}: {error}"
            raise FrameError(reason, problem) from None
    return fields
