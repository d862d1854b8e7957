"""A recording that grows while the train runs; its result equals the batch's on the same samples.

The steps up to the common clock are local, so a stream runs the code of the batch as its samples
arrive (`sensor`). All later steps need the whole recording: signals on the common clock are stored
for them, 27 bytes per instant of three sensors; `longest_s` bounds the recording and its memory.

Where the manifest leaves rate or unit to the file, they are those of the sensor's first frame.
"""

from collections import Counter
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.assembler import Assembler, OrderSettings, check_frame_rate
from suspnet.trains.recordings.cleaning import Cleaner
from suspnet.trains.recordings.columns import size_of
from suspnet.trains.recordings.dates import SECOND_NS
from suspnet.trains.recordings.dead_sensors import living
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.frames import Frame, FrameError, end_ns
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_sources import UNITS, SpeedSource
from suspnet.trains.recordings.recording import HIGHEST_HZ, Recording, joined
from suspnet.trains.recordings.sensor import SensorStream
from suspnet.trains.recordings.sources import TIMES_TOLERANCE
from suspnet.trains.recordings.speed import HIGHEST_RATE_HZ, SpeedTrack, speed_track


class Running:
    """The recording of one suspension, extended frame by frame.

    The manifest's files and times are not used. `zero_ns` is a whole second, to which `longest_s`
    and `before_s` refer: frames that start later than this, or earlier than this before it, are
    refused; they need a new recording. `rate_hz` is that of the common clock.

    `begin_ns` and `end_ns` are the start of the earliest and the end of the latest frame, `goes_on`
    whether it continues the trip of another recording. Raises TripError if a rate is out of range,
    or the unit of a sensor's `range` is missing, and ValueError if a number is out of range.
    """

    def __init__(
        self,
        manifest: TripManifest,
        zero_ns: int,
        rate_hz: float = 100.0,
        order: OrderSettings | None = None,
        longest_s: float = 3600.0,
        before_s: float = 0.0,
    ) -> None:
        check_number("zero_ns", zero_ns, low=0, whole=True)
        check_number("rate_hz", rate_hz, above=0)
        check_number("longest_s", longest_s, above=0, high=2 * 86400)
        check_number("before_s", before_s, low=0, high=86400)
        self.manifest, self.zero_ns, self.rate_hz = manifest, zero_ns, float(rate_hz)
        self.longest_s, self.before_s = longest_s, before_s
        self.begin_ns, self.end_ns = zero_ns + round(longest_s * SECOND_NS), 0
        self.goes_on = False
        self.order = OrderSettings() if order is None else order
        self._name = str(manifest.place)
        self._sources = manifest.sources()
        for name, source in self._sources.items():
            if source.rate_hz is not None and (words := self._rate_problem(name, source.rate_hz)):
                raise TripError(f"{manifest.path}: {words}")
            if source.unit is None and getattr(source, "range", None) is not None:
                words = "write its `unit` to have it read as it comes"
                raise TripError(f"{manifest.path}: {name!r} has a `range`; {words}")
        self._orders: dict[str, Assembler] = {}
        self._sensors: dict[str, SensorStream] = {}
        self._speeds: list[FloatArray] = []

    @property
    def sensors(self) -> dict[str, Counter[str]]:
        """``Assembler.counts`` of each sensor."""
        return {name: order.counts for name, order in self._orders.items()}

    @property
    def n_frames(self) -> int:
        """Number of frames that were accepted or are held back."""
        return sum(order.n_frames for order in self._orders.values())

    @property
    def is_empty(self) -> bool:
        """Whether no acceleration has been received."""
        return not any(self._orders[name].n_frames for name in self._sensors)

    def add(self, frame: Frame) -> None:
        """Add a frame.

        Raises FrameError if its suspension, sensor, rate or unit is another one, or it lies before
        or after the recording, which then remains unchanged.
        """
        source = self._sources.get(frame.sensor)
        if source is None or frame.suspension != self._name:
            words = f"the frame is of {frame.sensor!r} of {frame.suspension!r}"
            raise FrameError("sensor", f"{self._name!r} has {list(self._sources)}, {words}")
        # samples are in the manifest's unit, or else in the SI unit
        size, unit = size_of(source.kind, frame.unit), source.unit
        if size is None or (unit is not None and abs(size / source.si_size - 1) > 1e-9):
            wanted = unit or f"a unit of {source.kind} like {' or '.join(UNITS[source.kind])}"
            words = f"{frame.sensor!r} is in {wanted}, its frame in {frame.unit!r}"
            raise FrameError("unit", words)
        if unit is None and size != 1.0:
            frame = replace(frame, samples=size * frame.samples.astype(np.float64))
        begins_s = (frame.time_ns - self.zero_ns) / SECOND_NS
        if not -self.before_s <= begins_s <= self.longest_s:
            words = f"after the recording, which has at most {self.longest_s:g} s"
            raise FrameError("time", f"a frame of {frame.sensor!r} begins {begins_s:.6g} s {words}")
        blocks = self._order(frame).push(frame)
        self.begin_ns = min(self.begin_ns, frame.time_ns)
        self.end_ns = max(self.end_ns, end_ns(frame))
        self._give(frame.sensor, blocks)

    def _order(self, frame: Frame) -> Assembler:
        name, source = frame.sensor, self._sources[frame.sensor]
        if name not in self._orders:
            rate_hz = source.rate_hz
            if rate_hz is None or source.time is not None:
                if rate_hz is not None:
                    check_frame_rate(frame, rate_hz, TIMES_TOLERANCE)
                if words := self._rate_problem(name, frame.rate_hz):
                    raise FrameError("rate", words)
                rate_hz = frame.rate_hz
            check_frame_rate(frame, rate_hz)
            self._begin(name, rate_hz)
        return self._orders[name]

    def _begin(self, name: str, rate_hz: float) -> None:
        self._orders[name] = Assembler(rate_hz, self.order)
        channel = self.manifest.sensors().get(name)
        if channel is not None:
            unit = channel.si_size
            full_scale = None if channel.range is None else unit * channel.range
            where, cleaner = self.manifest.where(name), Cleaner(name, rate_hz, full_scale)
            self._sensors[name] = SensorStream(where, cleaner, unit * channel.sign, self.rate_hz)

    def _rate_problem(self, name: str, rate_hz: float) -> str:
        """Return why a sensor cannot have this rate; empty if it can."""
        least = 0.0 if name == "speed" else 0.99 * self.rate_hz
        most = 2 * HIGHEST_RATE_HZ if name == "speed" else HIGHEST_HZ
        if least < rate_hz < most:
            return ""
        wanted = f"needs a rate of {least:g} to {most:g} Hz to be read as it comes"
        return f"{name!r} {wanted}, got {rate_hz:g} Hz"

    def flush(self) -> None:
        """Add all frames that wait for earlier ones, which then count as missing."""
        for name, order in self._orders.items():
            self._give(name, order.flush())

    def recording(self) -> Recording:
        """Return the recording of the samples so far, as the batch would.

        Its clock starts at the whole second of `begin_ns`. Frames that wait for earlier ones are
        left out unless `flush` is called first. Raises TripError as `load_recording` does.
        """
        started = [name for name, order in self._orders.items() if order.first_ns is not None]
        missing = [name for name in self._sources if name not in started]
        if missing:
            raise TripError(f"{self.manifest.path}: nothing has come from {', '.join(missing)}")
        readers = {
            name: partial(
                self._sensors[name].signal, (self._clock_ns - self._zero_ns(name)) / SECOND_NS
            )
            for name in self.manifest.sensors()
        }
        signals, dead = living(self.manifest, readers)
        return joined(self.manifest, signals, self._track(), 0.0, self.rate_hz, dead)

    @property
    def _clock_ns(self) -> int:
        return self._whole_second(self.begin_ns)

    def _zero_ns(self, name: str) -> int:
        """Return the zero of a sensor's clock, since 1970, [ns].

        It is the whole second of the sensor's own first sample, so that the result does not depend
        on the order of frames.
        """
        return self._whole_second(self._first_ns(name))

    def _whole_second(self, time_ns: int) -> int:
        """Round a time down to a common instant: a second if the rate is a whole number, [ns]."""
        if self.rate_hz.is_integer():
            return time_ns // SECOND_NS * SECOND_NS
        return self.zero_ns

    def _first_ns(self, name: str) -> int:
        first_ns = self._orders[name].first_ns
        assert first_ns is not None  # the sensor has sent samples
        return first_ns

    def _give(self, name: str, blocks: list[FloatArray]) -> None:
        if name == "speed":
            self._speeds += blocks
            return
        sensor = self._sensors[name]
        if blocks and sensor.start_s is None:
            start_s = (self._first_ns(name) - self._zero_ns(name)) / SECOND_NS
            sensor.begin(start_s, self._orders[name].rate_hz)
        for block in blocks:
            sensor.push(block)

    def _track(self) -> SpeedTrack | None:
        source = self.manifest.speed
        if not isinstance(source, SpeedSource):
            return None
        rate_hz = self._orders["speed"].rate_hz
        self._speeds = [np.concatenate(self._speeds)]
        speeds = source.si_size * self._speeds[0]
        start_s = (self._first_ns("speed") - self._clock_ns) / SECOND_NS
        return speed_track(np.arange(len(speeds)) / rate_hz, speeds, start_s, rate_hz)

    def state(self) -> dict[str, Any]:
        """Return arrays and JSON-able values from which `restore` continues."""
        self._speeds = [np.concatenate([np.empty(0), *self._speeds])]
        return {
            "speeds": self._speeds[0],
            "times": [self.begin_ns, self.end_ns, self.goes_on],
            "rates": {name: order.rate_hz for name, order in self._orders.items()},
            "orders": {name: order.state() for name, order in self._orders.items()},
            "sensors": {name: sensor.state() for name, sensor in self._sensors.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the state of a recording of the same `identity`."""
        self._speeds = [state["speeds"]]
        self.begin_ns, self.end_ns, self.goes_on = state["times"]
        for name, rate_hz in state["rates"].items():
            self._begin(name, rate_hz)
            self._orders[name].restore(state["orders"][name])
        for name, sensor in self._sensors.items():
            sensor.restore(state["sensors"][name])

    @property
    def identity(self) -> list[Any]:
        """Values that a state must share with the recording that continues it."""
        sensors = {
            name: [s.unit, s.rate_hz, getattr(s, "sign", 1), getattr(s, "range", None)]
            for name, s in self._sources.items()
        }
        settings = [self.rate_hz, self.longest_s, self.before_s, asdict(self.order)]
        return [self._name, self.zero_ns, sensors, *settings]
