"""Frames on their way from the thread that reads them to the monitor, bounded in bytes."""

from __future__ import annotations

import threading


class Inbox:
    """A queue of encoded frames whose writer waits while it is full.

    Parameters
    ----------
    most_bytes : int
        It holds no more, or one frame.
    """

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self._changed = threading.Condition()
        self._frames: list[bytes] = []
        self._n_bytes = 0
        self._has_ended = False

    def put(self, frame: bytes) -> None:
        """Add a frame as soon as there is room; after `end` it is forgotten."""
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._has_ended
                    or self._n_bytes + len(frame) <= self.most_bytes
                    # one frame always has room
                    or not self._frames
                )
            )
            if not self._has_ended:
                self._frames.append(frame)
                self._n_bytes += len(frame)
                self._changed.notify_all()

    def end(self) -> None:
        """Say that there will be no more frames."""
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def take(self, timeout_s: float) -> list[bytes] | None:
        """Return all frames, [] if there are none after a time [s], None after the last ones."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._has_ended, timeout_s)
            frames, self._frames, self._n_bytes = self._frames, [], 0
            self._changed.notify_all()
            return None if self._has_ended and not frames else frames
