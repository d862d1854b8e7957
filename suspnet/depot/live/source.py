"""Interface of a source of frames, and results as lines of JSON."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Literal, Protocol

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


def print_result(kind: ResultKind, message: bytes) -> None:
    """Write a result to standard output, as one line of JSON with its kind first."""
    sys.stdout.write(json.dumps({"kind": kind, **json.loads(message)}) + "\n")
    sys.stdout.flush()
