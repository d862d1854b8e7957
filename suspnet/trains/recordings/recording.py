"""One trip, cleaned and on one clock: accelerations at three places and the speed.

A place may have a sensor on the left and one on the right. Each is read, cleaned and resampled
separately. Their mean is the channel, in which roll cancels; half their difference is also stored.
Where one of them is dead, the other one alone is the channel. Sensors at the bogie's other axle
belong to no channel.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property, partial
from itertools import chain
from typing import Self

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import SIDES
from suspnet.ground.records import Overview
from suspnet.ground.settings import check_number
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.trains.recordings.cleaning import Cleaner, Fault
from suspnet.trains.recordings.clock_drift import clock_faults
from suspnet.trains.recordings.clocks import first_moment, offsets_s
from suspnet.trains.recordings.dead_sensors import (
    DEAD,
    dead_faults,
    find_loose,
    living,
    nearly_dead,
)
from suspnet.trains.recordings.errors import TripError, all_of
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_sources import channel_of
from suspnet.trains.recordings.sensor import PASS, SensorSignal, SensorStream
from suspnet.trains.recordings.sources import open_source, zero_of
from suspnet.trains.recordings.speed import SpeedTrack, read_speed, speed_at

MOST_AT_ONCE = 2  # number of sensors that are read in parallel, which bounds the memory
NO_DEAD: Mapping[str, str] = {}  # no sensor is dead
HIGHEST_HZ = 1e6
"""Highest rate of a sensor [Hz]; the length of the decimation filter grows with the rate."""


@dataclass(frozen=True, eq=False, repr=False)
class Recording(ShortRepr):
    """One trip on one clock.

    `values` are the signals (n,) of the living sensors, by the names of ``TripManifest.sensors``,
    [m/s2], with the signs of the manifest, zero phase and gain 1 up to ``rate_hz / 4``. `usable`
    (n,) is False where an unrepaired fault affects a signal, or the speed is unknown;
    `speed_m_per_s` (n,) is NaN where unknown; `faulty` says where each sensor is not usable, by
    name, of those that have such times. `faults` are by channel and kind. `duration_s` is
    ``n / rate_hz``, `start_s` the time of the first sample on the trip's clock, a multiple of
    ``1 / rate_hz``. `words` state how files were read, where this was detected, `started` the start
    of the trip by the times and headers of its files; None if they do not state it.
    """

    manifest: TripManifest
    rate_hz: float
    values: Mapping[str, FloatArray]
    usable: BoolArray
    speed_m_per_s: FloatArray
    faults: tuple[Fault, ...]
    duration_s: float
    start_s: float = 0.0
    words: str = ""
    started: datetime | None = None
    faulty: Mapping[str, BoolArray] = field(default_factory=dict)

    @cached_property
    def _places(self) -> list[dict[str, FloatArray]]:
        """The sensors of each channel by name, left first."""
        signals = self.values.items()
        return [{name: v for name, v in signals if channel_of(name) == c} for c in CHANNELS]

    @cached_property
    def signals(self) -> FloatArray:
        """Accelerations (3, n) in the order of ``CHANNELS``, [m/s2].

        For a pair of sensors, (left + right) / 2. NaN without a living sensor at axle 1.
        """
        nothing = [np.full(len(self.usable), np.nan)]
        return np.stack([np.mean([*s.values()] or nothing, axis=0) for s in self._places])

    @property
    def paired(self) -> tuple[bool, bool, bool]:
        """Which channels are pairs of sensors of which none is dead, by ``CHANNELS``."""
        axle_box, bogie, body = (len(sides) == len(SIDES) for sides in self._places)
        return axle_box, bogie, body

    @property
    def differences(self) -> FloatArray:
        """(left - right) / 2 of each pair, (n_pairs, n), in the order of ``CHANNELS``, [m/s2]."""
        pairs = [tuple(sides.values()) for sides in self._places if len(sides) == len(SIDES)]
        halves = [(left - right) / 2 for left, right in pairs]
        return np.array(halves).reshape(len(halves), len(self.usable))

    @property
    def elsewhere(self) -> dict[str, FloatArray]:
        """Signals of the sensors at the bogie's other axle, by name."""
        return {name: signal for name, signal in self.values.items() if not channel_of(name)}

    def without(self, dead: str) -> Self:
        """Return the recording as if a sensor were dead, usable where no other one is faulty."""
        usable = np.isfinite(self.speed_m_per_s)
        faulty = {name: where for name, where in self.faulty.items() if name != dead}
        for where in faulty.values():
            usable &= ~where
        fault = Fault(dead, DEAD, len(usable), self.duration_s, 0.0, True)
        values = {name: signal for name, signal in self.values.items() if name != dead}
        faults = (*self.faults, fault)
        return replace(self, values=values, usable=usable, faults=faults, faulty=faulty)

    def sensors(self) -> dict[str, FloatArray]:
        """Return `values`, those of the bogie's other axle last."""
        placed = {name: signal for sides in self._places for name, signal in sides.items()}
        return placed | self.elsewhere

    @property
    def absent(self) -> tuple[str, ...]:
        """Channels without a living sensor at axle 1."""
        places = zip(CHANNELS, self._places, strict=True)
        return tuple(name for name, sides in places if not sides)

    @property
    def dead(self) -> tuple[str, ...]:
        """Names of the sensors that are left out."""
        dead = (fault.channel for fault in self.faults if fault.kind == DEAD)
        return tuple(dict.fromkeys(dead))

    @property
    def sides(self) -> tuple[str | None, ...]:
        """Side of each channel's only sensor; None for a pair, in the middle, or if unknown."""
        sensors, sides = self.manifest.sensors(), []
        for signals in self._places:
            first = sensors[next(iter(signals))] if len(signals) == 1 else None
            side = None if first is None else self.manifest.side_of(first)
            sides.append(side if side in SIDES else None)
        return tuple(sides)


def load_recording(manifest: TripManifest, rate_hz: float = 100.0) -> Recording:
    """Return a trip, cleaned and resampled to one clock.

    Files are read block by block, ``MOST_AT_ONCE`` sensors in parallel. A dead sensor of a pair, or
    of more than ``LEAST_SENSORS``, is left out, with a fault. The result covers the time common to
    all sensors, less about ``8 / rate_hz`` at both ends, where the low-pass filter is incomplete.

    Signals are flat within 1e-4 up to a quarter of `rate_hz`.

    Raises TripError if a file cannot be read, a rate is lower than `rate_hz`, too many sensors are
    constant or have no usable sample, less than the manifest's ``shortest_s`` is common to all
    sensors, times are wrong, or the speed is unknown throughout; its `problems` are those of all
    sensors and the speed. ValueError if `rate_hz` is not positive and finite.
    """
    check_number("rate_hz", rate_hz, above=0)
    sensors = manifest.sensors()
    problems: tuple[str, ...] = ()
    started, doubt = None, ""
    try:
        track, offsets, (started, doubt) = _clocks(manifest)
    except TripError as error:  # read the sensors anyway, to report their problems as well
        track, offsets, problems = None, dict.fromkeys(sensors, 0.0), error.problems
    with ThreadPoolExecutor(MOST_AT_ONCE) as pool:
        readers = {
            name: pool.submit(_read_sensor, manifest, name, offsets[name], rate_hz).result
            for name in sensors
        }
        streams, dead = living(manifest, readers, problems)
    del readers  # they hold the signals a second time
    recording = joined(manifest, streams, track, offsets.get("speed", 0.0), rate_hz, dead)
    # the date is not known to `joined`, which also serves streams
    return replace(recording, started=started, words=together((recording.words, doubt)))


def joined(
    manifest: TripManifest,
    streams: Sequence[SensorSignal],
    track: SpeedTrack | None,
    offset_s: float,
    rate_hz: float,
    dead: Mapping[str, str] = NO_DEAD,
) -> Recording:
    """Combine all sensors of a trip over their common time; raises what `load_recording` does.

    `track` is None if the manifest gives a constant speed; `offset_s` is the zero of its times on
    the trip's clock; `rate_hz` is the rate of the common clock; `dead` are the reasons why sensors
    are missing.
    """

    def without(more: Mapping[str, str]) -> Recording:
        rest = [stream for stream in streams if stream.name not in more]
        return joined(manifest, rest, track, offset_s, rate_hz, {**dead, **more})

    # a sensor of which nearly nothing is usable would leave nothing of the others
    if more := nearly_dead(streams, rate_hz):
        return without(more)
    first, last = _common(manifest, streams, rate_hz)
    times_s = np.arange(first, last + 1) / rate_hz
    duration_s = len(times_s) / rate_hz
    speed, speed_faults = speed_at(manifest, track, offset_s, times_s)
    # all sensors at the instants of the common clock
    touched = np.zeros(len(times_s), dtype=np.bool_)
    values, faulty = {}, {}
    for stream in streams:
        part = slice(first - stream.first, last + 1 - stream.first)
        values[stream.name], faulty[stream.name] = stream.values[part], stream.touched[part]
        touched |= stream.touched[part]
    # faults between sensors: loose ones first, as they have no clock to compare
    usable = np.isfinite(speed) & ~touched
    loose_faults, loose, silent = find_loose(values, usable, speed, rate_hz, float(times_s[0]))
    if more := nearly_dead(streams, rate_hz, loose_faults):
        return without(more)
    own_faults = (fault for stream in streams for fault in stream.faults)
    faults = (*own_faults, *speed_faults, *loose_faults, *dead_faults(dead, duration_s, rate_hz))
    usable &= ~loose.any(axis=0)
    faulty = {name: marked | its for (name, marked), its in zip(faulty.items(), loose, strict=True)}
    if not usable.any():
        reasons = together(map(str, faults)) or "the speed is never known"
        raise TripError.at(manifest.path, "nowhere-usable", faults=reasons)
    faults += clock_faults(manifest, values, usable & ~silent, speed, rate_hz)
    read_as = [track.words if track else "", *(stream.words for stream in streams)]
    return Recording(
        manifest,
        rate_hz,
        values,
        usable,
        speed,
        faults,
        duration_s,
        float(times_s[0]),
        together(dict.fromkeys(read_as)),
        faulty={name: where for name, where in faulty.items() if where.any()},
    )


def _clocks(
    manifest: TripManifest,
) -> tuple[SpeedTrack | None, dict[str, float], tuple[datetime | None, str]]:
    """Return the speeds, the clock offsets of sensors and speed [s], and `first_moment`."""
    sensors = manifest.sensors()
    track, *of_sensors = all_of(
        [partial(read_speed, manifest), *(partial(zero_of, manifest, name) for name in sensors)]
    )
    zeros = dict(zip(sensors, of_sensors, strict=True))
    zeros |= {} if track is None else {"speed": track.zero}
    return track, offsets_s(manifest, zeros), first_moment(zeros.values())


def _read_sensor(trip: TripManifest, name: str, offset_s: float, wanted_hz: float) -> SensorSignal:
    where, channel = trip.where(name), trip.sensors()[name]
    with open_source(trip, channel, where) as source:
        blocks = source.even(PASS * wanted_hz)
        first_block = next(blocks)  # read first: time stamps then give the approximate rate
        rate_hz = source.known_rate_hz
        if rate_hz < 0.99 * wanted_hz:
            values = {"rate_hz": rate_hz, "wanted_hz": wanted_hz}
            raise TripError(Finding("rate-too-low", where=where, **values))
        if rate_hz > HIGHEST_HZ:
            values = {"rate_hz": rate_hz, "highest_hz": HIGHEST_HZ}
            raise TripError(Finding("rate-too-high", where=where, **values))
        cleaner = Cleaner(name, rate_hz, source.full_scale)
        sensor = SensorStream(where, cleaner, source.size, wanted_hz)
        for block in chain([first_block], blocks):
            sensor.push(block)
    sensor.begin(offset_s + channel.start_s + source.first_s, source.known_rate_hz)
    return replace(sensor.finish(), words=source.words)


def _common(
    manifest: TripManifest, streams: Sequence[SensorSignal], rate_hz: float
) -> tuple[int, int]:
    common_s = min(s.end_s for s in streams) - max(s.start_s for s in streams)
    if common_s < manifest.shortest_s - 1 / rate_hz:
        times = {"common_s": max(common_s, 0.0), "shortest_s": manifest.shortest_s}
        spans = [
            Finding("stream-between", name=s.name, start_s=s.start_s, end_s=s.end_s)
            for s in streams
        ]
        values = times | {"spans": together(spans, ", ")}
        raise TripError.at(manifest.path, "too-little-in-common", **values)
    first = max(stream.first for stream in streams)
    return first, min(stream.first + len(stream.values) for stream in streams) - 1


WINDOWS = 600  # largest number of windows of an overview, about the width of a figure in pixels


def overview(recording: Recording) -> Overview:
    """Return the overview of a recording in at most ``WINDOWS`` windows."""
    n_windows = min(WINDOWS, recording.signals.shape[1])
    size = recording.signals.shape[1] // n_windows
    windows = recording.signals[:, : n_windows * size].reshape(3, n_windows, size)
    speed = recording.speed_m_per_s[: n_windows * size].reshape(n_windows, size)
    return Overview(
        times_s=np.arange(n_windows) * size / recording.rate_hz,
        low=windows.min(axis=2),
        high=windows.max(axis=2),
        mean=windows.mean(axis=2),
        speed_m_per_s=speed.mean(axis=1),
        faulty=np.any(~recording.usable[: n_windows * size].reshape(n_windows, size), axis=1),
    )
