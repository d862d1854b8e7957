"""How many suspensions one core monitors in real time, latency and memory, for docs/live.md.

    python -m suspnet.simulate out=trips/bench fleet.n_trips=3 fleet.sides=left
    python train.py experiment=trips healthy=trips/bench hydra.run.dir=outputs/bench \
        data.minutes=20 data.n_train=2000 data.n_test=200 data.n_calibrate=500 figures=false
    LIVE="python tests/benchmarks/live.py outputs/bench trips/bench/trip_001.yaml"
    $LIVE --suspensions 20 --hours 1       # CPU time of one suspension, latency
    $LIVE --suspensions 500 --hours 0.1    # memory of many
    $LIVE --hours 24                       # memory over a day

The trip has three channels at 5000, 2000 and 2000 Hz and a speed of 1 Hz for 20 minutes; it is
given again and again as frames of 1 s in single precision. Everything is done that
`suspnet-monitor` does: journal, sections, estimates, history and alarms. Reading from a network
and making the frames is not counted.
"""

from __future__ import annotations

import resource
import tempfile
import time
from argparse import ArgumentParser
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from suspnet.history import History
from suspnet.live.journal import Journal
from suspnet.live.monitor import MOST_PENDING, Monitor
from suspnet.live.replay import Replay
from suspnet.live.results import Results
from suspnet.live.suspension import LiveSettings, LiveSuspension
from suspnet.model.checkpoint import load_model
from suspnet.model.from_recording import TripSettings
from suspnet.recordings.manifest_files import read_live_manifest
from suspnet.stream import Frame, encode
from suspnet.trips.fleet import FleetSettings


class Repeated:
    """A source that gives a trip's frames to several suspensions, second after second.

    Parameters
    ----------
    frames : list of Frame
        Of one trip, by time.
    hours : float, [h]

    Attributes
    ----------
    made_s : float, [s]
        CPU time that this took itself.
    memory : list of float, [MiB]
        Of the process, ten times along the way.
    """

    def __init__(self, frames: Sequence[Frame], hours: float) -> None:
        begin_ns = min(one.time_ns for one in frames)
        self._by_second: dict[int, list[Frame]] = {}
        for one in frames:
            self._by_second.setdefault((one.time_ns - begin_ns) // 10**9, []).append(one)
        self._n_of = Counter(one.sensor for one in frames)
        self.n_seconds = round(3600 * hours)
        self.counts: Counter[str] = Counter()
        self.made_s, self.memory = 0.0, list[float]()
        self._waiting: list[bytes] = []
        self._second = 0

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Take the names."""
        self._names = suspensions
        return suspensions

    def receive(self, timeout_s: float) -> list[bytes] | None:
        """Return some frames of this second, or of the next."""
        start = time.process_time()
        if not self._waiting:
            if self._second == self.n_seconds:
                return None
            self._waiting = self._made()
            if self._second % max(1, self.n_seconds // 10) == 0:
                self.memory.append(_memory_mib())
            self._second += 1
        given, self._waiting = self._waiting[:MOST_PENDING], self._waiting[MOST_PENDING:]
        self.made_s += time.process_time() - start
        return given

    def _made(self) -> list[bytes]:
        """Return the frames of a second, of each suspension."""
        times, second = divmod(self._second, len(self._by_second))
        found = []
        for one in self._by_second[second]:
            if one.sensor == "mileage" and times:
                continue
            shifted = replace(
                one,
                time_ns=one.time_ns + times * len(self._by_second) * 10**9,
                sequence=one.sequence + times * self._n_of[one.sensor],
                samples=one.samples.astype("f4") if one.sensor != "mileage" else one.samples,
            )
            found += [encode(replace(shifted, suspension=name)) for name in self._names]
        return found

    def confirm(self) -> None:
        """Forget nothing: the next frames are new."""

    def publish(self, kind: str, suspension: str, payload: bytes) -> None:
        """Count it."""
        self.counts[kind] += 1

    def close(self) -> None:
        """Close nothing."""


class Timed(Monitor):
    """A monitor that notes how long each frame takes until it is part of the state."""

    latencies_ms: array[float]

    def _take(self, data: bytes) -> None:
        start = time.perf_counter()
        super()._take(data)
        self.latencies_ms.append(1e3 * (time.perf_counter() - start))


def _memory_mib() -> float:
    """Return the memory that the process has now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main() -> None:
    """Monitor, and print what it took."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("trip", type=Path)
    parser.add_argument("--suspensions", type=int, default=1)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--every", type=float, default=LiveSettings().every_s)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "trip").mkdir()
        manifest, model = read_live_manifest(given.trip), load_model(given.run)
        (folder / "trip" / "trip.yaml").write_text(given.trip.read_text())
        (folder / "trip" / given.trip.stem).symlink_to(given.trip.with_suffix("").absolute())
        frames = list(Replay(folder / "trip").frames())
        live, settings = LiveSettings(every_s=given.every), FleetSettings(TripSettings())
        several = [
            LiveSuspension(replace(manifest, train=str(k)), [model], settings.trips, live)
            for k in range(given.suspensions)
        ]
        source, before_mib = Repeated(frames, given.hours), _memory_mib()
        with History(folder / "fleet.db") as store, Journal(folder / "journal") as journal:
            results = Results(store, settings, source.publish)
            monitor = Timed(several, source, journal, results.tell)
            monitor.latencies_ms = array("d")  # eight bytes each
            wall, start = time.perf_counter(), time.process_time()
            monitor.run()
            cpu_s = time.process_time() - start - source.made_s
            wall_s = time.perf_counter() - wall
        took, n_seconds = np.array(monitor.latencies_ms), source.n_seconds
        size_mib = sum(file.stat().st_size for file in folder.glob("journal*")) / 2**20
    n_all = given.suspensions * n_seconds
    print(f"{given.suspensions} suspensions, {given.hours:g} h each; {dict(source.counts)}")
    print(f"frames: {dict(monitor.counts)}")
    print(f"CPU {cpu_s:.1f} s, wall time {wall_s:.1f} s with the making of frames")
    print(
        f"{1e3 * cpu_s / n_all:.3f} ms for a second of a suspension: "
        f"{n_all / cpu_s:.0f} in real time"
    )
    told = ", ".join(f"{q:g} %: {np.percentile(took, q):.3f}" for q in (50, 99, 99.9))
    print(f"a frame is in the state after [ms] {told}, at most {took.max():.0f}")
    print("memory [MiB] " + " ".join(f"{one:.0f}" for one in source.memory), end="")
    each = (max(source.memory) - before_mib) / given.suspensions
    print(f", before {before_mib:.0f}: {each:.2f} each; journal {size_mib:.0f} MiB")


if __name__ == "__main__":
    main()
