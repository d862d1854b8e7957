"""Resampling of signals of any rate to one common clock, with zero phase and equal gain.

The first stage decimates the streaming signal by an integer to at least ``OVERSAMPLING`` times the
output rate. The second interpolates at the instants of the common clock by a windowed sinc, the
same function of time for all input rates. With f the output rate, both stages are flat up to
``PASS`` f, and attenuate images and aliases that would fall there by ``ATTENUATION_DB``.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.signal import firwin, kaiser_beta, kaiserord, upfirdn

from suspnet.ground.types import BoolArray, FloatArray, IntArray

PASS, STOP = 0.25, 0.75
"""Ends of the pass band and of the transition band, as fractions of the output rate."""

ATTENUATION_DB = 100.0
"""Attenuation of the stop band [dB], which also sets the ripple in the pass band."""

OVERSAMPLING = 4
"""Least rate after the first stage, as a multiple of the output rate."""

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
        found = interpolate(self.held, self.held_touched, positions, self.oversampling)
        self.next = last + 1
        (following,) = self._positions(np.array([self.next]))
        spare = max(math.floor(following) - self.half - self.n_before, 0)
        self.held, self.held_touched = self.held[spare:].copy(), self.held_touched[spare:].copy()
        self.n_before += spare
        return found

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
    """Return which windows of `length` samples from `first` contain a bad sample."""
    if not bad.any():
        return np.zeros(len(first), dtype=np.bool_)
    count = np.zeros(len(bad) + 1, dtype=np.int32)
    np.cumsum(bad, out=count[1:])
    return np.asarray(count[first + length] > count[first])
