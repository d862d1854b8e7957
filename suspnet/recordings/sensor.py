"""One sensor of a running recording: what a batch does with its file, as the samples come."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from suspnet.ground.types import BoolArray, FloatArray
from suspnet.recordings.cleaning import Cleaner, CleaningSettings
from suspnet.recordings.manifest import ACCELERATION_UNITS, Channel
from suspnet.recordings.recording import SensorSignal, sensor_signal
from suspnet.recordings.resampling import Decimator, Resampler


class RunningSensor:
    """Cleans one sensor and puts it on the common clock, block by block.

    Parameters
    ----------
    where : str
        Named in errors.
    name : str
    channel : Channel
        With `unit` and `rate_hz`.
    rate_hz : float, [Hz]
        Of the common clock.
    cleaning : CleaningSettings, optional
    late : float, [-]
        As of `Cleaner`.

    Attributes
    ----------
    start_s : float or None, [s]
        Time of the first sample on the trip's clock; None before there is one.
    """

    def __init__(
        self,
        where: str,
        name: str,
        channel: Channel,
        rate_hz: float,
        cleaning: CleaningSettings | None = None,
        late: float = 0.0,
    ) -> None:
        assert channel.rate_hz is not None
        assert channel.unit is not None
        self.where, self.channel, self.rate_hz = where, channel, rate_hz
        self._input_rate_hz = channel.rate_hz
        unit = ACCELERATION_UNITS[channel.unit]
        self._size = unit * channel.sign
        full_scale = None if channel.range is None else unit * channel.range
        self._cleaner = Cleaner(name, channel.rate_hz, full_scale, cleaning, late)
        self._first_stage = Decimator(channel.rate_hz, rate_hz)
        self._second_stage: Resampler | None = None
        self._signal = _Growing(np.empty(0), np.empty(0, dtype=np.bool_))

    @property
    def start_s(self) -> float | None:
        """Time of the first sample on the trip's clock, [s]; None before there is one."""
        return None if self._second_stage is None else self._second_stage.start_s

    def begin(self, start_s: float) -> None:
        """Set the time of the first sample."""
        first, factor = self._first_stage.first, self._first_stage.factor
        self._second_stage = Resampler(start_s, self._input_rate_hz, self.rate_hz, first, factor)
        self._first = self._second_stage.next

    def push(self, values: FloatArray) -> None:
        """Take the next samples, in the sensor's unit."""
        for block, bad in self._cleaner.push(self._size * values):
            self._resample(block, bad)

    def signal(self, shift_s: float = 0.0) -> SensorSignal:
        """Return what the batch would make of the samples so far; they may go on.

        Parameters
        ----------
        shift_s : float, [s]
            Zero of the times of the signal on the sensor's clock, a multiple of the common step.

        Raises
        ------
        TripError
            If no sample is usable.
        """
        ended = copy.deepcopy(self)
        for block, bad in ended._cleaner.finish():
            ended._resample(block, bad)
        start_s, signal = self.start_s, ended._signal
        assert start_s is not None
        return sensor_signal(
            self.where,
            ended._cleaner,
            start_s - shift_s,
            self._input_rate_hz,
            self._first - round(shift_s * self.rate_hz),
            signal.values,
            signal.touched,
        )

    def _resample(self, values: FloatArray, bad: BoolArray) -> None:
        """Take a cleaned block through both stages."""
        assert self._second_stage is not None  # the first sample has a time
        self._signal.append(*self._second_stage.push(*self._first_stage.push(values, bad)))

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
                "values": self._signal.values,
                "touched": self._signal.touched,
            }
        return state

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state of the same sensor."""
        self._cleaner.restore(state["cleaner"])
        if state["start_s"] is None:
            return
        self.begin(state["start_s"])
        second = self._second_stage
        assert second is not None
        self._first_stage.tail, self._first_stage.bad_tail = state["tail"], state["bad_tail"]
        second.next, second.n_before = state["at"]
        second.held, second.held_touched = state["held"], state["held_touched"]
        self._signal = _Growing(state["values"], state["touched"])


class _Growing:
    """Values and where they are touched, in blocks until somebody asks for them."""

    def __init__(self, values: FloatArray, touched: BoolArray) -> None:
        self._values, self._touched = [values], [touched]

    def append(self, values: FloatArray, touched: BoolArray) -> None:
        self._values.append(values)
        self._touched.append(touched)

    @property
    def values(self) -> FloatArray:
        self._values = [np.concatenate(self._values)]
        return self._values[0]

    @property
    def touched(self) -> BoolArray:
        self._touched = [np.concatenate(self._touched)]
        return self._touched[0]
