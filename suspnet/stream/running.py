"""A recording that grows while the train runs, and gives what the batch gives on the same samples.

The batch takes steps of two kinds. Those up to the common clock are local, so that a stream takes
them by the same code as its samples come (``sensor.py``): spikes, gaps, saturation and dead sensors
are found in windows that begin at fixed samples, whatever the blocks; both filters are finite; the
instants of the common clock are multiples of ``1 / rate_hz``.

All later steps look at the whole recording: whether clocks drift apart; which speeds are impossible
or stuck; which segments share a speed; which are louder than ``LOUD`` medians, or less coherent
than the others. Signals on the common clock are kept for them: 27 bytes for each instant of three
sensors, 2.7 kB/s at 100 Hz. The spectra of segments would be no smaller (with half overlap, up to
a quarter of the rate, as large), and sums of cross spectra can be made only once the segments are
chosen. So a recording has to end; `longest_s` bounds it, and with it the memory. Its cross spectra
add to those of others where the batch is cut at the same times.

Besides, each sensor holds the samples whose window is not yet complete or waits for its turn (at
most twice ``CORE_SAMPLES`` and two seconds or so, 4.3 MB): recordings of many suspensions begin at
the same instant, and each sensor is cleaned at a time of its own, by its name. Then there are the
frames of `Assembler`. Rates are those of the manifest: the mean rate that the batch takes from a
column of times is known at its end only.
"""

from __future__ import annotations

import zlib
from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np

from suspnet.checks import check_number
from suspnet.recordings.cleaning import CleaningSettings
from suspnet.recordings.clocks import SECOND_NS, Zero
from suspnet.recordings.manifest import (
    ACCELERATION_UNITS,
    SPEED_UNITS,
    Source,
    SpeedSource,
    TripError,
    TripManifest,
)
from suspnet.recordings.recording import HIGHEST_HZ, Recording, joined
from suspnet.recordings.speed import HIGHEST_RATE_HZ, SpeedTrack
from suspnet.recordings.units import size_of
from suspnet.stream.assembler import Assembler, OrderSettings
from suspnet.stream.frames import Frame, FrameError
from suspnet.stream.sensor import RunningSensor
from suspnet.types import FloatArray


class Running:
    """One recording of one suspension as it comes in.

    Parameters
    ----------
    manifest : TripManifest
        Its channels and its speed have `unit` and `rate_hz`; files and times are not looked at.
    zero_ns : int, [ns]
        Zero of the recording's clock, since 1970: a whole second, at most `longest_s` before the
        first sample.
    rate_hz : float, [Hz]
        Of the common clock.
    cleaning : CleaningSettings, optional
    order : OrderSettings, optional
    longest_s : float, [s]
        Frames that begin later after `zero_ns` are refused: then another recording is due.

    Raises
    ------
    TripError
        If the manifest lacks a unit or a rate, or a rate is out of range.
    ValueError
        If a number is out of range.
    """

    def __init__(
        self,
        manifest: TripManifest,
        zero_ns: int,
        rate_hz: float = 100.0,
        cleaning: CleaningSettings | None = None,
        order: OrderSettings | None = None,
        longest_s: float = 3600.0,
    ) -> None:
        check_number("zero_ns", zero_ns, low=0, whole=True)
        check_number("rate_hz", rate_hz, above=0)
        check_number("longest_s", longest_s, above=0, high=86400)
        self.manifest, self.zero_ns, self.rate_hz = manifest, zero_ns, rate_hz
        self.longest_s = longest_s
        self.cleaning = CleaningSettings() if cleaning is None else cleaning
        self.order = OrderSettings() if order is None else order
        self._name = str(manifest.place)
        self._sources: dict[str, Source] = dict(manifest.sensors())
        self._units = dict.fromkeys(self._sources, ("acceleration", ACCELERATION_UNITS))
        if isinstance(manifest.speed, SpeedSource):
            self._sources["speed"] = manifest.speed
            self._units["speed"] = ("speed", SPEED_UNITS)
        for name, source in self._sources.items():
            least = 0.0 if name == "speed" else 0.99 * rate_hz
            most = 2 * HIGHEST_RATE_HZ if name == "speed" else HIGHEST_HZ
            if source.unit is None or source.rate_hz is None or not least < source.rate_hz < most:
                raise TripError(
                    f"{manifest.path}: {name!r} needs `unit` and a `rate_hz` of {least:g} to "
                    f"{most:g} Hz to be read as it comes, got {source.unit} and {source.rate_hz}"
                )
        self._orders = {
            name: Assembler(source.rate_hz or 0.0, self.order)
            for name, source in self._sources.items()
        }
        self._sensors = {
            name: RunningSensor(
                f"{manifest.path}: channel {name!r}",
                name,
                channel,
                rate_hz,
                self.cleaning,
                late=zlib.crc32(f"{self._name}, {name}".encode()) / 2**32,
            )
            for name, channel in manifest.sensors().items()
        }
        self._speeds: list[FloatArray] = []

    @property
    def sensors(self) -> dict[str, Counter[str]]:
        """What was counted of each sensor's frames, as ``Assembler.counts``."""
        return {name: order.counts for name, order in self._orders.items()}

    @property
    def n_frames(self) -> int:
        """Number of frames that were taken or are held back."""
        return sum(order.n_frames for order in self._orders.values())

    @property
    def is_empty(self) -> bool:
        """Whether no acceleration has come."""
        return not any(self._orders[name].n_frames for name in self._sensors)

    @property
    def n_seconds(self) -> float:
        """Length of what has come of each sensor at least, with gaps, [s]; 0 before a first."""
        orders = [self._orders[name] for name in self._sensors]
        return min(order.n_samples / order.rate_hz for order in orders)

    def add(self, frame: Frame) -> None:
        """Take a frame.

        Raises
        ------
        FrameError
            If it is of another suspension or sensor, has another rate or unit, or lies before or
            after the recording. What is already known of it is as before.
        """
        source = self._sources.get(frame.sensor)
        if source is None or frame.suspension != self._name:
            raise FrameError(
                "sensor",
                f"{self._name!r} has {list(self._sources)}, the frame is of "
                f"{frame.sensor!r} of {frame.suspension!r}",
            )
        kind, units = self._units[frame.sensor]
        assert source.unit is not None
        found = size_of(kind, frame.unit)
        if found is None or abs(found / units[source.unit] - 1) > 1e-9:
            raise FrameError(
                "unit", f"{frame.sensor!r} is in {source.unit}, its frame in {frame.unit!r}"
            )
        begins_s = (frame.time_ns - self.zero_ns) / SECOND_NS
        if not 0 <= begins_s <= self.longest_s:
            raise FrameError(
                "time",
                f"a frame of {frame.sensor!r} begins {begins_s:.6g} s after the recording, which "
                f"has at most {self.longest_s:g} s",
            )
        self._give(frame.sensor, self._orders[frame.sensor].push(frame))

    def flush(self) -> None:
        """Take all frames that wait for earlier ones; those are missing then."""
        for name, order in self._orders.items():
            self._give(name, order.flush())

    def recording(self) -> Recording:
        """Return the recording up to the samples so far: what the batch makes of them.

        Frames that wait for earlier ones are left out; `flush` takes them.

        Raises
        ------
        TripError
            As `load_recording` does: a sensor is dead or missing, the time too short, the speed
            unknown, or clocks run apart.
        """
        missing = [name for name, order in self._orders.items() if order.first_ns is None]
        if missing:
            raise TripError(f"{self.manifest.path}: nothing has come from {', '.join(missing)}")
        signals = [sensor.signal() for sensor in self._sensors.values()]
        return joined(self.manifest, signals, self._track(), 0.0, self.rate_hz)

    def _give(self, name: str, blocks: list[FloatArray]) -> None:
        """Give the next samples of a sensor to what keeps them."""
        if name == "speed":
            self._speeds += blocks
            return
        sensor = self._sensors[name]
        if blocks and sensor.start_s is None:
            sensor.begin(self._start_s(name))
        for block in blocks:
            sensor.push(block)

    def _start_s(self, name: str) -> float:
        """Return the time of a sensor's first sample on the recording's clock, [s]."""
        first_ns = self._orders[name].first_ns
        assert first_ns is not None
        return (first_ns - self.zero_ns) / SECOND_NS

    def _track(self) -> SpeedTrack | None:
        """Return the speeds so far as the batch reads them; None if the manifest gives one."""
        source = self.manifest.speed
        if not isinstance(source, SpeedSource):
            return None
        assert source.rate_hz is not None
        assert source.unit is not None
        self._speeds = [np.concatenate(self._speeds)]
        speeds = SPEED_UNITS[source.unit] * self._speeds[0]
        elapsed_s = np.arange(len(speeds)) / source.rate_hz
        step_s = float(np.median(np.diff(elapsed_s))) if len(speeds) > 1 else 1 / source.rate_hz
        return SpeedTrack(self._start_s("speed") + elapsed_s, speeds, Zero(), step_s, "")

    def state(self) -> dict[str, Any]:
        """Return arrays and JSON-able values that `restore` makes the same recording of."""
        self._speeds = [np.concatenate([np.empty(0), *self._speeds])]
        return {
            "speeds": self._speeds[0],
            "orders": {name: order.state() for name, order in self._orders.items()},
            "sensors": {name: sensor.state() for name, sensor in self._sensors.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state of a recording of the same identity."""
        self._speeds = [state["speeds"]]
        for name, order in self._orders.items():
            order.restore(state["orders"][name])
        for name, sensor in self._sensors.items():
            sensor.restore(state["sensors"][name])

    @property
    def identity(self) -> list[Any]:
        """Return what a state must share with the recording that goes on from it."""
        sensors = {
            name: [one.unit, one.rate_hz, getattr(one, "sign", 1), getattr(one, "range", None)]
            for name, one in self._sources.items()
        }
        settings = [self.rate_hz, self.longest_s, asdict(self.cleaning), asdict(self.order)]
        return [self._name, self.zero_ns, sensors, *settings]
