"""Signals of any rate on one common clock, without delay and with the same magnitude for all.

Two stages. An integer decimation brings the signal, as it streams by, to at least ``OVERSAMPLING``
times the wanted rate. A windowed sinc, the same function of time whatever the rates, then gives
the value at each instant of the common clock. With f the wanted rate, both are flat up to
``PASS`` f, and ``ATTENUATION_DB`` down wherever their images or aliases would fall there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.signal import firwin, kaiser_beta, kaiserord, upfirdn

from suspnet.types import BoolArray, FloatArray, IntArray

PASS, STOP = 0.25, 0.75
"""Ends of the pass band and of the transition band, as fractions of the wanted rate."""

ATTENUATION_DB = 100.0
"""Attenuation of the stop band [dB], which also sets the ripple in the pass band."""

OVERSAMPLING = 4
"""Least rate after the first stage, as a multiple of the wanted rate."""

PHASES = 512
"""Number of points between samples at which the sinc is tabulated, linear in between."""

BLOCK_ROWS = 2**12


@dataclass(frozen=True)
class Decimated:
    """A signal after the first stage.

    Attributes
    ----------
    values : array of shape (n,), [as the input]
    touched : array of shape (n,)
        True where a bad sample took part.
    first, factor : int
        Sample j lies exactly at input sample ``first + j * factor``.
    """

    values: FloatArray
    touched: BoolArray
    first: int
    factor: int


def decimate(
    blocks: Iterable[tuple[FloatArray, BoolArray]], input_rate_hz: float, rate_hz: float
) -> Decimated:
    """Return a stream of (values, bad) low-passed and decimated by the first stage.

    Only samples that the filter covers completely are returned, so the ends are missing.

    Parameters
    ----------
    blocks : iterable of pairs of arrays of shape (n_samples,)
    input_rate_hz : float, [Hz]
        Of the stream; roughly is enough.
    rate_hz : float, [Hz]
        The rate wanted after both stages.
    """
    factor = max(int(input_rate_hz / (OVERSAMPLING * rate_hz)), 1)
    taps = _first_stage(input_rate_hz, rate_hz, factor)
    reach = len(taps) // 2
    tail, bad_tail = np.empty(0), np.empty(0, dtype=np.bool_)
    values, touched = np.empty(0), np.empty(0, dtype=np.bool_)
    for block, bad in blocks:
        tail, bad_tail = np.concatenate([tail, block]), np.concatenate([bad_tail, bad])
        n_new = (len(tail) - 2 * reach - 1) // factor + 1
        if n_new <= 0:
            continue
        skip = 2 * reach // factor  # `reach` is a multiple of `factor`
        _append(values, upfirdn(taps, tail, down=factor)[skip : skip + n_new])
        _append(touched, _touched(bad_tail, factor * np.arange(n_new), len(taps)))
        tail, bad_tail = tail[n_new * factor :], bad_tail[n_new * factor :]
    return Decimated(values, touched, reach, factor)


def _append(array: NDArray[Any], block: NDArray[Any]) -> None:
    """Add a block to the end of an array in place: a list would need twice the memory in the end.

    Nothing else may refer to the array's memory.
    """
    array.resize(len(array) + len(block), refcheck=False)
    array[-len(block) :] = block


def support(oversampling: float) -> int:
    """Return how many samples on either side the second stage needs."""
    n_taps, _ = kaiserord(ATTENUATION_DB, 2 * (STOP - PASS) / oversampling)
    return math.ceil(int(n_taps) / 2)


def interpolate(
    values: FloatArray, touched: BoolArray, positions: FloatArray, oversampling: float
) -> tuple[FloatArray, BoolArray]:
    """Return the low-passed signal at any positions, and where a bad sample took part.

    Parameters
    ----------
    values, touched : arrays of shape (n,)
        A signal, and its bad samples.
    positions : array of shape (n_out,), [samples]
        From ``support(oversampling)`` to ``n - 1 - support(oversampling)``.
    oversampling : float
        Rate of the signal over the rate wanted; at least 1.

    Returns
    -------
    values, touched : arrays of shape (n_out,)
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
    """Return an odd, symmetric low-pass whose half length is a multiple of `factor`."""
    if factor == 1:
        return np.ones(1)
    low, high = PASS * rate_hz, input_rate_hz / factor - STOP * rate_hz
    n_taps, beta = kaiserord(ATTENUATION_DB, 2 * (high - low) / input_rate_hz)
    reach = math.ceil(n_taps / 2 / factor) * factor
    taps = firwin(2 * reach + 1, (low + high) / 2, window=("kaiser", beta), fs=input_rate_hz)
    return np.asarray(taps, dtype=np.float64)


def _sinc_table(half: int, oversampling: float) -> FloatArray:
    """Return the weights of 2 `half` samples for each phase, shape (PHASES + 1, 2 half)."""
    cutoff = (PASS + STOP) / (PHASES * oversampling)
    window = ("kaiser", kaiser_beta(ATTENUATION_DB))
    sinc = PHASES * firwin(2 * half * PHASES + 1, cutoff, window=window)
    columns = (1 + np.arange(2 * half)) * PHASES
    return np.asarray(sinc[columns - np.arange(PHASES + 1)[:, None]])


def _touched(bad: BoolArray, first: IntArray, length: int) -> BoolArray:
    """Return which of the windows of `length` samples from `first` hold a bad one."""
    if not bad.any():
        return np.zeros(len(first), dtype=np.bool_)
    count = np.zeros(len(bad) + 1, dtype=np.int32)
    np.cumsum(bad, out=count[1:])
    return np.asarray(count[first + length] > count[first])
