"""Recorded trips of a fleet as files of frames, all suspensions merged by time, at a set pace.

Frames hold the raw samples of each sensor, with the times at which they were taken.
"""

import heapq
import logging
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, tzinfo
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.depot.live.drop_folder import TAKEN
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.storage import write_atomically
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.cleaning import find_gaps, runs
from suspnet.trains.recordings.clocks import offsets_s
from suspnet.trains.recordings.dates import EPOCH, SECOND_NS, ahead_ns, nanoseconds, time_zone
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.frames import MOST_SAMPLES, Frame, encode, end_ns
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_files import ManifestFile
from suspnet.trains.recordings.manifest_sources import UNITS
from suspnet.trains.recordings.sources import open_source, recut, zero_of
from suspnet.trains.trips.grouping import find_groups

log = logging.getLogger(__name__)
LONGEST_WAIT_S = 60.0
"""Longest gap between frames that a paced replay waits for, in recorded time, [s]."""
FILE_S, MAX_FILE_BYTES = 10.0, 2**23
"""Time that a file covers, [s], and size after which the next one is started."""
NUMBERED = re.compile(r"\d{9}", re.ASCII)  # names of the files
MILEAGE, TEMPERATURE = ("mileage", "km"), ("temperature", "degC")
"""Sensor and unit of the frames of one sample at the start of a trip."""
SLOW_HZ = 1.0  # nominal rate of the frames of one sample


@dataclass
class Replay:
    """The frames of all trips of a folder.

    `folder` is as for `find_groups`, `frame_s` [s] the length of a frame, and `zone` the time zone
    of times without one: "UTC", "+02:00" or "Europe/Berlin". `n_suspensions` and `n_trips` count
    suspensions and started trips; `problems` states why trips are missing or end early. Memory
    holds one block of each sensor of one trip of each suspension.
    """

    folder: Path
    frame_s: float = setting(1.0, "Length of a frame", "s", low=0.01, high=60)
    zone: str = "UTC"
    times: float | None = setting(
        None,
        "How many times faster than recorded frames are sent; null is as fast as they are taken",
        low=1e-3,
        high=1e6,
    )
    n_suspensions: int = 0
    n_trips: int = 0
    problems: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_settings(self)
        self._zone: tzinfo = time_zone(self.zone)
        by_name: dict[str, list[TripManifest]] = {}
        for group in find_groups(self.folder):
            trips = [trip for file in group.manifests if (trip := self._read(file))]
            for name in {str(trip.place) for trip in trips}:
                if name in by_name:
                    raise ValueError(
                        f"{group.folder} holds trips of {name!r}, as another folder does; "
                        "distinguish them by `train` and `car` in the manifests"
                    )
            for trip in trips:
                by_name.setdefault(str(trip.place), []).append(trip)
            if group.error:
                self._report(f"{group.folder}: {group.error}")
        self.n_suspensions = len(by_name)
        self._trips = list(by_name.values())

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of all suspensions in the order of their ends, as loggers send them."""
        frames = heapq.merge(*map(self._suspension, self._trips), key=end_ns)
        yield from frames if self.times is None else paced(frames, self.times)

    def _read(self, file: ManifestFile) -> TripManifest | None:
        try:
            return file.trip
        except TripError as error:
            self._report(str(error))
            return None

    def _suspension(self, trips: Sequence[TripManifest]) -> Iterator[Frame]:
        numbers: Counter[str] = Counter()
        last_ns: int | None = None
        by_start = all(trip.start is not None for trip in trips)
        starts = [nanoseconds(trip.start or EPOCH, self._zone) for trip in trips]
        keys = starts if by_start else [trip.mileage_km for trip in trips]
        for i in np.argsort(keys, kind="stable"):
            trip = trips[i]
            try:
                zero_ns, offsets = trip_clock(trip, self._zone)
                self.n_trips += 1
                before_ns = last_ns
                for frame in trip_frames(trip, zero_ns, offsets, numbers, self.frame_s):
                    if before_ns is not None and frame.time_ns < before_ns:
                        self._report(f"{trip.path}: starts before the end of the trip before it")
                    before_ns = None
                    last_ns = max(end_ns(frame), last_ns or 0)
                    yield frame
            except TripError as error:
                self._report(str(error))

    def _report(self, problem: str) -> None:
        self.problems.append(problem)
        log.warning("%s", problem)


def paced(frames: Iterable[Frame], times: float) -> Iterator[Frame]:
    """Yield frames so many times faster than they were recorded.

    A frame waits as long after the previous one as it was recorded later, at most
    ``LONGEST_WAIT_S``; delays of the receiver are caught up.
    """
    due_s, last_ns = time.monotonic(), None
    for frame in frames:
        now_ns = end_ns(frame)
        last_ns = now_ns if last_ns is None else last_ns
        due_s += max(min((now_ns - last_ns) / SECOND_NS, LONGEST_WAIT_S), 0.0) / times
        last_ns = max(now_ns, last_ns)
        time.sleep(max(0.0, due_s - time.monotonic()))
        yield frame


class FrameFiles(AbstractContextManager["FrameFiles"]):
    """Writes frames into files as ``source=folder`` reads them; a context manager.

    A file appears atomically. It covers ``FILE_S``, of all sensors, and holds at most
    ``MAX_FILE_BYTES`` and one frame. File names continue after the existing ones.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        files = [*folder.glob("*.frames"), *(folder / TAKEN).glob("*.frames")]
        self._n_files = max([int(f.stem) for f in files if NUMBERED.fullmatch(f.stem)], default=0)
        self._held: list[bytes] = []
        self._n_bytes = self._first_ns = 0

    def add(self, frame: Frame) -> None:
        """Add a frame to the file; write the file first if it is full."""
        is_over = frame.time_ns - self._first_ns >= FILE_S * SECOND_NS
        if self._held and (is_over or self._n_bytes >= MAX_FILE_BYTES):
            self._write()
        if not self._held:
            self._first_ns = frame.time_ns
        self._held.append(encode(frame))
        self._n_bytes += len(self._held[-1])

    def _write(self) -> None:
        self._n_files += 1
        write_atomically(self.folder / f"{self._n_files:09d}.frames", b"".join(self._held))
        self._held.clear()
        self._n_bytes = 0

    def __exit__(self, *_: object) -> None:
        if self._held:
            self._write()


def trip_clock(manifest: TripManifest, zone: tzinfo = UTC) -> tuple[int, Mapping[str, float]]:
    """Return the zero of a trip's clock, and the offset of each sensor's and the speed's times [s].

    The zero is in ns since 1970 in UTC; offsets are added to a sensor's own times. TripError is
    raised if a file cannot be read, clocks cannot be aligned, or neither manifest nor files say
    when the trip was.
    """
    zeros = {name: zero_of(manifest, name) for name in manifest.sources()}
    offsets = offsets_s(manifest, zeros)
    dated = {name: zero.ns for name, zero in zeros.items() if zero.ns is not None}
    for name, ns in dated.items():
        zero_ns = ns - round(offsets[name] * SECOND_NS)
        return zero_ns - (0 if zeros[name].is_zoned else ahead_ns(zero_ns, zone)), offsets
    if manifest.start is None:
        raise TripError(
            f"{manifest.path}: neither `start` nor the data files say when the trip was recorded; "
            "write `start` into the manifest"
        )
    return nanoseconds(manifest.start, zone), offsets


def trip_frames(
    manifest: TripManifest,
    zero_ns: int,
    offsets: Mapping[str, float],
    numbers: Counter[str],
    frame_s: float = 1.0,
) -> Iterator[Frame]:
    """Yield the frames of a trip in the order of their ends, when a logger would send them.

    Samples have the unit of the manifest and are as in the file: not cleaned, filtered or turned.
    They are float32 if that holds them exactly, else float64. A missing sample (NaN, infinite or
    absurd) or a missing time ends a frame; so does sample ``MOST_SAMPLES``. A block of each sensor
    is in memory. `zero_ns` and `offsets` are those of `trip_clock`; `numbers`, the sequence number
    of each sensor's next frame, is updated.
    """
    suspension = str(manifest.place)
    streams = [
        _sensor_frames(manifest, name, zero_ns + round(offsets[name] * SECOND_NS), numbers, frame_s)
        for name in manifest.sources()
    ]
    merged = heapq.merge(*streams, key=end_ns)
    for first in merged:
        slow = {MILEAGE: manifest.mileage_km, TEMPERATURE: manifest.temperature_c}
        for (name, unit), value in slow.items():
            if value is not None:
                number, sample = _next(numbers, name), np.array([value])
                yield Frame(suspension, name, number, first.time_ns, SLOW_HZ, unit, sample)
        yield first
        break
    yield from merged


def _sensor_frames(
    manifest: TripManifest, name: str, zero_ns: int, numbers: Counter[str], frame_s: float
) -> Iterator[Frame]:
    """Yield the frames of one sensor, whose times count from `zero_ns`."""
    source, suspension = manifest.sources()[name], str(manifest.place)
    with open_source(manifest, source, manifest.where(name)) as opened:
        # the manifest's unit, and the factor from the file's numbers to it
        unit = source.unit or next(iter(UNITS[source.kind]))
        factor = abs(opened.size) / source.si_size
        blocks = opened.even()
        first_block = next(blocks)
        rate_hz = opened.known_rate_hz
        first_s = source.start_s + opened.first_s
        first_ns = zero_ns + round(first_s * SECOND_NS)
        size = max(1, min(MOST_SAMPLES, round(frame_s * rate_hz)))
        whole = chain([first_block], blocks)
        del first_block  # frees as much memory as all else of a sensor takes
        for k, (values,) in enumerate(recut(((block,) for block in whole), size)):
            for start, stop in zip(*runs(~find_gaps(values)), strict=True):
                time_ns = first_ns + round((k * size + start) * SECOND_NS / rate_hz)
                samples = _shortest(factor * values[start:stop])
                number = _next(numbers, name)
                yield Frame(suspension, name, number, time_ns, rate_hz, unit, samples)


def _shortest(samples: FloatArray) -> FloatArray:
    """Return samples in single precision if that changes none of them."""
    with np.errstate(over="ignore"):
        single: Any = samples.astype(np.float32)
    return single if (single == samples).all() else samples


def _next(numbers: Counter[str], name: str) -> int:
    """Return the number of a sensor's next frame, and count it."""
    numbers[name] += 1
    return numbers[name] - 1
