"""One sensor as its samples come, of a file or of a stream: cleaned, then on the common clock."""

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
    """One sensor on the common clock, for as long as it recorded.

    Attributes
    ----------
    start_s, end_s : float, [s]
        Of the recording; the low-pass takes off a part of it.
    first : int
        Values are of the instants ``(first + arange(n)) / rate_hz``.
    values, touched : arrays of shape (n,), [m/s2]
        `touched` is True where a bad sample takes part.
    words : str
        How its file is read, where that had to be found out.
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
    """Cleans one sensor and puts it on the common clock, block by block.

    Its result depends on the cut into blocks by no more than rounding (1e-12).

    Parameters
    ----------
    where : str
        Named in errors.
    cleaner : Cleaner
        With the sensor's name and its rate; roughly, if only time stamps say it.
    size : float, [m/s2]
        Of the samples' unit; negative where the sensor is upside down.
    rate_hz : float, [Hz]
        Of the common clock.

    Attributes
    ----------
    start_s : float or None, [s]
        Time of the first sample on the trip's clock; None before `begin`.
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
        """Set the time of the first sample [s] and the exact rate [Hz], as soon as they are known.

        Of a stream that is before its first sample, of a file with time stamps after its last.
        Until then samples wait behind the first stage.
        """
        first, factor = self._first_stage.first, self._first_stage.factor
        self._second_stage = Resampler(start_s, input_rate_hz, self.rate_hz, first, factor)
        self._first = self._second_stage.next

    def push(self, values: FloatArray) -> None:
        """Take the next samples, in the sensor's unit."""
        self._take(self._cleaner.push(self.size * values))

    def finish(self, shift_s: float = 0.0) -> SensorSignal:
        """Return the sensor on the common clock; no sample may follow.

        Parameters
        ----------
        shift_s : float, [s]
            Zero of the times of the signal on the sensor's clock, a multiple of the common step.

        Raises
        ------
        TripError
            If no sample is usable.
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
        """Return what `finish` would of the samples so far; more may follow."""
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
        """Return arrays and JSON-able values that `restore` makes the same sensor of."""
        state: dict[str, Any] = {"start_s": self.start_s, "cleaner": self._cleaner.state()}
        if self._second_stage is not None:
            second = self._second_stage
            state |= {
                "tail": self._first_stage.tail,
                "bad_tail": self._first_stage.bad_tail,
                "at": [second.next, second.n_before],
                "held": second.held,
                "held_touched": second.held_touched,
                "values": self._signal.values.copy(),  # the memory of the original moves
                "touched": self._signal.touched.copy(),
            }
        return state

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state of the same sensor of a stream."""
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
