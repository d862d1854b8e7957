"""Frames that follow each other in a stream of bytes, found by Arrow's own framing.

An encapsulated message of the Arrow IPC format is 0xFFFFFFFF, the length of its metadata (a
little-endian int32, a multiple of 8), the metadata (a flatbuffer, which tells the length of the
body) and the body. A frame is the message of a schema, that of one record batch, and the mark of
the end, 0xFFFFFFFF 0x00000000. What a frame says is not looked at here:
`suspnet.recordings.frames.decode` does that.
"""

from __future__ import annotations

import re
import struct
from collections import Counter

from suspnet.recordings.frames import MOST_BYTES, FrameError, flatbuffer_field

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
"""Beginning of a message with less than 64 KiB of metadata."""

SCHEMA, RECORD_BATCH = 1, 3
"""Numbers of the types of messages in Arrow's Message.fbs."""


class Splitter:
    """Cuts a stream of bytes, however it comes in pieces, into encoded frames.

    After bytes that are no frame it goes on at the next place where a frame begins, even inside of
    a frame that was begun and never ended. It holds at most ``MOST_BYTES`` and one piece.

    Attributes
    ----------
    counts : Counter
        Stretches of bytes between two frames that are none, by the first reason: "foreign",
        "size" (larger than any frame), "truncated" (begun, but not as long as it says).

    Examples
    --------
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
        """Take the next bytes; return the frames that end with them."""
        self._buffer += data
        return self._frames(at_end=False)

    def finish(self) -> list[bytes]:
        """Return the frames that are left where the stream ends; count one that is cut off."""
        return self._frames(at_end=True)

    def _frames(self, at_end: bool) -> list[bytes]:
        """Return the frames in the buffer and take them off."""
        found: list[bytes] = []
        at = 0
        while len(self._buffer) - at >= PREFIX_BYTES:  # each round goes on by a byte or more
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
        """Count bytes that are no frame, once until the next frame."""
        if not self._is_lost:
            self.counts[reason] += 1
        self._is_lost = True

    def _length(self, start: int) -> int | None:
        """Return the length of the frame that begins somewhere; None if it is not yet whole.

        Raises
        ------
        FrameError
            If no frame begins there.
        """
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
