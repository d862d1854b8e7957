"""How many suspensions one core monitors in real time, latency and memory, for docs/live.md.

    suspnet simulate scenario=healthy generator=best out=trips/bench fleet.n_trips=3
    python train.py experiment=trips healthy=trips/bench hydra.run.dir=outputs/bench \
        data.minutes=20 data.n_train=2000 data.n_test=200 data.n_calibrate=500 figures=false
    LIVE="taskset -c 0 python benchmarks/live.py outputs/bench trips/bench/trip_001.yaml"
    $LIVE --suspensions 20 --hours 0.35    # CPU time of one suspension
    $LIVE --suspensions 500 --hours 0.4    # many at once: delay and memory
    $LIVE --hours 24                       # memory over a day

Sensors on one side: ``fleet.sides=left`` in place of ``generator=best``. The trip has three
channels at 5000, 2000 and 2000 Hz and a speed of 1 Hz for 20 minutes; it is given again and again
as frames of 1 s in single precision, each suspension's at a moment of its own within a second.
Everything is done that `suspnet-monitor` does: journal, sections, estimates, history and alarms.
Reading from a network, making the frames and waiting for the disk alone is not counted.

The clock is the CPU time of the monitor, all threads, as if it had a core for itself: frames come
in real time by this clock, which jumps to the next one while nothing is at work. So the delay of a
frame, from the moment at which it came until it is part of the state, holds on a busy machine, too.
"""

from __future__ import annotations

import resource
import tempfile
import time
from argparse import ArgumentParser
from array import array
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from suspnet.depot.live.journal import Journal
from suspnet.depot.live.monitor import Monitor
from suspnet.depot.live.replay import Replay
from suspnet.depot.live.results import report
from suspnet.depot.live.sections import LiveSettings
from suspnet.depot.live.suspension import LiveSuspension
from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.history import History
from suspnet.trains.jobs.fleet import FleetSettings
from suspnet.trains.recordings.frames import Frame, encode
from suspnet.trains.recordings.manifest_files import ManifestFile

TRAIN, TIME_NS, SEQUENCE = "987654", 1234567890123456789, 9876543
"""What stands in the place of a frame's own values, of the same length, in a template."""

FIRST_SEQUENCE = 10**6
"""Number of the first frame; all have seven digits."""

MOST_AT_ONCE = 2000
"""Largest number of frames that are given at once, as of ``source=mqtt``."""


class Template:
    """An encoded frame whose suspension, time and number are put in: making it takes no time."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        kind = "f8" if frame.sensor == "mileage" else "f4"
        name = f"train {TRAIN}, {frame.suspension}"
        marked = replace(frame, suspension=name, time_ns=TIME_NS, sequence=SEQUENCE)
        data = encode(replace(marked, samples=frame.samples.astype(kind)))
        marks = [name.encode(), str(TIME_NS).encode(), str(SEQUENCE).encode()]
        assert all(data.count(mark) == 1 for mark in marks)
        ends = sorted((data.index(mark), which) for which, mark in enumerate(marks))
        self._order = [which for _, which in ends]
        self._parts, at = [], 0
        for begin, which in ends:
            self._parts.append(data[at:begin])
            at = begin + len(marks[which])
        self._parts.append(data[at:])

    def filled(self, suspension: bytes, time_ns: int, sequence: int) -> bytes:
        """Return the frame of a suspension at a time."""
        values = suspension, b"%d" % time_ns, b"%d" % sequence
        (a, b, c), (x, y, z) = (self._parts[:3], (values[which] for which in self._order))
        return b"".join((a, x, b, y, c, z, self._parts[3]))


class Repeated:
    """A source that gives a trip's frames to several suspensions in real time.

    Parameters
    ----------
    frames : list of Frame
        Of one trip, by time.
    hours : float, [h]

    Attributes
    ----------
    is_busy : callable
        Whether another thread of the monitor is at work.
    made_s : float, [s]
        CPU time that this took itself.
    came_s : list of float, [s]
        When the frames came that were given last.
    memory : list of float, [MiB]
        Of the process, ten times along the way.
    """

    def __init__(self, frames: Sequence[Frame], hours: float) -> None:
        begin_ns = min(one.time_ns for one in frames)
        self._by_second: dict[int, list[Template]] = {}
        for one in frames:
            several = self._by_second.setdefault((one.time_ns - begin_ns) // 10**9, [])
            several.append(Template(one))
        self._n_of = Counter(one.sensor for one in frames)
        self.n_seconds = round(3600 * hours)
        self.counts: Counter[str] = Counter()
        self.made_s, self.came_s, self.memory = 0.0, list[float](), list[float]()
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._second, self._waited_s = 0, 0.0
        self.is_busy: Callable[[], bool] = lambda: False
        self._begin_s = time.process_time()

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Take the names."""
        self._names = suspensions
        return suspensions

    @property
    def now_s(self) -> float:
        """Time since the begin by the monitor's own clock, [s]."""
        return time.process_time() - self._begin_s - self.made_s + self._waited_s

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return the frames that have come, or wait for the next one."""
        start_s, until_s = time.thread_time(), self.now_s + timeout_s
        self._make(until_s)
        if not self._waiting and self._second == self.n_seconds:
            return None
        self.made_s += time.thread_time() - start_s
        until_s = max(self.now_s, min(until_s, self._waiting[0][0] if self._waiting else until_s))
        while self.is_busy() and self.now_s < until_s:  # the CPU time of its threads passes
            time.sleep(1e-4)
        self._waited_s += max(0.0, until_s - self.now_s)
        start_s = time.thread_time()
        given: list[bytes] = []
        self.came_s = []
        while self._waiting and self._waiting[0][0] <= until_s and len(given) < MOST_AT_ONCE:
            came_s, data = self._waiting.popleft()
            self.came_s.append(came_s)
            given.append(data)
        self.made_s += time.thread_time() - start_s
        return given

    def _make(self, until_s: float) -> None:
        """Make the frames that come until a time, of whole seconds."""
        while self._second <= until_s and self._second < self.n_seconds:
            if self._second % max(1, self.n_seconds // 10) == 0:
                self.memory.append(_memory_mib())
            times, second = divmod(self._second, len(self._by_second))
            for k, name in enumerate(self._names):
                came_s = self._second + 1 + k / len(self._names)  # it is sent when it is over
                for template in self._by_second[second]:
                    one = template.frame
                    if one.sensor == "mileage" and times:
                        continue
                    time_ns = one.time_ns + times * len(self._by_second) * 10**9
                    sequence = FIRST_SEQUENCE + one.sequence + times * self._n_of[one.sensor]
                    self._waiting.append(
                        (came_s, template.filled(name.encode(), time_ns, sequence))
                    )
            self._second += 1

    def confirm(self, n_frames: int | None = None) -> None:
        """Forget nothing: the next frames are new."""

    def close(self) -> None:
        """Close nothing."""


class Timed(Monitor):
    """A monitor that notes how long each frame takes until it is part of the state."""

    took_ms: array[float]
    delays_ms: array[float]
    source: Repeated

    def is_busy(self) -> bool:
        """Return whether an estimate is being made."""
        return self._making is not None and not self._making[2].done()

    def take(self, data: bytes) -> None:
        start = time.perf_counter()
        super().take(data)
        self.took_ms.append(1e3 * (time.perf_counter() - start))
        self.delays_ms.append(1e3 * (self.source.now_s - self.source.came_s.pop(0)))


def _memory_mib() -> float:
    """Return the memory that the process has now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def _quantiles(several: array[float]) -> str:
    """Return quantiles of times in words."""
    values = np.array(several)
    told = [f"{np.percentile(values, q):.3f} in {q:g} %" for q in (50, 99, 99.9)]
    return ", ".join([*told, f"at most {values.max():.0f}"])


def main() -> None:
    """Monitor, and print what it took."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("trip", type=Path)
    parser.add_argument("--suspensions", type=int, default=1)
    parser.add_argument("--hours", type=float, default=1.0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "trip").mkdir()
        manifest, model = ManifestFile(given.trip).live_trip, load_model(given.run)
        (folder / "trip" / "trip.yaml").write_text(given.trip.read_text())
        (folder / "trip" / given.trip.stem).symlink_to(given.trip.with_suffix("").absolute())
        frames = list(Replay(folder / "trip").frames())
        live, settings = LiveSettings(), FleetSettings(TripSettings())
        several = [
            LiveSuspension(replace(manifest, train=f"{k:06d}"), [model], settings.trips, live)
            for k in range(given.suspensions)
        ]
        source, before_mib = Repeated(frames, given.hours), _memory_mib()
        with History(folder / "fleet.db") as store, Journal(folder / "journal") as journal:
            monitor = Timed(several, source, journal, partial(report, store, settings))
            monitor.source, source.is_busy = source, monitor.is_busy
            monitor.took_ms, monitor.delays_ms = array("d"), array("d")  # eight bytes each
            wall, start = time.perf_counter(), time.process_time()
            monitor.run()
            cpu_s = time.process_time() - start - source.made_s
            wall_s = time.perf_counter() - wall
        n_seconds = source.n_seconds
        size_mib = sum(file.stat().st_size for file in folder.glob("journal*")) / 2**20
    n_all = given.suspensions * n_seconds
    print(f"{given.suspensions} suspensions, {given.hours:g} h each")
    print(f"frames: {dict(monitor.counts)}")
    print(f"CPU {cpu_s:.1f} s, wall time {wall_s:.1f} s with the making of frames")
    print(
        f"{1e3 * cpu_s / n_all:.3f} ms for a second of a suspension: "
        f"{n_all / cpu_s:.0f} in real time"
    )
    print(f"to take a frame [ms]: {_quantiles(monitor.took_ms)}")
    print(f"from when it came until it is in the state [ms]: {_quantiles(monitor.delays_ms)}")
    print("memory [MiB] " + " ".join(f"{one:.0f}" for one in source.memory), end="")
    each = (max(source.memory) - before_mib) / given.suspensions
    print(f", before {before_mib:.0f}: {each:.2f} each; journal {size_mib:.0f} MiB")


if __name__ == "__main__":
    main()
