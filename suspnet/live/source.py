"""What the monitor asks of a source of frames: standard input, a folder, a broker."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal, Protocol

Kind = Literal["estimates", "alarms"]


class Source(Protocol):
    """Where encoded frames come from and results go to.

    A source is made from its settings, which it checks, and opens nothing before `subscribe`. All
    methods are called by one thread. A frame is given at least once: what was received but not
    confirmed comes again after a restart, as far as the sender keeps it.
    """

    @property
    def counts(self) -> Counter[str]:
        """What was no frame, and what happened on the way, by its reason in one word."""
        ...

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Open the source for the suspensions of these names, before the first `receive`.

        Returns
        -------
        sequence of str
            Those whose frames will come: all, or the part that this process is for.

        Raises
        ------
        OSError, ValueError
            If it cannot be opened.
        """
        ...

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return encoded frames that have come, unchecked.

        It returns as soon as there are any; an empty list after `timeout_s` [s]; None if there
        will never be more.
        """
        ...

    def confirm(self, n_frames: int | None = None) -> None:
        """Say that the next so many of the frames received are kept: the source may forget them.

        None: all that were received so far.
        """
        ...

    def publish(self, kind: Kind, suspension: str, payload: bytes) -> None:
        """Tell a result, a JSON object, of one suspension; never waits for a network."""
        ...

    def close(self) -> None:
        """Give back what is open; frames that were not confirmed come again."""
        ...


def plain_json(payload: bytes) -> dict[str, Any]:
    """Return what a JSON object holds, null for NaN and infinity; ValueError if it is none."""
    found = json.loads(payload, parse_constant=lambda _: None)
    if not isinstance(found, dict):
        raise ValueError(f"a result is a JSON object, got {payload[:80]!r}")
    return found


def print_result(kind: Kind, suspension: str, payload: bytes) -> None:
    """Write a result to standard output, as one line of JSON with these two names first."""
    told = {"kind": kind, "suspension": suspension, **plain_json(payload)}
    sys.stdout.write(json.dumps(told) + "\n")
    sys.stdout.flush()
