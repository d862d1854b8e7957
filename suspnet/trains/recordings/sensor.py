"""One sensor, from a file or a stream: cleaned, and resampled to the common clock.

Resampling has zero phase and equal gain. The first stage decimates by an integer to at least
``OVERSAMPLING`` times the output rate f; the second interpolates at the instants of the common
clock by a windowed sinc, the same function of time for all input rates. Both are flat up to
``PASS`` f, and attenuate images and aliases that would fall there by ``ATTENUATION_DB``.
"""

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.signal import firwin, kaiser_beta, kaiserord, upfirdn

from suspnet.ground.findings import Finding, together
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.trains.recordings.cleaning import LARGEST_MEAN_M_PER_S2, Cleaner, Fault
from suspnet.trains.recordings.errors import DeadSensorError, TripError


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


class SensorStream:
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
        """Return the signal on the common clock, after the last sample.

        Raises DeadSensorError if no sample is usable, TripError if the mean is impossible.
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
        name, signal = self._cleaner.channel, self._signal
        end_s = start_s + self._cleaner.n_samples / second.input_rate_hz
        first = self._first - round(shift_s * self.rate_hz)
        return SensorSignal(name, start_s, end_s, first, signal.values, signal.touched, faults)

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
    if abs(cleaner.mean) > LARGEST_MEAN_M_PER_S2:
        raise TripError(Finding("odd-mean", where=where, mean=cleaner.mean))
    if cleaner.n_bad < cleaner.n_samples:
        return
    n_constant = sum(fault.n_samples for fault in faults if fault.kind == "constant")
    if n_constant == cleaner.n_samples and cleaner.lowest == cleaner.highest:
        raise DeadSensorError(where, Finding("is-constant", value=cleaner.lowest))
    listed = together(map(str, faults))
    raise DeadSensorError(where, Finding("no-usable-sample", faults=listed))


PASS, STOP = 0.25, 0.75
"""Ends of the pass band and of the transition band, as fractions of the output rate."""
ATTENUATION_DB = 100.0
"""Attenuation of the stop band [dB], which also sets the ripple in the pass band."""
OVERSAMPLING = 4  # least rate after the first stage, as a multiple of the output rate
PHASES = 512
"""Number of points per sample at which the sinc is tabulated, with linear interpolation between."""
BLOCK_ROWS = 2**12
"""Number of output samples that are interpolated at once, which bounds the memory."""


class Growing:
    """A signal and the mask of values affected by bad samples, both (n,), that grow in place.

    Joining a list of blocks would need twice the memory.
    """

    def __init__(self) -> None:
        self.values, self.touched = np.empty(0), np.empty(0, dtype=np.bool_)

    def append(self, values: FloatArray, touched: BoolArray) -> None:
        """Add samples; nothing else may refer to the arrays' memory."""
        array: NDArray[Any]
        for array, block in ((self.values, values), (self.touched, touched)):
            if len(block):
                array.resize(len(array) + len(block), refcheck=False)
                array[-len(block) :] = block


class Decimator:
    """The first stage, block by block, without values that the filter covers incompletely.

    `input_rate_hz` may be approximate; `rate_hz` is the output rate of both stages. Value j lies
    exactly at input sample ``first + j * factor``. `tail` and `bad_tail` are the input samples that
    the next values need.
    """

    def __init__(self, input_rate_hz: float, rate_hz: float) -> None:
        self.factor = max(int(input_rate_hz / (OVERSAMPLING * rate_hz)), 1)
        self._taps = _first_stage(input_rate_hz, rate_hz, self.factor)
        self.first = len(self._taps) // 2
        self.tail, self.bad_tail = np.empty(0), np.empty(0, dtype=np.bool_)

    def push(self, values: FloatArray, bad: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Return the values that the next samples complete, and which a bad sample affects."""
        tail = np.concatenate([self.tail, values])
        bad_tail = np.concatenate([self.bad_tail, bad])
        n_new = max((len(tail) - 2 * self.first - 1) // self.factor + 1, 0)
        skip = 2 * self.first // self.factor  # `first` is a multiple of `factor`
        new, touched = np.empty(0), np.empty(0, dtype=np.bool_)
        if n_new:
            new = upfirdn(self._taps, tail, down=self.factor)[skip : skip + n_new]
            starts = self.factor * np.arange(n_new)
            touched = _touched(bad_tail, starts, len(self._taps))
        used = n_new * self.factor
        self.tail, self.bad_tail = tail[used:].copy(), bad_tail[used:].copy()
        return new, touched


class Resampler:
    """The second stage, block by block: values at the instants of the common clock.

    `start_s` is the time of the first sample on the common clock; it and `input_rate_hz` refer to
    the input of the first stage. `first` and `factor` are those of the `Decimator`. The next value
    is that of the instant ``next / rate_hz``; `n_before` counts pushed values no longer held.
    """

    def __init__(
        self, start_s: float, input_rate_hz: float, rate_hz: float, first: int, factor: int
    ) -> None:
        self.start_s, self.input_rate_hz, self.rate_hz = start_s, input_rate_hz, rate_hz
        self.first, self.factor = first, factor
        self.oversampling = input_rate_hz / factor / rate_hz
        self.half = support(self.oversampling)
        self.next = math.ceil(self._instant(self.half) - 1e-9)
        self.n_before = 0
        self.held, self.held_touched = np.empty(0), np.empty(0, dtype=np.bool_)

    def push(self, values: FloatArray, touched: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Return values at the instants that the next samples complete, and the affected ones."""
        self.held = np.concatenate([self.held, values]) if len(self.held) else values
        self.held_touched = np.concatenate([self.held_touched, touched])
        end = self.n_before + len(self.held) - 1 - self.half
        last = math.floor(self._instant(end) + 1e-9)
        if last < self.next or end < self.half:
            return np.empty(0), np.empty(0, dtype=np.bool_)
        positions = self._positions(np.arange(self.next, last + 1))
        positions -= self.n_before  # exact: a whole number, not larger than the positions
        values, touched = interpolate(self.held, self.held_touched, positions, self.oversampling)
        self.next = last + 1
        (following,) = self._positions(np.array([self.next]))
        # keep what the next instant needs
        spare = max(math.floor(following) - self.half - self.n_before, 0)
        self.held, self.held_touched = self.held[spare:].copy(), self.held_touched[spare:].copy()
        self.n_before += spare
        return values, touched

    def _instant(self, position: int) -> float:
        seconds = self.start_s + (self.first + position * self.factor) / self.input_rate_hz
        return seconds * self.rate_hz

    def _positions(self, instants: IntArray) -> FloatArray:
        """Return the positions of instants of the common clock, [decimated samples]."""
        positions = instants / self.rate_hz
        positions -= self.start_s  # in place, to save memory on long trips
        positions *= self.input_rate_hz
        positions -= self.first
        positions /= self.factor
        return np.asarray(positions)


def support(oversampling: float) -> int:
    """Return how many samples the second stage needs on either side."""
    n_taps, _ = kaiserord(ATTENUATION_DB, 2 * (STOP - PASS) / oversampling)
    return math.ceil(int(n_taps) / 2)


def interpolate(
    values: FloatArray, touched: BoolArray, positions: FloatArray, oversampling: float
) -> tuple[FloatArray, BoolArray]:
    """Return the low-passed signal at positions (n_out,) [samples], and which a bad sample affects.

    `values`, `touched`: (n,), a signal and its bad samples. Positions must be from
    ``support(oversampling)`` to ``n - 1 - support(oversampling)``. `oversampling` >= 1 is the rate
    of the signal divided by the output rate.
    """
    half = support(oversampling)
    table = _sinc_table(half, oversampling)
    near = sliding_window_view(values, 2 * half)
    out, first = np.empty(len(positions)), np.empty(len(positions), dtype=np.intp)
    for start in range(0, len(positions), BLOCK_ROWS):
        part = slice(start, start + BLOCK_ROWS)
        before = np.floor(positions[part])
        phase, weight = np.divmod((positions[part] - before) * PHASES, 1.0)
        first[part] = before.astype(np.intp) - half + 1
        windows, row = near[first[part]], phase.astype(np.intp)
        low = np.einsum("ij,ij->i", windows, table[row])
        high = np.einsum("ij,ij->i", windows, table[row + 1])
        out[part] = low + weight * (high - low)
    return out, _touched(touched, first, 2 * half)


def _first_stage(input_rate_hz: float, rate_hz: float, factor: int) -> FloatArray:
    """Return a symmetric low-pass of odd length whose half length is a multiple of `factor`."""
    if factor == 1:
        return np.ones(1)
    low, high = PASS * rate_hz, input_rate_hz / factor - STOP * rate_hz
    n_taps, beta = kaiserord(ATTENUATION_DB, 2 * (high - low) / input_rate_hz)
    reach = math.ceil(n_taps / 2 / factor) * factor
    taps = firwin(2 * reach + 1, (low + high) / 2, window=("kaiser", beta), fs=input_rate_hz)
    return np.asarray(taps, dtype=np.float64)


@lru_cache(maxsize=64)
def _sinc_table(half: int, oversampling: float) -> FloatArray:
    """Return the weights of 2 `half` samples for each phase, shape (PHASES + 1, 2 half)."""
    cutoff = (PASS + STOP) / (PHASES * oversampling)
    window = ("kaiser", kaiser_beta(ATTENUATION_DB))
    sinc = PHASES * firwin(2 * half * PHASES + 1, cutoff, window=window)
    columns = (1 + np.arange(2 * half)) * PHASES
    table = np.asarray(sinc[columns - np.arange(PHASES + 1)[:, None]])
    table.flags.writeable = False  # the cache shares it
    return table


def _touched(bad: BoolArray, first: IntArray, length: int) -> BoolArray:
    if not bad.any():
        return np.zeros(len(first), dtype=np.bool_)
    count = np.zeros(len(bad) + 1, dtype=np.int32)
    np.cumsum(bad, out=count[1:])
    return np.asarray(count[first + length] > count[first])
