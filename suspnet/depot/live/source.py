"""Interface of a source of frames."""

from collections import Counter
from collections.abc import Sequence
from typing import Protocol


class FrameSource(Protocol):
    """Interface of a source of encoded frames.

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

    def close(self) -> None:
        """Release resources; frames that were not confirmed are delivered again."""
