"""One sensor, from a file or a stream: cleaned, and resampled to the common clock."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from suspnet.ground.types import BoolArray, FloatArray
from suspnet.recordings.cleaning import Cleaner, Fault
from suspnet.recordings.manifest_keys import TripError
from suspnet.recordings.resampling import Decimator, Growing, Resampler


@dataclass(frozen=True)
class SensorSignal:
    """The signal of one sensor on the common clock.

    `start_s` and `end_s` are of the raw recording, which the low-pass shortens. `values`: (n,),
    [m/s2], at the instants ``(first + arange(n)) / rate_hz``. `touched`: (n,), True where a bad
    sample affects the value. `words` states how the file is read, if this was detected.
    """

    name: str
    start_s: float
    end_s: float
    first: int
    values: FloatArray
    touched: BoolArray
    faults: tuple[Fault, ...]
    words: str = ""


class Sensor:
    """Cleans one sensor and resamples it to the common clock, block by block.

    The result does not depend on how the signal is cut into blocks, up to rounding (1e-12). The
    rate of `cleaner` may be approximate. `size` is the unit of the samples [m/s2], negative if the
    sensor is upside down. `rate_hz` is the rate of the common clock.
    """

    def __init__(self, where: str, cleaner: Cleaner, size: float, rate_hz: float) -> None:
        self.where, self.size, self.rate_hz = where, size, rate_hz
        self._cleaner = cleaner
        self._first_stage = Decimator(cleaner.rate_hz, rate_hz)
        self._second_stage: Resampler | None = None
        self._decimated, self._signal = Growing(), Growing()

    @property
    def start_s(self) -> float | None:
        """Time of the first sample on the trip's clock, [s]; None before `begin`."""
        return None if self._second_stage is None else self._second_stage.start_s

    def begin(self, start_s: float, input_rate_hz: float) -> None:
        """Set the time of the first sample [s] and the exact rate [Hz].

        They are known before the first sample of a stream, but after the last one of a file with
        time stamps. Until then samples wait after the first stage.
        """
        first, factor = self._first_stage.first, self._first_stage.factor
        self._second_stage = Resampler(start_s, input_rate_hz, self.rate_hz, first, factor)
        self._first = self._second_stage.next

    def push(self, values: FloatArray) -> None:
        """Process the next samples, in the sensor's unit."""
        self._take(self._cleaner.push(self.size * values))

    def finish(self, shift_s: float = 0.0) -> SensorSignal:
        """Return the signal on the common clock, after the last sample; TripError if unusable.

        `shift_s` is the zero of the result's times on the sensor's clock, a multiple of the common
        step.
        """
        self._take(self._cleaner.finish())
        self._resample()
        second = self._second_stage
        assert second is not None
        start_s = second.start_s - shift_s
        faults = self._cleaner.faults(start_s)
        _check_alive(self.where, self._cleaner, faults)
        return SensorSignal(
            self._cleaner.channel,
            start_s,
            start_s + self._cleaner.n_samples / second.input_rate_hz,
            self._first - round(shift_s * self.rate_hz),
            self._signal.values,
            self._signal.touched,
            faults,
        )

    def signal(self, shift_s: float = 0.0) -> SensorSignal:
        """Return the result of `finish` for the samples so far; more may follow."""
        return copy.deepcopy(self).finish(shift_s)

    def _take(self, cleaned: Iterable[tuple[FloatArray, BoolArray]]) -> None:
        for values, bad in cleaned:
            self._decimated.append(*self._first_stage.push(values, bad))
            if self._second_stage is not None:
                self._resample()

    def _resample(self) -> None:
        assert self._second_stage is not None
        waiting, self._decimated = self._decimated, Growing()
        self._signal.append(*self._second_stage.push(waiting.values, waiting.touched))

    def state(self) -> dict[str, Any]:
        """Return arrays and JSON-able values from which `restore` continues."""
        state: dict[str, Any] = {"start_s": self.start_s, "cleaner": self._cleaner.state()}
        if self._second_stage is not None:
            second = self._second_stage
            state |= {
                "tail": self._first_stage.tail,
                "bad_tail": self._first_stage.bad_tail,
                "at": [second.next, second.n_before],
                "held": second.held,
                "held_touched": second.held_touched,
                "values": self._signal.values.copy(),  # the original is resized in place
                "touched": self._signal.touched.copy(),
            }
        return state

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the state of the same sensor of a stream."""
        self._cleaner.restore(state["cleaner"])
        if state["start_s"] is None:
            return
        self.begin(state["start_s"], self._cleaner.rate_hz)
        second = self._second_stage
        assert second is not None
        self._first_stage.tail, self._first_stage.bad_tail = state["tail"], state["bad_tail"]
        second.next, second.n_before = state["at"]
        second.held, second.held_touched = state["held"], state["held_touched"]
        self._signal.append(state["values"], state["touched"])


def _check_alive(where: str, cleaner: Cleaner, faults: tuple[Fault, ...]) -> None:
    """Raise TripError if a sensor has no usable sample."""
    if cleaner.n_bad < cleaner.n_samples:
        return
    n_constant = sum(fault.n_samples for fault in faults if fault.kind == "constant")
    if n_constant == cleaner.n_samples and cleaner.lowest == cleaner.highest:
        value = f"{cleaner.lowest:g}"
        raise TripError(f"{where} is constant ({value}) throughout: is the sensor connected?")
    raise TripError(f"{where} has no usable sample: {'; '.join(map(str, faults))}")
