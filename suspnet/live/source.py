"""Interface of a source of frames, and how a stream of bytes is divided into frames.

Frames are found by Arrow's own framing: an encapsulated message of the Arrow IPC format is
0xFFFFFFFF, the length of its metadata (a little-endian int32, a multiple of 8), the metadata (a
flatbuffer, which holds the length of the body) and the body. A frame consists of a schema message,
one record batch message, and the end mark 0xFFFFFFFF 0x00000000. The content of a frame is checked
later, by `suspnet.recordings.frames.decode`.
"""

from __future__ import annotations

import json
import os
import re
import select
import struct
import sys
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Protocol

from suspnet.ground.settings import Setting, check_values
from suspnet.recordings.frames import MOST_BYTES, FrameError, flatbuffer_field

Kind = Literal["estimates", "alarms"]


class Source(Protocol):
    """Interface of a source of encoded frames, which also takes results.

    A source is made from its settings, which it checks, and opens nothing before `subscribe`. All
    methods are called by one thread. Frames are delivered at least once: what was received but not
    confirmed is delivered again after a restart, if the sender stores it.
    """

    @property
    def counts(self) -> Counter[str]:
        """Counts of invalid input and of transport events, by a reason of one word."""
        ...

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Open the source; return the suspensions served: all, or this process's part.

        It is called before the first `receive`, and raises OSError or ValueError if that fails.
        """
        ...

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return encoded frames that have arrived, unchecked.

        It returns as soon as there are any; an empty list after `timeout_s` [s]; None at the end of
        the source.
        """
        ...

    def confirm(self, n_frames: int | None = None) -> None:
        """Let the source forget the next `n_frames` that it returned; None: all so far."""
        ...

    def publish(self, kind: Kind, suspension: str, message: bytes) -> None:
        """Publish a result, a JSON object, of one suspension; never wait for a network."""
        ...

    def close(self) -> None:
        """Release resources; frames that were not confirmed are delivered again."""
        ...


def plain_json(message: bytes) -> dict[str, Any]:
    """Return a JSON object's content, null for NaN and infinity; ValueError if it is not one."""
    found = json.loads(message, parse_constant=lambda _: None)
    if not isinstance(found, dict):
        raise ValueError(f"a result is a JSON object, got {message[:80]!r}")
    return found


def print_result(kind: Kind, suspension: str, message: bytes) -> None:
    """Write a result to standard output, as one line of JSON with kind and suspension first."""
    row = {"kind": kind, "suspension": suspension, **plain_json(message)}
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()


CONTINUATION = b"\xff\xff\xff\xff"
END = CONTINUATION + bytes(4)
PREFIX_BYTES = len(END)
BEGIN = re.compile(
    CONTINUATION
    + rb"(?!\x00\x00)["
    + re.escape(bytes(range(0, 256, 8)))
    + rb"][\x00-\xff]\x00\x00",
    re.DOTALL,
)
"""Start of a message with less than 64 KiB of metadata."""
SCHEMA, RECORD_BATCH = 1, 3
"""Numbers of message types in Arrow's Message.fbs."""


class Splitter:
    """Divides a stream of bytes, in pieces of any size, into encoded frames.

    After invalid bytes it continues at the next place where a frame starts, even inside a frame
    that started and never ended. It holds at most ``MOST_BYTES`` and one piece. `counts` has the
    stretches of invalid bytes between two frames, by the first reason: "foreign", "size" (larger
    than any frame), "truncated" (shorter than declared).

    >>> import numpy as np
    >>> from suspnet.recordings.frames import Frame, encode
    >>> one = encode(Frame("car 2", "body", 7, 0, 100.0, "g", np.zeros(100)))
    >>> splitter = Splitter()
    >>> splitter.push(b"noise" + one + one[:50]) == [one], splitter.push(one[50:]) == [one]
    (True, True)
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
        found: list[bytes] = []
        at = 0
        while len(self._buffer) - at >= PREFIX_BYTES:  # ends: each round advances by a byte or more
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
                found.append(bytes(self._buffer[at : at + length]))
                self._is_lost = False
                at += length
            elif at_end:
                self._lose("truncated")
                at += 1
            else:
                break
        del self._buffer[:at]
        if at_end and self._buffer:
            self._lose("truncated")
            self._buffer.clear()
        return found

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
        found, length = (flatbuffer_field(metadata, root, number) for number in (1, 3))
        (of_kind,) = (0,) if found is None else struct.unpack_from("<B", metadata, found)
        (n_body,) = (0,) if length is None else struct.unpack_from("<q", metadata, length)
    except struct.error as error:
        raise FrameError("foreign", f"the metadata of a message are damaged: {error}") from None
    if of_kind != kind or n_body < 0 or (kind == SCHEMA and n_body):
        raise FrameError("foreign", "a frame is a schema and one record batch")
    return int(n_body)


PIECE_BYTES = 2**16
"""Largest number of bytes read at once: the capacity of a pipe on Linux."""


class Pipe:
    """Source of the frames on standard input.

    A pipe cannot be read twice: after a kill, the sender must resend what was not yet stored.
    Reading stops while the buffer is full, so that a sender that is too fast waits.
    """

    settings: ClassVar[Mapping[str, Setting]] = {
        "buffer_mb": Setting(
            "Size of the frames that wait for the monitor; the sender waits beyond it",
            "MB",
            low=1,
            high=4096,
        )
    }

    def __init__(self, buffer_mb: float = 16.0) -> None:
        check_values(Pipe, buffer_mb=buffer_mb)
        self.buffer_mb = buffer_mb
        self._inbox = Inbox(round(buffer_mb * 1e6))
        self._splitter = Splitter()
        self._reader: threading.Thread | None = None

    @property
    def counts(self) -> Counter[str]:
        """Counts of `Splitter.counts`, and "unreadable" if a failed read ended the input."""
        return Counter(self._splitter.counts)

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Start to read; all suspensions belong to this process. See `Source`."""
        if sys.stdin is None:
            raise ValueError("source=stdin needs a standard input, which is closed")
        self._awake, self._wake = os.pipe()
        self._reader = threading.Thread(target=self._read, args=(sys.stdin.fileno(),), daemon=True)
        self._reader.start()
        return suspensions

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return the frames read so far; None after the end of the input. See `Source`."""
        return self._inbox.take(timeout_s)

    def confirm(self, n_frames: int | None = None) -> None:
        """Do nothing: a pipe cannot resend."""

    def publish(self, kind: Kind, suspension: str, message: bytes) -> None:
        """Write a line of JSON to standard output."""
        print_result(kind, suspension, message)

    def close(self) -> None:
        """Stop reading."""
        self._inbox.end()
        if self._reader is not None:
            os.close(self._wake)
            self._reader.join()
            os.close(self._awake)
            self._reader = None

    def _read(self, file: int) -> None:
        """Read until the input ends or `close` wakes it; runs in a thread."""
        while True:  # ends: with the input, or when the other end of the wake-up pipe is closed
            ready, _, _ = select.select([file, self._awake], [], [])
            if self._awake in ready:
                return
            try:
                data = os.read(file, PIECE_BYTES)
            except OSError:
                self._splitter.counts["unreadable"] += 1
                data = b""
            for frame in self._splitter.push(data) if data else self._splitter.finish():
                self._inbox.put(frame)
            if not data:
                self._inbox.end()
                return


class Inbox:
    """A queue of encoded frames that holds at most `most_bytes`, or one frame; a writer waits."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self._changed = threading.Condition()
        self._frames: list[bytes] = []
        self._n_bytes = 0
        self._has_ended = False

    def put(self, frame: bytes) -> None:
        """Add a frame once there is room, which one frame always has; drop it after `end`."""
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._has_ended
                    or not self._frames
                    or self._n_bytes + len(frame) <= self.most_bytes
                )
            )
            if not self._has_ended:
                self._frames.append(frame)
                self._n_bytes += len(frame)
                self._changed.notify_all()

    def end(self) -> None:
        """Mark the end of the queue."""
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def take(self, timeout_s: float) -> list[bytes] | None:
        """Return all frames: [] if none arrive within a time [s], None after the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._has_ended, timeout_s)
            frames, self._frames, self._n_bytes = self._frames, [], 0
            self._changed.notify_all()
            return None if self._has_ended and not frames else frames
