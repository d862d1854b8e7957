"""Interface of a source of frames, and how a stream of bytes is divided into frames.

Frames are found by Arrow's own framing: an encapsulated message of the Arrow IPC format is
0xFFFFFFFF, the length of its metadata (a little-endian int32, a multiple of 8), the metadata (a
flatbuffer, which holds the length of the body) and the body. A frame consists of a schema message,
one record batch message, and the end mark 0xFFFFFFFF 0x00000000. The content of a frame is checked
later, by `suspnet.trains.recordings.frames.decode`.
"""

from __future__ import annotations

import json
import os
import re
import select
import struct
import sys
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal, Protocol

from suspnet.trains.recordings.frames import MOST_BYTES, FrameError, flatbuffer_field

ResultKind = Literal["estimates", "alarms"]


class FrameSource(Protocol):
    """Interface of a source of encoded frames, which also takes results.

    A source is made from its settings, which it checks, and opens nothing before `subscribe`. All
    methods are called by one thread. Frames are delivered at least once: what was received but not
    confirmed is delivered again after a restart, if the sender stores it.
    """

    @property
    def counts(self) -> Counter[str]:
        """Counts of invalid input and of transport events, by a reason of one word."""

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Open the source; return the suspensions served: all, or those of this process.

        It is called before the first `receive`, and raises OSError or ValueError if that fails.
        """

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return the encoded frames that have arrived, unchecked, as soon as there are any.

        The list is empty after `timeout_s` [s]; None is the end of the source.
        """

    def confirm(self, n_frames: int | None = None) -> None:
        """Let the source forget the next `n_frames` that it returned; None: all so far."""

    def publish(self, kind: ResultKind, suspension: str, message: bytes) -> None:
        """Publish a result, a JSON object, of one suspension; never wait for a network."""

    def close(self) -> None:
        """Release resources; frames that were not confirmed are delivered again."""


def plain_json(message: bytes) -> dict[str, Any]:
    """Return a JSON object's content, null for NaN and infinity; ValueError if it is not one."""
    content = json.loads(message, parse_constant=lambda _: None)
    if not isinstance(content, dict):
        raise ValueError(f"a result is a JSON object, got {message[:80]!r}")
    return content


def print_result(kind: ResultKind, suspension: str, message: bytes) -> None:
    """Write a result to standard output, as one line of JSON with kind and suspension first."""
    row = {"kind": kind, "suspension": suspension, **plain_json(message)}
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()


CONTINUATION = b"\xff\xff\xff\xff"
END = CONTINUATION + bytes(4)
PREFIX_BYTES = len(END)
MULTIPLES_OF_8 = re.escape(bytes(range(0, 256, 8)))
BEGIN = re.compile(
    CONTINUATION + rb"(?!\x00\x00)[" + MULTIPLES_OF_8 + rb"][\x00-\xff]\x00\x00", re.DOTALL
)
"""Start of a message with less than 64 KiB of metadata."""
SCHEMA, RECORD_BATCH = 1, 3  # numbers of message types in Arrow's Message.fbs


class Splitter:
    """Divides a stream of bytes, in pieces of any size, into encoded frames.

    After invalid bytes it continues at the next place where a frame starts, even inside a frame
    that started and never ended. It holds at most ``MOST_BYTES`` and one piece. `counts` has the
    stretches of invalid bytes between two frames, by the first reason: "foreign", "size" (larger
    than any frame), "truncated" (shorter than declared).

    >>> import numpy as np
    >>> from suspnet.trains.recordings.frames import Frame, encode
    >>> frame = encode(Frame("car 2", "body", 7, 0, 100.0, "g", np.zeros(100)))
    >>> splitter = Splitter()
    >>> splitter.push(b"noise" + frame + frame[:50]) == [frame]
    True
    >>> splitter.push(frame[50:]) == [frame]
    True
    >>> splitter.counts
    Counter({'foreign': 1})
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._buffer = bytearray()
        self._is_lost = False

    def push(self, data: bytes) -> list[bytes]:
        """Take the next bytes; return the frames that end in them."""
        self._buffer += data
        return self._frames(at_end=False)

    def finish(self) -> list[bytes]:
        """Return the remaining frames at the end of the stream; count one that is cut off."""
        return self._frames(at_end=True)

    def _frames(self, at_end: bool) -> list[bytes]:
        """Take the whole frames out of the buffer."""
        frames: list[bytes] = []
        at = 0
        while len(self._buffer) - at >= PREFIX_BYTES:  # ends: each round advances by a byte or more
            # skip to the next place where a frame may start
            begin = BEGIN.search(self._buffer, at)
            start = len(self._buffer) - PREFIX_BYTES + 1 if begin is None else begin.start()
            if start > at:
                self._lose("foreign")
                at = start
            if begin is None:
                break
            try:
                length = self._length(at)
            except FrameError as error:
                self._lose(error.reason)
                at += 1
                continue
            if length is not None:
                frames.append(bytes(self._buffer[at : at + length]))
                self._is_lost = False
                at += length
            elif at_end:  # the frame is cut off; another may start inside it
                self._lose("truncated")
                at += 1
            else:
                break
        del self._buffer[:at]
        if at_end and self._buffer:
            self._lose("truncated")
            self._buffer.clear()
        return frames

    def _lose(self, reason: str) -> None:
        """Count bytes that are not a frame, once until the next frame."""
        if not self._is_lost:
            self.counts[reason] += 1
        self._is_lost = True

    def _length(self, start: int) -> int | None:
        """Return the length of the frame at `start`, None if incomplete; FrameError if none."""
        end = start
        for kind in (SCHEMA, RECORD_BATCH):
            if len(self._buffer) < end + PREFIX_BYTES:
                return None
            begin = BEGIN.match(self._buffer, end)
            if begin is None:
                raise FrameError("truncated", "no record batch follows the schema")
            (n_metadata,) = struct.unpack_from("<i", self._buffer, end + len(CONTINUATION))
            end = begin.end() + n_metadata
            if len(self._buffer) < end:
                return None
            end += _body_bytes(bytes(self._buffer[begin.end() : end]), kind)
            if end + PREFIX_BYTES - start > MOST_BYTES:
                raise FrameError("size", f"a frame has at most {MOST_BYTES} bytes")
        end += PREFIX_BYTES
        if len(self._buffer) < end:
            return None
        if self._buffer[end - PREFIX_BYTES : end] != END:
            raise FrameError("truncated", "no mark of the end follows the record batch")
        return end - start


def _body_bytes(metadata: bytes, kind: int) -> int:
    """Return the length of a message's body; FrameError if it is of another kind or damaged."""
    try:
        (root,) = struct.unpack_from("<I", metadata)
        type_, length = (flatbuffer_field(metadata, root, number) for number in (1, 3))
        (of_kind,) = (0,) if type_ is None else struct.unpack_from("<B", metadata, type_)
        (n_body,) = (0,) if length is None else struct.unpack_from("<q", metadata, length)
    except struct.error as error:
        raise FrameError("foreign", f"the metadata of a message are damaged: {error}") from None
    if of_kind != kind or n_body < 0 or (kind == SCHEMA and n_body):
        raise FrameError("foreign", "a frame is a schema and one record batch")
    return int(n_body)


PIECE_BYTES = 2**16  # largest number of bytes read at once: the capacity of a pipe on Linux


class Pipe:
    """Source of the frames on standard input.

    A pipe cannot be read twice: after a kill, the sender must resend what was not yet stored.
    Nothing is read ahead, so that a sender that is too fast waits.
    """

    def __init__(self) -> None:
        self._splitter = Splitter()
        self._has_ended = False

    @property
    def counts(self) -> Counter[str]:
        """Counts of `Splitter.counts`, and "unreadable" if a failed read ended the input."""
        return Counter(self._splitter.counts)

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Return all suspensions: they belong to this process. See `FrameSource`."""
        if sys.stdin is None:
            raise ValueError("source=stdin needs a standard input, which is closed")
        return suspensions

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return the next frames; None after the end of the input. See `FrameSource`."""
        end_s = time.monotonic() + timeout_s
        while not self._has_ended:  # ends: with frames, the input, or the time
            wait_s = max(end_s - time.monotonic(), 0.0)
            if not select.select([sys.stdin], [], [], wait_s)[0]:
                return []
            if frames := self._read():
                return frames
        return None

    def confirm(self, n_frames: int | None = None) -> None:
        """Do nothing: a pipe cannot resend."""

    def publish(self, kind: ResultKind, suspension: str, message: bytes) -> None:
        """Write a line of JSON to standard output."""
        print_result(kind, suspension, message)

    def close(self) -> None:
        """End the input."""
        self._has_ended = True

    def _read(self) -> list[bytes]:
        try:
            data = os.read(sys.stdin.fileno(), PIECE_BYTES)
        except OSError:
            self._splitter.counts["unreadable"] += 1
            data = b""
        if data:
            return self._splitter.push(data)
        self._has_ended = True
        return self._splitter.finish()
