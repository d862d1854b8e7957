"""A stream without end as recordings of bounded length, cut at fixed times.

Section k covers the times from k to k + 1 times the length of a section, counted from 1970, so that
sensors, processes and the batch cut at the same instants. A frame is divided where it crosses a
border. A section stays open for frames that come late; then it is a recording like any other.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from suspnet.checks import check_number
from suspnet.recordings.cleaning import CleaningSettings
from suspnet.recordings.clocks import SECOND_NS
from suspnet.recordings.manifest import TripManifest
from suspnet.stream.assembler import OrderSettings
from suspnet.stream.frames import Frame, FrameError
from suspnet.stream.running import Running

MOST_OPEN = 4
"""Largest number of open sections. Two are enough where clocks are right; the others are for frames
of wrong times, none of which may close a section that still runs."""

BORDER_SAMPLES = 1e-3
"""A sample this close before a border [samples] counts as on it, as times are whole nanoseconds."""


class Sections:
    """The recordings of one suspension, one after the other.

    It holds at most ``MOST_OPEN`` recordings of `section_s`, as `Running` says.

    Parameters
    ----------
    manifest : TripManifest
        As of `Running`.
    section_s : int, [s]
        Length of a section.
    late_s : float, [s]
        A section is over once more than ``order.window`` frames of one sensor, one after the other,
        begin later than this after its end. No sensor may lag behind another by more.
    rate_hz, cleaning, order
        As of `Running`.

    Attributes
    ----------
    counts : Counter
        "dropped" are frames of sections of wrong times that were given up.
    identity : JSON-able
        What a state must share with the stream that goes on from it.

    Raises
    ------
    TripError, ValueError
        As `Running` does.
    """

    def __init__(
        self,
        manifest: TripManifest,
        section_s: int = 1200,
        late_s: float = 10.0,
        rate_hz: float = 100.0,
        cleaning: CleaningSettings | None = None,
        order: OrderSettings | None = None,
    ) -> None:
        check_number("section_s", section_s, low=60, high=86400, whole=True)
        check_number("late_s", late_s, low=0, high=3600)
        self.manifest, self.section_s, self.late_s = manifest, section_s, late_s
        self.rate_hz, self.cleaning = rate_hz, cleaning
        self.order = OrderSettings() if order is None else order
        self.counts: Counter[str] = Counter()
        self._open: dict[int, Running] = {}
        self._after: dict[int, Counter[str]] = {}
        self._next = 0
        self.identity = [section_s, late_s, self._begun(0).identity]

    def add(self, frame: Frame) -> None:
        """Take a frame.

        Raises
        ------
        FrameError
            As `Running.add` does, or "late" if a section of it is over; its other part is taken.
        """
        if len(frame.samples) > self.section_s * frame.rate_hz:
            raise FrameError("size", f"a frame is longer than a section of {self.section_s} s")
        wrong: FrameError | None = None
        for number, part in self._parts(frame):
            try:
                self._add(number, part)
            except FrameError as error:
                wrong = error
        if wrong is not None:
            raise wrong

    def _add(self, number: int, part: Frame) -> None:
        """Take the part of a frame that lies in one section."""
        if number < self._next:
            raise FrameError("late", f"a frame of {part.sensor!r} is of a section that is over")
        section = self._open.get(number) or self._begun(number)
        section.add(part)  # a frame that is refused opens no section
        if number not in self._open:
            self._open[number], self._after[number] = section, Counter()
            self._drop()
        for other, after in self._after.items():
            end_ns = (other + 1) * self._length_ns
            has_passed = part.time_ns >= end_ns + self.late_s * SECOND_NS
            after[part.sensor] = after[part.sensor] + 1 if has_passed else 0

    def over(self) -> list[Running]:
        """Return the sections that are over, the earliest first, and forget them."""
        window = self.order.window
        passed = [k for k, n in self._after.items() if max(n.values(), default=0) > window]
        return self._close(max(passed, default=-1))

    @property
    def open(self) -> list[Running]:
        """The sections that are not over, the earliest first."""
        return [self._open[k] for k in sorted(self._open)]

    def close(self) -> list[Running]:
        """Return all sections: the stream has ended."""
        return self._close(max(self._open, default=-1))

    @property
    def _length_ns(self) -> int:
        return self.section_s * SECOND_NS

    def _begun(self, number: int) -> Running:
        """Return a new section."""
        zero_ns = number * self._length_ns
        settings = self.rate_hz, self.cleaning, self.order, float(self.section_s)
        return Running(self.manifest, zero_ns, *settings)

    def _parts(self, frame: Frame) -> Iterator[tuple[int, Frame]]:
        """Yield the parts of a frame and the sections in which they lie."""
        step_ns = SECOND_NS / frame.rate_hz
        while True:  # ends: each round takes a sample, or begins at a border
            number = frame.time_ns // self._length_ns
            end_ns = (number + 1) * self._length_ns
            n_inside = math.ceil((end_ns - frame.time_ns) / step_ns - BORDER_SAMPLES)
            if n_inside >= len(frame.samples):
                yield number, frame
                return
            if n_inside < 1:
                frame = replace(frame, time_ns=end_ns)
                continue
            yield number, replace(frame, samples=frame.samples[:n_inside])
            frame = replace(
                frame,
                time_ns=frame.time_ns + round(n_inside * step_ns),
                samples=frame.samples[n_inside:],
            )

    def _drop(self) -> None:
        """Give up the section with the fewest frames, of these the latest, if there are many."""
        if len(self._open) > MOST_OPEN:
            worst = min(self._open, key=lambda k: (self._open[k].n_frames, -k))
            self.counts["dropped"] += self._open.pop(worst).n_frames
            del self._after[worst]

    def _close(self, last: int) -> list[Running]:
        """Return the sections up to one, without frames that wait for others."""
        found = [self._open.pop(k) for k in sorted(self._open) if k <= last]
        self._after = {k: after for k, after in self._after.items() if k > last}
        self._next = max(self._next, last + 1)
        for section in found:
            section.flush()
        return found

    def state(self) -> dict[str, Any]:
        """Return arrays and JSON-able values that `restore` makes the same stream of."""
        return {
            "counts": dict(self.counts),
            "next": self._next,
            "open": {str(k): section.state() for k, section in self._open.items()},
            "after": {str(k): dict(after) for k, after in self._after.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state of a stream of the same identity."""
        self.counts, self._next = Counter(state["counts"]), state["next"]
        self._open = {}
        for k, saved in state["open"].items():
            self._open[int(k)] = self._begun(int(k))
            self._open[int(k)].restore(saved)
        self._after = {int(k): Counter(after) for k, after in state["after"].items()}
