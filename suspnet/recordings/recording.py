"""One trip, cleaned and on one clock: accelerations at three places and the speed.

A place may have a sensor on the left and one on the right. Each is read, cleaned and resampled on
its own. Half their sum is the channel, in which roll cancels; half their difference is kept too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from suspnet.checks import check_number
from suspnet.recordings.cleaning import Cleaner, CleaningSettings, Fault
from suspnet.recordings.formats import open_columns
from suspnet.recordings.manifest import (
    ACCELERATION_UNITS,
    CHANNELS,
    SIDES,
    SPEED_UNITS,
    Channel,
    SpeedSource,
    TripError,
    TripManifest,
)
from suspnet.recordings.resampling import Decimated, decimate, interpolate, support
from suspnet.recordings.timeline import Timeline, check_rate, check_rising
from suspnet.types import BoolArray, FloatArray

SHORTEST_S = 60.0
"""Least length of a recording, [s]."""

HIGHEST_HZ = 1e6
"""Highest rate of a sensor [Hz]; the filter that decimates it is as long as the rate is high."""

LARGEST_SPEED_M_PER_S = 150.0
"""Largest speed of a train [m/s]; a larger value counts as unknown."""

LONGEST_SPEED_GAP_S = 10.0
"""Longest time [s] between two speeds that is interpolated; the speed is unknown in longer
ones."""


@dataclass(frozen=True)
class Recording:
    """One trip on one clock.

    Attributes
    ----------
    manifest : TripManifest
    rate_hz : float, [Hz]
    signals : array of shape (3, n), [m/s2]
        Accelerations in the order of ``CHANNELS``, upwards or downwards as the signs in the
        manifest make it, with zero phase and gain 1 up to ``rate_hz / 4``. Where there is a pair
        of sensors, their average, (left + right) / 2.
    usable : array of shape (n,)
        False where a fault that was not repaired takes part in a signal, or the speed is unknown.
    speed_m_per_s : array of shape (n,), [m/s]
        NaN where unknown.
    faults : tuple of Fault
        By channel and kind.
    duration_s : float, [s]
        ``n / rate_hz``.
    start_s : float, [s]
        Time of the first sample on the trip's clock, a multiple of ``1 / rate_hz``.
    paired : tuple of 3 bool
        Which channels are pairs of sensors, in the order of ``CHANNELS``.
    differences : array of shape (n_pairs, n), [m/s2]
        (left - right) / 2 of each pair, in the order of ``CHANNELS``.
    """

    manifest: TripManifest
    rate_hz: float
    signals: FloatArray
    usable: BoolArray
    speed_m_per_s: FloatArray
    faults: tuple[Fault, ...]
    duration_s: float
    start_s: float = 0.0
    paired: tuple[bool, bool, bool] = (False, False, False)
    differences: FloatArray = field(default_factory=lambda: np.empty((0, 0)))


@dataclass(frozen=True)
class _Stream:
    """One sensor after the first stage of resampling."""

    name: str
    decimated: Decimated
    rate_hz: float
    start_s: float
    n_samples: int
    faults: tuple[Fault, ...]

    @property
    def end_s(self) -> float:
        return self.start_s + self.n_samples / self.rate_hz

    def positions(self, times_s: FloatArray | float) -> FloatArray:
        """Return instants of the trip's clock in samples after the first stage."""
        elapsed = (np.asarray(times_s) - self.start_s) * self.rate_hz
        return np.asarray((elapsed - self.decimated.first) / self.decimated.factor)

    def span_s(self, wanted_hz: float) -> tuple[float, float]:
        """Return the first and last instant at which the second stage has all that it needs."""
        half = support(self.oversampling(wanted_hz))
        ends = np.array([half, len(self.decimated.values) - 1 - half])
        first, last = self.start_s + (self.decimated.first + ends * self.decimated.factor) / (
            self.rate_hz
        )
        return float(first), float(last)

    def oversampling(self, wanted_hz: float) -> float:
        return self.rate_hz / self.decimated.factor / wanted_hz


def load_recording(
    manifest: TripManifest, rate_hz: float = 100.0, cleaning: CleaningSettings | None = None
) -> Recording:
    """Return a trip, cleaned and resampled to one clock.

    Files are read block by block, the sensors at the same time. Only the time that all sensors
    cover is kept, less about ``8 / rate_hz`` at both ends, where the low-pass is not complete.

    Parameters
    ----------
    manifest : TripManifest
    rate_hz : float, [Hz]
        Rate of the result; signals are flat within 1e-4 up to a quarter of it.
    cleaning : CleaningSettings, optional

    Raises
    ------
    TripError
        If a file cannot be read, a rate is lower than `rate_hz`, a sensor is constant or has no
        usable sample, fewer than ``SHORTEST_S`` are common to all sensors, times are wrong, or
        the speed is unknown throughout.
    ValueError
        If `rate_hz` is not positive and finite.
    """
    check_number("rate_hz", rate_hz, above=0)
    sensors = manifest.sensors()
    with ThreadPoolExecutor(len(sensors)) as pool:
        streams = list(
            pool.map(
                lambda name: _read_sensor(manifest, name, sensors[name], rate_hz, cleaning), sensors
            )
        )
        times_s = _common_times(manifest, streams, rate_hz)
        resampled = list(pool.map(lambda stream: _resample(stream, times_s, rate_hz), streams))
    speed = _speed_at(manifest, times_s)
    faults = tuple(fault for stream in streams for fault in stream.faults)
    usable = np.isfinite(speed) & ~np.any([touched for _, touched in resampled], axis=0)
    if not usable.any():
        raise TripError(
            f"{manifest.path}: at no time are all channels and the speed usable: "
            f"{'; '.join(map(str, faults)) or 'the speed is never known'}"
        )
    values = dict(zip(sensors, (values for values, _ in resampled), strict=True))
    paired, signals, differences = _combined(manifest, values)
    duration_s = len(times_s) / rate_hz
    return Recording(
        manifest,
        rate_hz,
        signals,
        usable,
        speed,
        faults,
        duration_s,
        float(times_s[0]),
        paired,
        differences,
    )


def _combined(
    manifest: TripManifest, values: Mapping[str, FloatArray]
) -> tuple[tuple[bool, bool, bool], FloatArray, FloatArray]:
    """Return which channels are pairs, the channels (3, n), and the pairs' half differences."""
    signals, differences = [], []
    axle_box, bogie, body = (not isinstance(manifest.channels[name], Channel) for name in CHANNELS)
    paired = axle_box, bogie, body
    for name, is_pair in zip(CHANNELS, paired, strict=True):
        if is_pair:
            left, right = (values[f"{name} {side}"] for side in SIDES)
            signals.append((left + right) / 2)
            differences.append((left - right) / 2)
        else:
            signals.append(values[name])
    n = len(signals[0])
    return paired, np.stack(signals), np.array(differences).reshape(len(differences), n)


def _read_sensor(
    manifest: TripManifest,
    name: str,
    channel: Channel,
    wanted_hz: float,
    cleaning: CleaningSettings | None,
) -> _Stream:
    """Read, clean and decimate one sensor as it streams by."""
    where = f"{manifest.path}: channel {name!r}"
    unit = ACCELERATION_UNITS[channel.unit]
    timeline = Timeline(where, channel.rate_hz) if channel.time is not None else None
    blocks = _values(manifest, channel, timeline)
    first_block = next(blocks)
    rate_hz = _known_rate(where, channel.rate_hz, timeline)
    if rate_hz < 0.99 * wanted_hz:
        raise TripError(f"{where} has {rate_hz:g} Hz; at least {wanted_hz:g} Hz are needed")
    if rate_hz > HIGHEST_HZ:
        raise TripError(f"{where} has {rate_hz:g} Hz; at most {HIGHEST_HZ:g} Hz can be read")
    full_scale = None if channel.range is None else channel.range * unit
    cleaner = Cleaner(name, rate_hz, full_scale, cleaning)
    scaled = (channel.sign * unit * block for block in chain([first_block], blocks))
    decimated = decimate(cleaner.clean(scaled), rate_hz, wanted_hz)
    start_s = channel.start_s + (0.0 if timeline is None else timeline.first_s)
    faults = cleaner.faults(start_s)
    _check_alive(where, cleaner, faults)
    rate_hz = _known_rate(where, channel.rate_hz, timeline)
    return _Stream(name, decimated, rate_hz, start_s, cleaner.n_samples, faults)


def _values(
    manifest: TripManifest, channel: Channel, timeline: Timeline | None
) -> Iterator[FloatArray]:
    """Yield a sensor's values in its own unit, evenly sampled."""
    path = manifest.file_of(channel)
    if timeline is not None:
        yield from timeline.even(open_columns(path, [channel.time, channel.column]))
    else:
        for (block,) in open_columns(path, [channel.column]):
            yield block


def _known_rate(where: str, stated_hz: float | None, timeline: Timeline | None) -> float:
    """Return a sensor's rate as stated or by its time stamps, [Hz]."""
    if timeline is None:
        assert stated_hz is not None  # the manifest has one or the other
        return stated_hz
    if math.isnan(timeline.rate_hz):
        raise TripError(f"{where} has fewer than two samples; its rate is unknown")
    return timeline.rate_hz


def _check_alive(where: str, cleaner: Cleaner, faults: tuple[Fault, ...]) -> None:
    """Raise TripError if a sensor has no usable sample."""
    if cleaner.n_bad < cleaner.n_samples:
        return
    n_constant = sum(fault.n_samples for fault in faults if fault.kind == "constant")
    if n_constant == cleaner.n_samples and cleaner.lowest == cleaner.highest:
        value = f"{cleaner.lowest:g}"
        raise TripError(f"{where} is constant ({value}) throughout: is the sensor connected?")
    raise TripError(f"{where} has no usable sample: {'; '.join(map(str, faults))}")


def _common_times(manifest: TripManifest, streams: list[_Stream], rate_hz: float) -> FloatArray:
    """Return the instants of the common clock, shape (n,), [s]."""
    common_s = min(s.end_s for s in streams) - max(s.start_s for s in streams)
    if common_s < SHORTEST_S - 1 / rate_hz:
        spans = ", ".join(
            f"{stream.name} from {stream.start_s:.1f} to {stream.end_s:.1f} s" for stream in streams
        )
        raise TripError(
            f"{manifest.path}: only {max(common_s, 0.0):.1f} s are common to all channels; "
            f"at least {SHORTEST_S:g} s are needed ({spans})"
        )
    spans_s = [stream.span_s(rate_hz) for stream in streams]
    first = math.ceil(max(first for first, _ in spans_s) * rate_hz - 1e-9)
    last = math.floor(min(last for _, last in spans_s) * rate_hz + 1e-9)
    return np.arange(first, last + 1) / rate_hz


def _resample(stream: _Stream, times_s: FloatArray, rate_hz: float) -> tuple[FloatArray, BoolArray]:
    """Return a sensor at instants of the common clock, and where a bad sample took part."""
    decimated = stream.decimated
    return interpolate(
        decimated.values,
        decimated.touched,
        stream.positions(times_s),
        stream.oversampling(rate_hz),
    )


def _speed_at(manifest: TripManifest, times_s: FloatArray) -> FloatArray:
    """Return the speed at some instants, NaN where unknown, shape (n,), [m/s]."""
    source = manifest.speed
    if not isinstance(source, SpeedSource):
        return np.full(len(times_s), source)
    known_s, speed = _read_speed(manifest, source)
    speed = np.where((speed >= 0) & (speed <= LARGEST_SPEED_M_PER_S), speed, np.nan)
    found = np.interp(times_s, known_s, speed)
    step_s = np.median(np.diff(known_s)) if len(known_s) > 1 else 1 / (source.rate_hz or np.inf)
    found[(times_s < known_s[0] - step_s) | (times_s > known_s[-1] + step_s)] = np.nan
    after = np.clip(np.searchsorted(known_s, times_s), 1, max(len(known_s) - 1, 1))
    if len(known_s) > 1:
        found[np.diff(known_s)[after - 1] > LONGEST_SPEED_GAP_S] = np.nan
    if np.isnan(found).all():
        raise TripError(
            f"{manifest.path}: `speed` is never between 0 and {LARGEST_SPEED_M_PER_S:g} m/s while "
            "the channels record; are its unit, time and start_s right?"
        )
    return found


def _read_speed(manifest: TripManifest, source: SpeedSource) -> tuple[FloatArray, FloatArray]:
    """Return times on the trip's clock [s] and speeds [m/s], both of shape (n_known,)."""
    path, where = manifest.file_of(source), f"{manifest.path}: `speed`"
    columns = [source.column] if source.time is None else [source.time, source.column]
    blocks = list(open_columns(path, columns))
    *times, speed = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    if not times:
        assert source.rate_hz is not None  # the manifest has one or the other
        known_s = np.arange(len(speed)) / source.rate_hz
    else:
        (known_s,) = times
        check_rising(where, known_s)
        if len(known_s) > 1:
            check_rate(where, source.rate_hz, 1 / float(np.median(np.diff(known_s))))
    return source.start_s + known_s, SPEED_UNITS[source.unit] * speed
