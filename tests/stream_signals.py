"""Signals of a short trip: as files for the batch, and as frames with faults for the stream."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from suspnet.depot.live.journal import dump_state, load_state
from suspnet.trains.recordings.frames import Frame, FrameError, decode, encode
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_sources import SensorSource, SpeedSource
from suspnet.trains.recordings.recording import load_recording

ZERO_NS = 1_700_000_000_000_000_000
RATES_HZ = {"axle_box": 400.0, "bogie": 250.0, "body": 250.0, "speed": 4.0}
STARTS_S = {"axle_box": 0.013, "bogie": 0.5, "body": 0.1237, "speed": 0.25}
WINDOW = 6


def signals(seed=0, seconds=100.0, rates_hz=RATES_HZ):
    """Return float32 samples of each sensor and of the speed, with spikes and clipped parts."""
    rng = np.random.default_rng(seed)
    found = {}
    for name, rate_hz in rates_hz.items():
        n = int(rate_hz * (seconds - STARTS_S[name]))
        if name == "speed":
            found[name] = (70 + 0.3 * np.sin(np.arange(n) / 50)).astype("f4")
            continue
        values = rng.normal(size=n).cumsum()
        values -= np.convolve(values, np.ones(100) / 100, "same")
        values[rng.integers(n)] += 1e3
        at = rng.integers(n // 2)
        values[at : at + int(rate_hz)] = rng.normal()
        found[name] = np.clip(values, -30, 30).astype("f4")
    return found


def frames_of(name, samples, rng, rate_hz, n_lost=0, most=300):
    """Return a sensor's frames, cut at random, without those that are lost."""
    sizes = rng.integers(1, most, size=4 * len(samples) // most + 60)
    ends = np.minimum(np.cumsum(sizes), len(samples))
    starts = np.concatenate([[0], ends[:-1]])
    frames = [
        Frame(
            "front left",
            name,
            1000 + k,
            ZERO_NS + round((STARTS_S[name] + start / rate_hz) * 1e9),
            rate_hz,
            "m/s" if name == "speed" else "m/s2",
            samples[start:end],
        )
        for k, (start, end) in enumerate(zip(starts, ends, strict=True))
        if end > start
    ]
    lost = rng.choice(np.arange(1, len(frames) - 1), size=n_lost, replace=False)
    return [frame for k, frame in enumerate(frames) if k not in lost]


def disturbed(frames, rng, window=WINDOW, duplicates=0.1):
    """Return frames with duplicates, none after more than `window` later ones."""
    order = np.argsort(np.arange(len(frames)) + rng.uniform(0, window, len(frames)))
    found = []
    for k in order:
        found.append(frames[k])
        if rng.random() < duplicates:
            found.append(found[rng.integers(max(len(found) - 3 * window, 0), len(found))])
    return found


def interleaved(parts, rng):
    """Return the frames of several sensors in one random order that keeps each sensor's own."""
    owners = np.concatenate([np.full(len(part), k) for k, part in enumerate(parts)])
    rng.shuffle(owners)
    ways = [iter(part) for part in parts]
    return [next(ways[k]) for k in owners]


def with_gaps(samples, frames, name, rate_hz):
    """Return samples with NaN where no frame is."""
    found = np.full(len(samples), np.nan)
    for frame in frames:
        start = round(((frame.time_ns - ZERO_NS) / 1e9 - STARTS_S[name]) * rate_hz)
        found[start : start + len(frame.samples)] = frame.samples
    return found


def manifest_in(folder, rates_hz=RATES_HZ):
    """Return the manifest of the trip's files."""
    sources = {
        name: {"file": f"{name}.parquet", "rate_hz": rate_hz, "start_s": STARTS_S[name]}
        for name, rate_hz in rates_hz.items()
    }
    channels = {name: SensorSource(unit="m/s2", sign=-1, **sources[name]) for name in CHANNELS}
    channels["body"] = SensorSource(unit="m/s2", range=50.0, **sources["body"])
    speed = SpeedSource(unit="m/s", **sources["speed"]) if "speed" in sources else 70.0
    return TripManifest(
        path=folder / "trip.yaml",
        name="trip",
        vehicle="train",
        suspension="front left",
        mileage_km=1.0,
        speed=speed,
        channels=channels,
    )


def batch(manifest, columns):
    """Return the recording that the batch reads from files."""
    for name, values in columns.items():
        table = pa.table({"value": values})
        pq.write_table(table, manifest.path.parent / f"{name}.parquet", use_dictionary=False)
    return load_recording(manifest)


def encoded(frames):
    """Return frames as bytes."""
    return [encode(frame) for frame in frames]


def taken(stream, data):
    """Give a stream an encoded frame; return why it cannot be used, or nothing."""
    try:
        stream.add(decode(data))
    except FrameError as error:
        return error.reason
    return ""


def gone_on(stream, other):
    """Return another stream of the same kind that goes on from the saved state of the first."""
    other.restore(load_state(dump_state(stream.identity, stream.state()), other.identity))
    return other
