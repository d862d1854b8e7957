"""When a train stood, by the frames of its speed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from suspnet.recordings.clocks import SECOND_NS
from suspnet.recordings.columns import size_of
from suspnet.recordings.frames import Frame, end_ns

STEP_NS = 10 * SECOND_NS
"""Steps of time for which it is kept whether the train moved, [ns]."""

MOST_STEPS = 10_000
"""Largest number of these steps, a day. The latest go first: they are of wrong times."""

LEAST_M_PER_S = 1.0
"""Speed below which a train stands, [m/s]: more than the noise of what measures it."""


class Standing:
    """Whether a train moved in each step of time of which its speed is known.

    It does not depend on the order in which frames come.
    """

    def __init__(self) -> None:
        self._moved: dict[int, bool] = {}

    def take(self, frame: Frame) -> None:
        """Take a frame of the speed."""
        speeds = (size_of("speed", frame.unit) or 1.0) * frame.samples
        has_moved = bool(np.max(speeds) >= LEAST_M_PER_S)
        for step in _steps(frame.time_ns, end_ns(frame)):
            self._moved[step] = has_moved or self._moved.get(step, False)
        for step in sorted(self._moved)[MOST_STEPS:]:
            del self._moved[step]

    def stood(self, begin_ns: int, end_ns: int) -> bool:
        """Return whether the speed is known in all of a time, and the train stood."""
        return not any(self._moved.get(step, True) for step in _steps(begin_ns, end_ns))

    def forget(self, before_ns: int) -> None:
        """Forget what was before a time."""
        if self._moved and min(self._moved) < before_ns // STEP_NS:
            self._moved = {k: one for k, one in self._moved.items() if k >= before_ns // STEP_NS}

    def state(self) -> list[Any]:
        """Return JSON-able values that `restore` makes the same of."""
        return sorted(self._moved.items())

    def restore(self, state: list[Any]) -> None:
        """Go on from a state."""
        self._moved = dict(state)


def _steps(begin_ns: int, end_ns: int) -> Iterator[int]:
    """Yield the steps that a time touches."""
    return iter(range(begin_ns // STEP_NS, -(-end_ns // STEP_NS)))
