"""The monitor: frames of many suspensions from a source, results to the history.

The main thread takes frames and writes them to the journal in batches; once a batch is written, the
source may forget its frames. A second thread makes estimates, one at a time and started while no
frame waits, so that hundreds of due estimates delay no frame. The journal holds the frames of a
section until its estimate is reported. After a kill at any moment, the source sends unwritten
frames again, and an estimate that is reported twice replaces itself.
"""

import logging
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Protocol

import numpy as np

from suspnet.depot.live.journal import Journal, JournalError, StateError
from suspnet.depot.live.suspension import EstimateJob, LiveSuspension, SectionEstimate
from suspnet.trains.recordings.frames import FrameError, decode

log = logging.getLogger(__name__)
WAIT_S, PAUSE_S = 1.0, 0.1
"""Longest waits for frames [s]: usually, and before a batch with fewer than ``MAX_PENDING`` frames
is written."""
MAX_PENDING = 256  # number of frames after which a batch is written
MAX_JOURNAL = 8 * 2**20
"""Size of a suspension's frames in the journal above which its state is saved, [bytes]. The first
suspension uses half of it and the others values in between, so that hundreds of states are not
saved at once."""
MAX_WAITING = 4 * MAX_JOURNAL
"""Size of a suspension's frames in the journal above which no frame is taken until the estimate of
its last section is reported, [bytes]: a state does not hold sections that have ended."""
MAX_REPORTED = 1000  # pairs of sensor and reason for which the log names a rejected frame
NICENESS = 10
"""Niceness of the estimating thread: on a shared core it gets a tenth of the time while there are
frames to take."""


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


class Monitor:
    """Reads a source until it ends.

    `report` gets a suspension and an estimate at least once, `clock` returns monotonic seconds, and
    `counts` holds the frames "taken" and those rejected, by reason, in this process. `executor`
    makes the estimates (None: a thread of low priority) and is shut down when `run` ends.
    ValueError is raised if two suspensions have the same name, or the source's part has none.
    """

    def __init__(
        self,
        suspensions: Iterable[LiveSuspension],
        source: FrameSource,
        journal: Journal,
        report: Callable[[LiveSuspension, SectionEstimate], None],
        idle_s: float = 3600.0,
        clock: Callable[[], float] = time.monotonic,
        executor: Executor | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._source, self._journal, self._report = source, journal, report
        self._idle_s, self._clock = idle_s, clock
        self._logged: set[tuple[str, str, str]] = set()
        by_name: dict[str, LiveSuspension] = {}
        for suspension in suspensions:
            if suspension.name in by_name:
                raise ValueError(f"two manifests are of the same suspension, {suspension.name}")
            by_name[suspension.name] = suspension
        self._suspensions = {name: by_name[name] for name in source.subscribe(list(by_name))}
        if not self._suspensions:
            raise ValueError("no suspension is in this process's part")
        # different sizes, so that states of many suspensions are not saved at once
        sizes = np.linspace(MAX_JOURNAL / 2, MAX_JOURNAL, len(self._suspensions))
        self._max_bytes = dict(zip(self._suspensions, sizes.tolist(), strict=True))
        self._last_s = dict.fromkeys(self._suspensions, clock())
        self._executor = executor or ThreadPoolExecutor(1, "estimates", _lower_priority)
        # the estimates to be made, by suspension, and the one that is being made
        self._due: dict[str, EstimateJob] = {}
        self._making: tuple[LiveSuspension, EstimateJob, Future[SectionEstimate]] | None = None
        self._n_pending = 0

    def resume(self) -> int:
        """Restore the state of the journal, and return the number of its frames.

        JournalError is raised if a state is damaged or was made with other settings.
        """
        for name in set(self._journal.suspensions()) - set(self._suspensions):
            log.warning("the journal knows %s, which is not in this process's part", name)
        n_frames = 0
        for name, suspension in self._suspensions.items():
            state = self._journal.state(name)
            try:
                if state is not None:
                    suspension.load(state)
            except StateError as error:
                raise JournalError(
                    f"{self._journal.path}: {name}: {error}; restore the previous settings, or "
                    "give another journal= (estimates so far are in the store)"
                ) from None
            for data in self._journal.frames(name):
                n_frames += 1
                try:
                    suspension.take(decode(data), is_known=True)
                except FrameError as error:  # a piece of it belongs to a closed section
                    log.debug("%s: %s", name, error)
                # after each frame, as in `take`: the number of open sections is limited
                self._add(suspension, suspension.due())
        return n_frames

    def run(self) -> None:
        """Take frames until the source ends, then close and report all sections.

        JournalError is raised if the journal cannot be written, as on a full disk.
        """
        try:
            while True:  # ends: with the source
                frames = self._source.receive(self._wait_s())
                for data in frames or ():
                    self.take(data)
                self._n_pending += len(frames or ())
                if not frames or self._n_pending >= MAX_PENDING:
                    self._close_silent()
                    self._write()
                if frames is None:
                    break
                # an estimate is started only while no frame waits
                if self._making is not None and self._making[2].done():
                    self._finish_and_save()
                if not frames and self._due and self._making is None:
                    self._start(next(iter(self._due)))
            # the source has ended: all open sections are final
            for suspension in self._suspensions.values():
                self._add(suspension, suspension.end())
            self._finish_and_save()
            for name in list(self._due):
                self._start(name)
                self._finish_and_save()
            self._write()
        finally:
            self._executor.shutdown(cancel_futures=True)

    def _wait_s(self) -> float:
        if self._due and self._making is None:
            return 0.0
        return PAUSE_S if self._n_pending or self._making is not None else WAIT_S

    def take(self, data: bytes) -> None:
        """Take a frame, or count why it was rejected."""
        name = sensor = ""
        try:
            frame = decode(data)
            name, sensor = frame.suspension, frame.sensor
            suspension = self._suspensions.get(name)
            if suspension is None:
                raise FrameError("suspension", f"{name!r} is not a suspension monitored here")
            suspension.take(frame)
            # rejected frames are not stored: their number is unbounded
            self._journal.add(name, data)
            self._last_s[name] = self._clock()
            self.counts["taken"] += 1
            self._add(suspension, suspension.due())
            if self._journal.n_bytes[name] > self._max_bytes[name]:
                self._save(suspension)
        except FrameError as error:
            self.counts[error.reason] += 1
            kind = name, sensor, error.reason
            if kind not in self._logged and len(self._logged) < MAX_REPORTED:
                self._logged.add(kind)
                log.warning("a frame cannot be used (%s): %s", error.reason, error)

    def _close_silent(self) -> None:
        """Close the open sections of suspensions without frames for `idle_s`."""
        now_s = self._clock()
        for name, last_s in self._last_s.items():
            if now_s - last_s > self._idle_s:
                self._last_s[name] = now_s
                self._add(self._suspensions[name], self._suspensions[name].end())

    def _add(self, suspension: LiveSuspension, jobs: list[EstimateJob]) -> None:
        """Queue the last of a suspension's estimates, and make the earlier ones now.

        A queued estimate takes memory. Nothing is saved: a state holds no section that is queued.
        """
        for job in jobs:
            if suspension.name in self._due:
                self._finish()
                self._start(suspension.name)
                self._finish()
            self._due[suspension.name] = job

    def _start(self, name: str) -> None:
        """Start the queued estimate of a suspension; none is being made now."""
        suspension, job = self._suspensions[name], self._due.pop(name)
        suspension.begin(job)
        self._making = suspension, job, self._executor.submit(job.make)

    def _finish(self) -> None:
        """Wait for the estimate that is being made, if there is one, and report it."""
        if self._making is not None:
            suspension, job, future = self._making
            estimate = future.result()
            suspension.finish(job, estimate)
            self._report(suspension, estimate)
            self._making = None

    def _finish_and_save(self) -> None:
        """Report the estimate that is being made, and save the state if no section waits."""
        if self._making is not None:
            suspension = self._making[0]
            self._finish()
            if suspension.name not in self._due:
                self._journal.save(suspension.name, suspension.dump())

    def _save(self, suspension: LiveSuspension) -> None:
        """Save a suspension's state in place of its frames, once all sections are reported."""
        name = suspension.name
        is_made = self._making is not None and self._making[0] is suspension
        if name not in self._due and not is_made:
            self._journal.save(name, suspension.dump())
        elif self._journal.n_bytes[name] > MAX_WAITING:
            self._finish_and_save()
            if name in self._due:
                self._start(name)
                self._finish_and_save()

    def _write(self) -> None:
        """Write the pending frames; then the source may forget them."""
        self._journal.write()
        self._source.confirm(self._n_pending)
        self._n_pending = 0


def _lower_priority() -> None:
    if sys.platform == "linux":  # other systems have no priority per thread
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
