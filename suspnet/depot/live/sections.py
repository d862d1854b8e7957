"""An endless stream divided into sections: recordings of bounded length that follow its trips.

A trip starts with the first frame after a pause, and a section at the full second of its first
frame. A section ends if no frame comes for the length of a pause; at its full length; or, after a
third of it, if the train has stood for the length of a pause. If frames go on, another section
follows. A frame is divided at the end of a section.

None of this depends on the order of frames, as long as no sensor lags behind another by more than
`late_s`, which is at most the length of a pause. A section stays open for such frames; then it is a
recording like any other.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

from suspnet.depot.live.operating_conditions import Standing
from suspnet.ground.settings import check_number, check_settings, setting
from suspnet.trains.recordings.assembler import OrderSettings
from suspnet.trains.recordings.dates import SECOND_NS
from suspnet.trains.recordings.frames import Frame, FrameError, end_ns, frame_from, n_before
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.running import Running

MAX_OPEN = 5
"""Largest number of open sections. Three are enough if clocks are right: one that has ended, the
next one of its trip, and the next trip. The others are for frames of wrong times, which must not
close a section that is still running."""
TRIED_NS = 60 * SECOND_NS  # time between two checks for standstill, [ns]
AHEAD_NS = 86_400 * SECOND_NS
"""Frames this much earlier than an ended section, [ns], are not late: a clock was wrong."""


@dataclass(frozen=True)
class LiveSettings:
    """How a monitor divides a stream into sections, and when it reports estimates."""

    section_s: int = setting(
        1200,
        "Largest length of a section, which is one trip in the history; a longer trip "
        "becomes several",
        "s",
        low=60,
        high=86400,
    )
    pause_s: float = setting(
        300.0, "Time without a frame after which a trip has ended", "s", low=60, high=3600
    )
    late_s: float = setting(
        60.0,
        "Time for which a section stays open for frames that come later than others",
        low=0,
        high=3600,
        rule="s; 0 to pause_s",
    )
    idle_s: float = setting(
        3600.0,
        "Time without a frame, as of a train that is parked, after which a section has ended",
        "s",
        low=1,
        high=1e7,
    )
    order: OrderSettings = field(default_factory=OrderSettings)

    def __post_init__(self) -> None:
        check_settings(self, "live")
        check_number("live.late_s", self.late_s, low=0, high=self.pause_s)


@dataclass
class _Open:
    """A section that is not closed."""

    section: Running
    # for each sensor, number of its latest frames in a row that start after the section ended
    after: Counter[str] = field(default_factory=Counter)
    cut_ns: int | None = None  # where it ends early, at a standstill
    n_tried: int = 0  # number of checks for a standstill


class Sections:
    """The recordings of one suspension, one after another.

    Memory is that of at most ``MAX_OPEN`` recordings of `section_s`; see ``Running``. A section
    closes once more than ``order.window`` frames of one sensor in a row start later than `late_s`
    after the pause that follows it or, if its trip goes on, after its end.

    `counts` are frames "dropped" with sections of wrong times, and "late" ones, part of which was
    too late. The JSON-able `identity` must be equal for a state and the stream that is restored
    from it. TripError and ValueError are raised as by ``Running``.
    """

    def __init__(
        self, manifest: TripManifest, settings: LiveSettings, rate_hz: float = 100.0
    ) -> None:
        self.manifest, self.settings, self.rate_hz = manifest, settings, rate_hz
        self.section_s = settings.section_s
        self._pause_ns = round(settings.pause_s * SECOND_NS)
        self._late_ns = round(settings.late_s * SECOND_NS)
        self.counts: Counter[str] = Counter()
        self._open: dict[int, _Open] = {}
        self._next_ns = 0
        self._back: Counter[str] = Counter()
        self._standing = Standing()
        limits = [self.section_s, settings.late_s, settings.pause_s]
        self.identity = [*limits, self._begun(0).identity]

    def add(self, frame: Frame, is_known: bool = False) -> None:
        """Take a frame; `is_known` if it was taken before, and is read again after a restart.

        FrameError is raised, and the whole frame rejected, as by ``Running.add``, or "late" if all
        of it belongs to a closed section.
        """
        if len(frame.samples) > self.section_s * frame.rate_hz:
            raise FrameError("size", f"a frame is longer than a section of {self.section_s} s")
        self._check_clock(frame, is_known)
        # drop the samples of closed sections, and divide the others at the ends of open ones
        n_late = n_before(frame, self._next_ns)
        rest = frame_from(frame, n_late, self._next_ns)
        if rest is None:
            raise FrameError("late", f"a frame of {frame.sensor!r} belongs to a closed section")
        reasons = ["late"] if n_late else []
        n_taken = 0
        while rest is not None:  # ends: each round takes a sample, or starts at a border
            key = self._place(rest.time_ns)
            border_ns = self._full_ns(rest.time_ns)
            if key in self._open:
                self._cut(self._open[key], end_ns(rest))
                border_ns = min(self._border_ns(self._open[key]), border_ns)
            if n_inside := n_before(rest, border_ns):
                try:
                    self._add(key, replace(rest, samples=rest.samples[:n_inside]))
                except FrameError as error:  # rejects the frame if none of it is taken yet
                    if not n_taken:
                        raise
                    reasons.append(error.reason)
                n_taken += n_inside
            rest = frame_from(rest, n_inside, border_ns)
        self.counts.update(reasons)

    def _check_clock(self, frame: Frame, is_known: bool) -> None:
        """Accept earlier times if a clock was far ahead and is right again.

        Otherwise all frames would be late for as long as it was ahead.
        """
        if frame.time_ns >= self._next_ns - AHEAD_NS:
            self._back[frame.sensor] = 0
            return
        self._back[frame.sensor] += 1
        if is_known or self._back[frame.sensor] > self.settings.order.window:
            self._next_ns = 0
            self._back.clear()

    def over(self) -> list[Running]:
        """Remove the sections that have ended, and return them, the earliest first."""
        window = self.settings.order.window
        passed = (e for e in self._open.values() if max(e.after.values(), default=0) > window)
        last_ns = max((entry.section.begin_ns for entry in passed), default=-1)
        return self._close([k for k in self._keys if self._open[k].section.begin_ns <= last_ns])

    def close(self) -> list[Running]:
        """Return all sections: the stream has ended. Frames after the last one begin new ones."""
        next_ns = max([self._next_ns, *(entry.section.end_ns for entry in self._open.values())])
        closed = self._close(self._keys)
        self._next_ns = next_ns
        return closed

    @property
    def _keys(self) -> list[int]:
        return sorted(self._open, key=lambda k: self._open[k].section.begin_ns)

    def _begun(self, zero_ns: int) -> Running:
        longest_s = self.section_s + self.settings.pause_s + 1
        settings = self.rate_hz, self.settings.order, longest_s, float(self.settings.pause_s)
        return Running(self.manifest, zero_ns, *settings)

    def _full_ns(self, begin_ns: int) -> int:
        return (begin_ns // SECOND_NS + self.section_s) * SECOND_NS

    def _border_ns(self, entry: _Open) -> int:
        """Return where a section ends if frames go on."""
        return self._full_ns(entry.section.begin_ns) if entry.cut_ns is None else entry.cut_ns

    def _cut(self, entry: _Open, time_ns: int) -> None:
        """End a section at a standstill, if the frames up to a time show one.

        Only speeds older than `late_s` count: later ones may still be missing.
        """
        first_ns = self._full_ns(entry.section.begin_ns) - self.section_s * SECOND_NS * 2 // 3
        while entry.cut_ns is None:  # ends: each round advances by a minute
            at_ns = first_ns + entry.n_tried * TRIED_NS
            if time_ns <= at_ns:
                return
            entry.n_tried += 1
            if self._standing.stood(at_ns - self._late_ns - self._pause_ns, at_ns - self._late_ns):
                entry.cut_ns = at_ns

    def _end_ns(self, entry: _Open) -> int:
        """Return the end of a section: later frames do not belong to it."""
        return min(self._border_ns(entry), entry.section.end_ns + self._pause_ns)

    def _place(self, time_ns: int) -> int:
        """Return the key of the section that a time belongs to, which may be a new one."""
        entries = [(k, self._open[k]) for k in self._keys]
        for k, entry in entries:  # an open section
            begin_ns = k if entry.section.goes_on else entry.section.begin_ns - self._pause_ns
            if max(begin_ns, k - self._pause_ns) <= time_ns < self._end_ns(entry):
                return k
        for _, entry in entries:  # the continuation of one
            border_ns = self._border_ns(entry)
            goes_on = border_ns <= time_ns < entry.section.end_ns + self._pause_ns
            if goes_on and border_ns not in self._open:
                return border_ns
        return time_ns // SECOND_NS * SECOND_NS

    def _add(self, key: int, piece: Frame) -> None:
        """Take the piece of a frame that lies in one section."""
        is_new = key not in self._open
        section = self._begun(key) if is_new else self._open[key].section
        section.add(piece)  # before the section is opened: a rejected frame opens none
        if is_new:
            section.goes_on = any(self._border_ns(entry) == key for entry in self._open.values())
            self._open[key] = _Open(section)
            self._drop()
        for entry in self._open.values():
            has_passed = piece.time_ns >= self._end_ns(entry) + self._late_ns
            entry.after[piece.sensor] = entry.after[piece.sensor] + 1 if has_passed else 0
        if piece.sensor == "speed":
            self._standing.take(piece)
            needed_ns = 2 * (self._pause_ns + self._late_ns) + TRIED_NS
            self._standing.forget(piece.time_ns - needed_ns)

    def _drop(self) -> None:
        """If too many sections are open, drop the one with the fewest frames, the latest of these.

        The section opened last stays: otherwise no new section could ever grow.
        """
        if len(self._open) > MAX_OPEN:
            sections = {k: entry.section for k, entry in list(self._open.items())[:-1]}
            worst = min(sections, key=lambda k: (sections[k].n_frames, -sections[k].begin_ns))
            self.counts["dropped"] += sections[worst].n_frames
            del self._open[worst]

    def _close(self, keys: list[int]) -> list[Running]:
        """Close some sections, and return them."""
        closed = [self._open.pop(k) for k in keys]
        for entry in closed:
            self._next_ns = max(self._next_ns, self._end_ns(entry))
            entry.section.flush()
        return [entry.section for entry in closed]

    def state(self) -> dict[str, Any]:
        """Return arrays and JSON-able values for `restore`."""
        return {
            "counts": dict(self.counts),
            "next_ns": self._next_ns,
            "back": dict(self._back),
            "standing": self._standing.state(),
            "open": {
                str(k): vars(entry) | {"section": entry.section.state(), "after": dict(entry.after)}
                for k, entry in self._open.items()
            },
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the state of a stream of the same identity."""
        self.counts, self._next_ns = Counter(state["counts"]), state["next_ns"]
        self._back = Counter(state["back"])
        self._standing.restore(state["standing"])
        self._open = {}
        for k, saved in state["open"].items():
            section = self._begun(int(k))
            section.restore(saved["section"])
            entry = saved | {"section": section, "after": Counter(saved["after"])}
            self._open[int(k)] = _Open(**entry)
