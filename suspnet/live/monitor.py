"""The monitor: frames of many suspensions from a source, results to the history.

Frames are taken, the journal is committed, and then the source may forget the frames. Estimates are
made by a second thread, one at a time and begun while no frame waits, so that hundreds that are due
at once hold no frame up; everything else is the first thread's. The journal keeps the frames of a
section until its estimate is told. Killed at any moment, the frames since the last commit come
again, and estimates that are told twice replace themselves.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, Future, ThreadPoolExecutor

import numpy as np

from suspnet.history.records import TripResult
from suspnet.live.journal import Journal, JournalError
from suspnet.live.source import Source
from suspnet.live.suspension import Due, Job, LiveSuspension, Told
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

NICENESS = 10
"""Niceness of the thread that makes estimates: on a core that both share it gets a tenth of the
time while there are frames to take."""

MOST_WAITING = 4 * MOST_JOURNAL
"""Size of a suspension's frames in the journal above which frames are held up until the estimate of
its last section is told: a state does not hold sections that are over, [bytes]."""

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
    executor : Executor, optional
        Makes the estimates; None is a thread of low priority. It is shut down when `run` ends.

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
        executor: Executor | None = None,
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
        self._executor = executor or ThreadPoolExecutor(1, "estimates", _give_way)
        self._running: tuple[LiveSuspension, Job, Future[TripResult]] | None = None

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
                self._add(one, one.due())  # as when they came: only so many sections may be open
        return n_frames

    def run(self) -> None:
        """Take frames until there will never be more; then all sections are over.

        Raises
        ------
        JournalError
            If the journal cannot be written, as on a full disk.
        """
        n_pending = 0
        try:
            while True:  # as long as the source says
                frames = self._source.receive(self._wait_s(n_pending))
                for data in frames or ():
                    self._take(data)
                n_pending += len(frames or ())
                if not frames or n_pending >= MOST_PENDING:
                    self._add_silent()
                    self._commit()
                    n_pending = 0
                if frames is None:
                    break
                if self._running is not None and self._running[2].done():
                    self._finish_and_save()
                if not frames and self._due and self._running is None:
                    self._begin(next(iter(self._due)))
            for one in self._suspensions.values():
                self._add(one, one.end())
            self._finish_and_save()
            for name in list(self._due):
                self._begin(name)
                self._finish_and_save()
            self._commit()
        finally:
            self._executor.shutdown(cancel_futures=True)

    def _wait_s(self, n_pending: int) -> float:
        """Return how long to wait for frames, [s]."""
        if self._due and self._running is None:
            return 0.0
        return PAUSE_S if n_pending or self._running is not None else WAIT_S

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
                self._finish()
                self._begin(one.name)
                self._due[one.name] = due
                self._finish()
            self._due[one.name] = due

    def _begin(self, name: str) -> None:
        """Let the estimate of a suspension that waits be made; none is being made now."""
        one = self._suspensions[name]
        job = one.job(self._due.pop(name))
        self._running = one, job, self._executor.submit(job.make)

    def _finish(self) -> None:
        """Wait for the estimate that is being made, if there is one, and tell it."""
        if self._running is not None:
            one, job, future = self._running
            self._tell(one, one.finish(job, future.result()))
            self._running = None

    def _finish_and_save(self) -> None:
        """Tell the estimate that is being made; after a final one, save if no section waits."""
        if self._running is not None:
            one, job, _ = self._running
            self._finish()
            if job.due.is_final and not self._is_held(one.name):
                self._journal.save(one.name, one.dump())

    def _is_held(self, name: str) -> bool:
        """Return whether a section of a suspension is over, and its estimate not told."""
        waiting = self._due.get(name)
        if waiting is not None and waiting.is_final:
            return True
        return self._running is not None and (
            self._running[0].name == name and self._running[1].due.is_final
        )

    def _save(self, one: LiveSuspension) -> None:
        """Save a suspension's state in place of its frames, as soon as all sections are told."""
        if not self._is_held(one.name):
            self._journal.save(one.name, one.dump())
        elif self._journal.n_bytes[one.name] > MOST_WAITING:
            self._finish_and_save()
            if one.name in self._due:
                self._begin(one.name)
                self._finish_and_save()

    def _commit(self) -> None:
        """Write the journal, and then let the source forget what it gave."""
        self._journal.commit()
        self._source.confirm()


def _give_way() -> None:
    """Let the other threads of this process go before this one, where threads have priorities."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
