"""A recorded trip as frames: the raw samples of each sensor at the times when they were taken."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from itertools import chain
from typing import Any

import numpy as np

from suspnet.ground.types import FloatArray
from suspnet.recordings.clocks import SECOND_NS, Zero, offsets_s
from suspnet.recordings.faults import find_gaps, runs
from suspnet.recordings.frames import MOST_SAMPLES, Frame, end_ns
from suspnet.recordings.manifest import (
    ACCELERATION_UNITS,
    SPEED_UNITS,
    Source,
    SpeedSource,
    TripManifest,
)
from suspnet.recordings.sources import OpenSource, open_source, zero_of

MILEAGE, TEMPERATURE = ("mileage", "km"), ("temperature", "degC")
"""Sensor and unit of the frames of one sample at the begin of a trip."""

SLOW_HZ = 1.0
"""Rate of these frames, which no sample follows."""

UNITS = {"acceleration": ("m/s2", ACCELERATION_UNITS), "speed": ("m/s", SPEED_UNITS)}
"""Unit of frames where the manifest leaves it to the file, and the known ones."""


@dataclass(frozen=True)
class TripClock:
    """When a trip was recorded.

    Attributes
    ----------
    zero_ns : int or None, [ns]
        Zero of the trip's clock, since 1970 in UTC; None if neither manifest nor files say it.
    offsets_s : mapping of float, [s]
        For each sensor and the speed, what is added to its times.
    """

    zero_ns: int | None
    offsets_s: Mapping[str, float]


def sources_of(manifest: TripManifest) -> dict[str, tuple[str, Source]]:
    """Return kind and source of each sensor, and of the speed if it is recorded."""
    found: dict[str, tuple[str, Source]] = {
        name: ("acceleration", one) for name, one in manifest.sensors().items()
    }
    if isinstance(manifest.speed, SpeedSource):
        found["speed"] = "speed", manifest.speed
    return found


def trip_clock(manifest: TripManifest, zone: tzinfo = UTC) -> TripClock:
    """Return when a trip was recorded.

    Parameters
    ----------
    manifest : TripManifest
    zone : tzinfo
        Of a `start` and of time stamps that name none.

    Raises
    ------
    TripError
        If a file cannot be read, or clocks cannot be aligned.
    """
    zeros = {
        name: zero_of(manifest, source, _where(manifest, name), kind)
        for name, (kind, source) in sources_of(manifest).items()
    }
    offsets = offsets_s(manifest, zeros)
    dated = {name: zero.ns for name, zero in zeros.items() if zero.ns is not None}
    for name, ns in dated.items():
        zero_ns = ns - round(offsets[name] * SECOND_NS)
        return TripClock(zero_ns - _ahead_ns(zero_ns, zeros[name], zone), offsets)
    return TripClock(None if manifest.start is None else nanoseconds(manifest.start, zone), offsets)


def nanoseconds(moment: datetime, zone: tzinfo) -> int:
    """Return a date and time, in a zone if it names none, in nanoseconds since 1970 in UTC."""
    aware = moment if moment.tzinfo is not None else moment.replace(tzinfo=zone)
    return (aware - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


def trip_frames(
    manifest: TripManifest,
    zero_ns: int,
    offsets: Mapping[str, float],
    numbers: Counter[str],
    frame_s: float = 1.0,
) -> Iterator[Frame]:
    """Yield the frames of a trip in the order in which they would be complete.

    Samples have the unit of the manifest and are as in the file: not cleaned, filtered or turned.
    They are float32 where that holds them exactly, else float64. A sample that is missing (NaN,
    infinite or absurd) or whose time is missing ends a frame. A block of each sensor is in memory.

    Parameters
    ----------
    manifest : TripManifest
    zero_ns : int, [ns]
    offsets : mapping of float, [s]
        As of `TripClock`.
    numbers : Counter
        Sequence number of the next frame of each sensor, which goes on.
    frame_s : float, [s]
        Length of a frame; none has more than ``MOST_SAMPLES``.

    Raises
    ------
    TripError
        If a file cannot be read or contradicts the manifest.
    """
    suspension = str(manifest.place)
    streams = [
        _sensor_frames(manifest, name, zero_ns + round(offsets[name] * SECOND_NS), numbers, frame_s)
        for name in sources_of(manifest)
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
    """Yield the frames of one sensor; `zero_ns` is what its times are counted from."""
    kind, source = sources_of(manifest)[name]
    where, suspension = _where(manifest, name), str(manifest.place)
    with open_source(manifest, source, where, kind) as opened:
        unit, factor = _unit(kind, source, opened)
        blocks = opened.even()
        first_block = next(blocks)
        rate_hz = opened.known_rate_hz
        first_s = source.start_s + opened.first_s
        first_ns = zero_ns + round(first_s * SECOND_NS)
        size = max(1, min(MOST_SAMPLES, round(frame_s * rate_hz)))
        whole = chain([first_block], blocks)
        del first_block  # it is as large as all else that is held of a sensor
        for at, values in _recut(whole, size):
            for start, stop in zip(*runs(~find_gaps(values)), strict=True):
                time_ns = first_ns + round((at + start) * SECOND_NS / rate_hz)
                samples = _shortest(factor * values[start:stop])
                number = _next(numbers, name)
                yield Frame(suspension, name, number, time_ns, rate_hz, unit, samples)


def _recut(blocks: Iterable[FloatArray], size: int) -> Iterator[tuple[int, FloatArray]]:
    """Yield pieces of `size` samples of a signal, the last one shorter, and where they begin."""
    at, rest = 0, np.empty(0)
    for block in blocks:
        rest = np.concatenate([rest, block])
        del block
        n_whole = len(rest) - len(rest) % size
        for start in range(0, n_whole, size):
            yield at + start, rest[start : start + size]
        at, rest = at + n_whole, rest[n_whole:]
    if len(rest):
        yield at, rest


def _unit(kind: str, source: Source, opened: OpenSource) -> tuple[str, float]:
    """Return the unit of a source's frames, and what the numbers in its file are in it."""
    usual, sizes = UNITS[kind]
    unit = source.unit or usual
    return unit, abs(opened.size) / sizes[unit]


def _shortest(samples: FloatArray) -> FloatArray:
    """Return samples in single precision where that changes none of them."""
    with np.errstate(over="ignore"):
        single: Any = samples.astype(np.float32)
    return single if (single == samples).all() else samples


def _next(numbers: Counter[str], name: str) -> int:
    """Return the number of a sensor's next frame, and count it."""
    numbers[name] += 1
    return numbers[name] - 1


def _ahead_ns(local_ns: int, zero: Zero, zone: tzinfo) -> int:
    """Return what a clock is ahead of UTC, [ns]: nothing if its zone is known."""
    if zero.is_zoned:
        return 0
    naive = datetime(1970, 1, 1) + timedelta(seconds=local_ns // SECOND_NS)
    offset = naive.replace(tzinfo=zone).utcoffset()
    assert offset is not None  # every zone has an offset
    return round(offset.total_seconds()) * SECOND_NS


def _where(manifest: TripManifest, name: str) -> str:
    """Return how errors name a source."""
    named = "`speed`" if name == "speed" else f"channel {name!r}"
    return f"{manifest.path}: {named}"
