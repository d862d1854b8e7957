"""Frames of simulated trips for the monitor, and a source that gives them."""

from collections import Counter
from concurrent.futures import Executor, Future
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from suspnet.ground.storage import write_atomically
from suspnet.trains.recordings.frames import Frame, encode
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.manifest_sources import SpeedSource


def columns_of(manifest):
    """Return the samples of each sensor and of the speed of a simulated trip, and their rates."""
    sources = {**manifest.sensors()}
    if isinstance(manifest.speed, SpeedSource):
        sources["speed"] = manifest.speed
    found = {}
    for name, source in sources.items():
        samples = pq.read_table(manifest.file_of(source))[source.column].to_numpy()
        found[name] = (source.rate_hz, source.unit, samples)
    return found


def trip_frames(path, rng=None, n_cuts=60, suspension=None):
    """Return the frames of each sensor of a trip, cut at random or into equal parts."""
    manifest = read_manifest(path)
    zero_ns = round(manifest.start.timestamp()) * 10**9
    found = {}
    for name, (rate_hz, unit, samples) in columns_of(manifest).items():
        if rng is None:
            starts = np.unique(np.linspace(0, len(samples), n_cuts, endpoint=False).astype(int))
        else:
            starts = np.unique([0, *rng.integers(len(samples), size=n_cuts)])
        parts = zip(starts, np.split(samples, starts[1:]), strict=True)
        where = str(manifest.place) if suspension is None else suspension
        found[name] = [
            Frame(where, name, k, zero_ns + round(at / rate_hz * 1e9), rate_hz, unit, part)
            for k, (at, part) in enumerate(parts)
        ]
    return found


def all_frames(path):
    """Return the encoded frames of a trip by their time, without its mileage."""
    return by_time([one for several in trip_frames(path).values() for one in several])


def mileage_frame(path):
    """Return the frame that tells a trip's mileage."""
    manifest = read_manifest(path)
    zero_ns = round(manifest.start.timestamp()) * 10**9
    km = np.array([manifest.mileage_km])
    return Frame(str(manifest.place), "mileage", 0, zero_ns, 1.0, "km", km)


def by_time(frames):
    """Return encoded frames by their time."""
    return [encode(one) for one in sorted(frames, key=lambda one: one.time_ns)]


class AtOnce(Executor):
    """Runs what it is given before it returns, for tests of an order of events."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


class ListSource:
    """Encoded frames of a list; what is confirmed is kept in a file, and not given again.

    With `pauses` it gives nothing every other time.
    """

    def __init__(self, frames, at_once=20, offset: Path | None = None, pauses: bool = False):
        self.frames, self.at_once, self.offset = frames, at_once, offset
        self.pauses, self.is_pause = pauses, False
        self.counts: Counter[str] = Counter()
        self.at = self.confirmed = 0
        if offset is not None and offset.exists():
            self.at = self.confirmed = int(offset.read_text())

    def subscribe(self, suspensions):
        return suspensions

    def receive(self, timeout_s):
        if self.at >= len(self.frames):
            return None
        self.is_pause = self.pauses and not self.is_pause
        if self.is_pause:
            return []
        given = self.frames[self.at : self.at + self.at_once]
        self.at += len(given)
        return given

    def confirm(self, n_frames=None):
        self.confirmed = self.at if n_frames is None else self.confirmed + n_frames
        if self.offset is not None:
            write_atomically(self.offset, str(self.confirmed))

    def close(self):
        pass
