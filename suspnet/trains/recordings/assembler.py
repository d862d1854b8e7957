"""Assembly of one sensor's frames, which may be duplicated, late, out of order or missing.

Sequence numbers give the order, times the position of samples. Consecutive frames are joined; if
time is missing between them, each missing sample becomes NaN, as in a file with such a gap. No gap
is closed silently, and no sample is returned twice.
"""

from collections import Counter, deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from suspnet.ground.settings import Checked, setting
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.columns import MOST_DRIFT
from suspnet.trains.recordings.dates import SECOND_NS
from suspnet.trains.recordings.frames import MOST_SAMPLES, Frame, FrameError, decode, encode
from suspnet.trains.recordings.sources import RATE_TOLERANCE

MOST_HELD = 2 * MOST_SAMPLES
"""Number of samples above which frames are released, whatever the window: 1 MiB."""
MOST_LOSSES = 64
"""Number of recent sequence gaps that are stored: a frame of them is late, not a duplicate."""


@dataclass(frozen=True)
class OrderSettings(Checked):
    """How frames are put in order."""

    window: int = setting(
        16, "Largest number of later frames of its sensor that a frame may follow", low=0, high=1024
    )
    jitter_s: float = setting(
        0.001,
        "Largest time between the end of a frame and the start of the next, early or late",
        "s",
        low=0,
        high=1,
    )
    longest_gap_s: float = setting(
        60.0,
        "Longest gap; a frame beyond it is accepted only after `window` such frames",
        "s",
        low=0,
        high=1800,
    )


def check_frame_rate(frame: Frame, rate_hz: float, tolerance: float = RATE_TOLERANCE) -> None:
    """Raise FrameError if a frame has another rate than its sensor."""
    if abs(frame.rate_hz - rate_hz) > tolerance * rate_hz:
        words = f"{frame.sensor!r} has {rate_hz:g} Hz, its frame {frame.rate_hz:g} Hz"
        raise FrameError("rate", words)


class Assembler:
    """Turns one sensor's frames into evenly spaced samples.

    It holds at most ``window + 1`` frames, and ``MOST_HELD`` samples plus one frame. Its output
    does not depend on how a signal is cut into frames, or on their order as long as no frame
    arrives after more than `window` later ones.

    `counts` has accepted frames ("taken"); rejected frames: "duplicate", "late" (its place has
    become a gap), "clock" (starts before the end of the samples so far), "far" (beyond the longest
    gap); and "gap", "gap_samples", "missing" (sequence numbers that did not arrive in time) and
    "restart" (of the sequence). `first_ns` is the time of the first sample, `n_samples` the number
    of samples returned, including those of gaps.
    """

    def __init__(self, rate_hz: float, settings: OrderSettings | None = None) -> None:
        self.rate_hz = rate_hz
        self.settings = OrderSettings() if settings is None else settings
        self.counts: Counter[str] = Counter()
        self.first_ns: int | None = None
        self.n_samples = self._n_far = self._end_ns = 0
        self._next: int | None = None
        self._held: dict[int, Frame] = {}
        self._n_held = 0
        self._lost: deque[tuple[int, int]] = deque(maxlen=MOST_LOSSES)

    def push(self, frame: Frame) -> list[FloatArray]:
        """Return the samples that become available with a frame, in its unit; NaN in gaps.

        Raises FrameError if the frame has another rate.
        """
        check_frame_rate(frame, self.rate_hz)
        flushed: list[FloatArray] = []
        if frame.sequence in self._held:
            self.counts["duplicate"] += 1
            return flushed
        if self._next is not None and frame.sequence < self._next:
            if self._ahead(frame) < -self._tolerance:
                is_late = any(low <= frame.sequence < high for low, high in self._lost)
                self.counts["late" if is_late else "duplicate"] += 1
                return flushed
            # a lower number at a later time: the logger has restarted its sequence
            flushed = self.flush()
            self.counts["restart"] += 1
            self._next = None
            self._lost.clear()
        self._held[frame.sequence] = frame
        self._n_held += len(frame.samples)
        return flushed + self._due()

    def flush(self) -> list[FloatArray]:
        """Return the samples of all frames held back; frames missing before them become gaps."""
        return self._due(at_once=True)

    @property
    def n_frames(self) -> int:
        """Number of frames that were accepted or are held back."""
        return self.counts["taken"] + len(self._held)

    @property
    def _tolerance(self) -> float:
        return max(0.5, self.settings.jitter_s * self.rate_hz)

    def _ahead(self, frame: Frame) -> float:
        return (frame.time_ns - self._end_ns) * self.rate_hz / SECOND_NS

    def _distance(self, frame: Frame) -> float:
        """Return the gap between the samples so far and a frame, [samples].

        Slow drift of a logger's clock does not count, up to ``MOST_DRIFT``.
        """
        assert self.first_ns is not None
        ahead = self._ahead(frame)
        beyond = (frame.time_ns - self.first_ns) * self.rate_hz / SECOND_NS - self.n_samples
        is_drift = abs(beyond - ahead) <= self._tolerance + MOST_DRIFT * self.n_samples
        return ahead if is_drift else beyond

    def _due(self, at_once: bool = False) -> list[FloatArray]:
        """Return the samples of held frames that need not wait any more; of all if `at_once`."""
        blocks: list[FloatArray] = []
        while self._held:  # ends: each round removes a frame
            if self._next not in self._held:
                full = len(self._held) > self.settings.window or self._n_held > MOST_HELD
                if not (full or at_once):
                    break
                lowest = min(self._held)
                if self._next is not None:
                    self.counts["missing"] += lowest - self._next
                    self._lost.append((self._next, lowest))
                self._next = lowest
            frame = self._held.pop(self._next)
            self._n_held -= len(frame.samples)
            self._next += 1
            blocks += self._placed(frame)
        return blocks

    def _placed(self, frame: Frame) -> list[FloatArray]:
        """Return the samples of the next frame, after NaN for a gap; empty if it is rejected."""
        if self.first_ns is None:
            self.first_ns = self._end_ns = frame.time_ns
        distance = self._distance(frame)
        n_gap = round(distance) if distance > self._tolerance else 0
        reason = "clock" if distance < -self._tolerance else ""
        is_far = n_gap > self.settings.longest_gap_s * self.rate_hz
        if is_far and self._n_far < self.settings.window:
            reason = "far"
        if reason:
            self.counts[reason] += 1
            self._n_far += reason == "far"
            return []
        self.counts["taken"] += 1
        self._n_far = 0
        self.n_samples += n_gap + len(frame.samples)
        self._end_ns = frame.time_ns + round(len(frame.samples) * SECOND_NS / self.rate_hz)
        samples = np.asarray(frame.samples, dtype=np.float64)
        if not n_gap:
            return [samples]
        self.counts["gap"] += 1
        self.counts["gap_samples"] += n_gap
        return [np.full(n_gap, np.nan), samples]

    def state(self) -> dict[str, Any]:
        """Return arrays and JSON-able values from which `restore` continues."""
        encoded = [encode(frame) for frame in self._held.values()]
        return {
            "counts": dict(self.counts),
            "at": [self.first_ns, self._end_ns, self.n_samples, self._n_far, self._next],
            "lost": list(map(list, self._lost)),
            "sizes": list(map(len, encoded)),
            "held": np.frombuffer(b"".join(encoded), dtype=np.uint8),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the state of an assembler of the same sensor."""
        self.counts = Counter(state["counts"])
        at = state["at"]
        self.first_ns, self._end_ns, self.n_samples, self._n_far, self._next = at
        self._lost = deque(((low, high) for low, high in state["lost"]), maxlen=MOST_LOSSES)
        data, ends = state["held"].tobytes(), np.cumsum([0, *state["sizes"]])
        frames = [decode(data[start:end]) for start, end in pairwise(ends)]
        self._held = {frame.sequence: frame for frame in frames}
        self._n_held = sum(len(frame.samples) for frame in frames)
