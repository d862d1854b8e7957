"""Recorded trips of a fleet as one stream of frames, all suspensions merged by time, at a pace."""

from __future__ import annotations

import heapq
import logging
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, tzinfo
from pathlib import Path

from suspnet.ground.checks import check_number
from suspnet.live.recorded import nanoseconds, trip_clock, trip_frames
from suspnet.recordings.clocks import SECOND_NS
from suspnet.recordings.dates import time_zone
from suspnet.recordings.frames import Frame, end_ns
from suspnet.recordings.manifest import TripManifest
from suspnet.recordings.manifest_files import ManifestFile
from suspnet.recordings.manifest_keys import TripError
from suspnet.trips.grouping import find_groups

log = logging.getLogger(__name__)
PAUSE_S = 3600
"""Time between the end of a trip and the begin of the next one of the same suspension, where
neither manifests nor files say when they were recorded, [s]."""

LONGEST_WAIT_S = 60.0
"""Longest time without any frame [s] that a replay at a pace waits for, in recorded time."""


@dataclass
class Replay:
    """The frames of all trips of a folder.

    One block of each sensor of one trip of each suspension is in memory.

    Parameters
    ----------
    folder : Path
        As of `find_groups`: one with manifests, or one with such folders.
    frame_s : float, [s]
        Length of a frame.
    start : str, optional
        Begin of the first trip of each suspension whose manifests and files do not say when they
        were recorded, in ISO 8601; its other trips follow after ``PAUSE_S``.
    zone : str
        Time zone of times that name none: "UTC", "+02:00" or "Europe/Berlin".

    Attributes
    ----------
    n_suspensions, n_trips : int
        Number of suspensions, and of trips that were begun.
    problems : list of str
        Why trips are missing, or end early.

    Raises
    ------
    TypeError, ValueError
        If a setting is out of range, or two suspensions have the same name.
    FileNotFoundError
        If there are no manifests.
    """

    folder: Path
    frame_s: float = 1.0
    start: str | None = None
    zone: str = "UTC"
    n_suspensions: int = 0
    n_trips: int = 0
    problems: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_number("frame_s", self.frame_s, low=0.01, high=60)
        self._zone: tzinfo = time_zone(self.zone)
        self._start_ns: int | None = None
        if self.start is not None:
            self._start_ns = _parsed(self.start, self._zone)
        by_name: dict[str, list[TripManifest]] = {}
        for group in find_groups(self.folder):
            trips = [found for file in group.manifests if (found := self._read(file))]
            for name in {str(trip.place) for trip in trips}:
                if name in by_name:
                    raise ValueError(
                        f"{group.folder} holds trips of {name!r}, as another folder does; tell "
                        "them apart by `train` and `car` in the manifests"
                    )
            for trip in trips:
                by_name.setdefault(str(trip.place), []).append(trip)
            if group.error:
                self._tell(f"{group.folder}: {group.error}")
        self.n_suspensions = len(by_name)
        self._trips = list(by_name.values())

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of all suspensions in the order in which they would be complete."""
        yield from heapq.merge(*map(self._suspension, self._trips), key=end_ns)

    def _read(self, file: ManifestFile) -> TripManifest | None:
        """Return a manifest; None if it has mistakes, which are told."""
        try:
            return file.trip
        except TripError as error:
            self._tell(str(error))
            return None

    def _suspension(self, trips: Sequence[TripManifest]) -> Iterator[Frame]:
        """Yield the frames of one suspension, trip by trip."""
        numbers: Counter[str] = Counter()
        last_ns: int | None = None
        for trip in _in_order(trips, self._zone):
            try:
                clock = trip_clock(trip, self._zone)
                zero_ns = self._undated(trip, last_ns) if clock.zero_ns is None else clock.zero_ns
                self.n_trips += 1
                before_ns = last_ns
                for frame in trip_frames(trip, zero_ns, clock.offsets_s, numbers, self.frame_s):
                    if before_ns is not None and frame.time_ns < before_ns:
                        self._tell(f"{trip.path}: begins before the trip before it has ended")
                    before_ns = None
                    last_ns = max(end_ns(frame), last_ns or 0)
                    yield frame
            except TripError as error:
                self._tell(str(error))

    def _undated(self, trip: TripManifest, last_ns: int | None) -> int:
        """Return when a trip begins that does not say so; TripError if `start` is not given."""
        if self._start_ns is None:
            raise TripError(
                f"{trip.path}: neither `start` nor the data files say when the trip was recorded; "
                "write `start` into the manifest, or give start= to the replay"
            )
        if last_ns is None:
            return self._start_ns
        return math.ceil(last_ns / SECOND_NS + PAUSE_S) * SECOND_NS

    def _tell(self, problem: str) -> None:
        """Keep and log what is wrong with a trip; the others go on."""
        self.problems.append(problem)
        log.warning("%s", problem)


class Pace:
    """Waits so that frames come as fast as when they were recorded, or a factor faster.

    Parameters
    ----------
    times : float, optional
        That factor; None does not wait.

    Raises
    ------
    TypeError, ValueError
        If it is out of range.
    """

    def __init__(self, times: float | None = 1.0) -> None:
        check_number("times", times, low=1e-3, high=1e6, optional=True)
        self.times = times
        self._last_ns: int | None = None
        self._due_s = 0.0

    def wait(self, frame: Frame) -> None:
        """Wait until a frame is due: as long after the one before as it was recorded later.

        Without any frame in ``LONGEST_WAIT_S`` no longer than that. Delays of the other side are
        caught up.
        """
        if self.times is None:
            return
        now_ns = end_ns(frame)
        if self._last_ns is None:
            self._due_s, self._last_ns = time.monotonic(), now_ns
        passed_s = min((now_ns - self._last_ns) / SECOND_NS, LONGEST_WAIT_S)
        self._due_s += max(passed_s, 0.0) / self.times
        self._last_ns = max(now_ns, self._last_ns)
        time.sleep(max(0.0, self._due_s - time.monotonic()))


def _in_order(trips: Sequence[TripManifest], zone: tzinfo) -> list[TripManifest]:
    """Return trips by their start if all of them say it, else by mileage."""
    starts = [trip.start for trip in trips]
    known = [nanoseconds(start, zone) for start in starts if start is not None]
    if len(known) == len(trips):
        order = sorted(range(len(trips)), key=lambda k: known[k])
        return [trips[k] for k in order]
    return sorted(trips, key=lambda trip: trip.mileage_km)


def _parsed(text: str, zone: tzinfo) -> int:
    """Return a date and time in nanoseconds since 1970; ValueError if it is none."""
    try:
        return nanoseconds(datetime.fromisoformat(text), zone)
    except (TypeError, ValueError):
        raise ValueError(
            f"`start` must be a date and time like 2026-03-01T06:00:00Z, got {text!r}"
        ) from None
