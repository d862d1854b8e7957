"""Frames on standard input, one after another; results as lines of JSON on standard output."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import ClassVar

from suspnet.ground.settings import Setting, check_values
from suspnet.live.source import Kind, Splitter, print_result

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
        ),
    }
    """Meaning and range of each argument."""

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

    def publish(self, kind: Kind, suspension: str, payload: bytes) -> None:
        """Write a line of JSON to standard output."""
        print_result(kind, suspension, payload)

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
