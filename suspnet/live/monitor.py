"""The monitor: frames of many suspensions from a source, results to the history.

Frames are taken, the journal is committed, and then the source may forget the frames. Estimates are
made one at a time while no frames wait, so that hundreds that are due at once hold no frame up; the
journal keeps the frames of a section until its estimate is told. Killed at any moment, the frames
since the last commit come again, and estimates that are told twice replace themselves.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from suspnet.live.journal import Journal, JournalError
from suspnet.live.source import Source
from suspnet.live.suspension import Due, LiveSuspension, Told
from suspnet.stream import FrameError, StateError, decode

log = logging.getLogger(__name__)

WAIT_S, PAUSE_S = 1.0, 0.1
"""Longest wait for frames; and if some have come: what is committed is what came before a pause
of this length, or ``MOST_PENDING`` frames, [s]."""

MOST_PENDING = 256
"""Number of frames after which the journal is committed."""

MOST_JOURNAL = 8 * 2**20
"""Size of a suspension's frames in the journal above which its state is saved, [bytes]; for the
first suspension half of it, for others in between, so that hundreds are not saved at once."""

Tell = Callable[[LiveSuspension, Told], None]


class Monitor:
    """Reads a source until it ends.

    Parameters
    ----------
    suspensions : iterable of LiveSuspension
    source : Source
    journal : Journal
    tell : callable
        Gets a suspension and an estimate; what it does can be done twice.
    idle_s : float, [s]
        As of `LiveSettings`.
    clock : callable, optional
        Seconds that only grow.

    Attributes
    ----------
    counts : Counter
        Frames "taken" and those that could not be used, by reason, in this process.

    Raises
    ------
    ValueError
        If two suspensions have the same name, or the source's part has none.
    """

    def __init__(
        self,
        suspensions: Iterable[LiveSuspension],
        source: Source,
        journal: Journal,
        tell: Tell,
        idle_s: float = 3600.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._source, self._journal, self._tell = source, journal, tell
        self._idle_s, self._clock = idle_s, clock
        self._seen: set[tuple[str, str]] = set()
        known: dict[str, LiveSuspension] = {}
        for one in suspensions:
            if one.name in known:
                raise ValueError(f"two manifests are of the same suspension, {one.name}")
            known[one.name] = one
        wanted = source.subscribe(list(known))
        self._suspensions = {name: known[name] for name in wanted}
        if not self._suspensions:
            raise ValueError("no suspension is in this process's part")
        sizes = np.linspace(MOST_JOURNAL / 2, MOST_JOURNAL, len(self._suspensions))
        self._most_bytes = dict(zip(self._suspensions, sizes.tolist(), strict=True))
        self._last_s = dict.fromkeys(self._suspensions, clock())
        self._due: dict[str, Due] = {}

    def resume(self) -> int:
        """Go on from the journal; return the number of its frames.

        Raises
        ------
        JournalError
            If a state is damaged or of other settings.
        """
        for name in set(self._journal.suspensions()) - set(self._suspensions):
            log.warning("the journal knows %s, which is not in this process's part", name)
        n_frames = 0
        for name, one in self._suspensions.items():
            state = self._journal.state(name)
            if state is not None:
                self._load(one, state)
            for data in self._journal.frames(name):
                n_frames += 1
                try:
                    one.take(decode(data))
                except FrameError as error:  # a part of it was of a section that is over
                    log.debug("%s: %s", name, error)
            self._add(one, one.due())
        return n_frames

    def run(self) -> None:
        """Take frames until there will never be more; then all sections are over.

        Raises
        ------
        JournalError
            If the journal cannot be written, as on a full disk.
        """
        n_pending = 0
        while True:  # as long as the source says
            wait_s = PAUSE_S if n_pending else WAIT_S
            frames = self._source.receive(0.0 if self._due else wait_s)
            for data in frames or ():
                self._take(data)
            n_pending += len(frames or ())
            if not frames or n_pending >= MOST_PENDING:
                self._add_silent()
                self._commit()
                n_pending = 0
            if frames is None:
                break
            if not frames and self._due:
                self._estimate(next(iter(self._due)))
        for one in self._suspensions.values():
            self._add(one, one.end())
        for name in list(self._due):
            self._estimate(name)
        self._commit()

    def _load(self, one: LiveSuspension, state: bytes) -> None:
        """Let a suspension go on from its state in the journal."""
        try:
            one.load(state)
        except StateError as error:
            raise JournalError(
                f"{self._journal.path}: {one.name}: {error}; give the settings of before, or "
                "another journal= (estimates so far are in the store)"
            ) from None

    def _take(self, data: bytes) -> None:
        """Take a frame, or count why not."""
        name = ""
        try:
            frame = decode(data)
            name = frame.suspension
            one = self._suspensions.get(name)
            if one is None:
                raise FrameError(
                    "suspension", f"{name!r} is none of the suspensions monitored here"
                )
            self._last_s[name] = self._clock()
            self._journal.add(name, data)
            one.take(frame)
            self.counts["taken"] += 1
            self._add(one, one.due())
            if self._journal.n_bytes[name] > self._most_bytes[name]:
                self._save(one)
        except FrameError as error:
            self.counts[error.reason] += 1
            if (name, error.reason) not in self._seen and len(self._seen) < 1000:
                self._seen.add((name, error.reason))
                log.warning("a frame cannot be used (%s): %s", error.reason, error)

    def _add_silent(self) -> None:
        """Add the sections of suspensions from which nothing has come for long."""
        now_s = self._clock()
        for name, last_s in self._last_s.items():
            if now_s - last_s > self._idle_s:
                self._last_s[name] = now_s
                self._add(self._suspensions[name], self._suspensions[name].silent())

    def _add(self, one: LiveSuspension, several: list[Due]) -> None:
        """Let the last of a suspension's estimates wait; those before it are made now.

        One that waits takes memory. One on the way is not made if a later one is there already.
        """
        for due in several:
            waiting = self._due.get(one.name)
            if waiting is not None and waiting.is_final and waiting.section is not due.section:
                self._tell(one, one.estimate(waiting))
            self._due[one.name] = due

    def _estimate(self, name: str) -> None:
        """Make the estimate of a suspension that waits, and tell it; after a final one, save."""
        one, due = self._suspensions[name], self._due.pop(name)
        self._tell(one, one.estimate(due))
        if due.is_final:
            self._journal.save(name, one.dump())

    def _save(self, one: LiveSuspension) -> None:
        """Save a suspension's state in place of its frames; a section that waits is told before."""
        waiting = self._due.get(one.name)
        if waiting is not None and waiting.is_final:
            self._estimate(one.name)
        else:
            self._journal.save(one.name, one.dump())

    def _commit(self) -> None:
        """Write the journal, and then let the source forget what it gave."""
        self._journal.commit()
        self._source.confirm()
