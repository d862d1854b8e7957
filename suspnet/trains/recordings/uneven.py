"""Uneven times: samples interpolated onto an even grid at their mean rate.

A value at time t is that of the polynomial through the ``POINTS`` samples around it. For a sine of
angular frequency w and steps of at most h, its error in the middle of them is at most
``(w h)^8 (1 3 5 7)^2 / (2^8 8!)`` = 0.00107 (w h)^8 of the amplitude, the remainder of Lagrange's
formula. The error for the times of a file is summed up exactly, from the weights of its samples.
"""

import math

import numpy as np

from suspnet.ground.findings import Finding
from suspnet.ground.types import FloatArray, IntArray
from suspnet.trains.recordings.cleaning import find_gaps
from suspnet.trains.recordings.errors import TripError

POINTS = 8  # number of samples from which a value is interpolated
LEAST_STEPS = 4 * POINTS  # least number of steps by which times are judged
MOST_ERROR = 0.01
"""Largest error of a sine at the end of the band by its times or by interpolation, relative."""
ROUNDED = 1.25
"""Resolutions by which rounded times may stray in all: one, and the error of a line's fit."""
THIN, MOST_POINTS = 64, 2**16
"""Of how many earlier samples a line keeps one, and the number from which it keeps every second."""
DEVIATIONS, LEAST_GAP = 5.0, 0.5
"""A step is a gap if it exceeds the usual one by this many robust standard deviations of the steps,
and by at least this fraction of the usual step."""
SHORT_GAP = 4.5
"""Multiple of the usual step up to which the samples on both sides of a gap are used together."""
BLOCK_ROWS = 2**14  # number of values interpolated at once, which bounds the memory


class Line:
    """Line through the times of a stream of samples against their numbers, block by block."""

    def __init__(self) -> None:
        self._n, self._resolution_s = 0, 0.0
        self._numbers, self._times = np.empty(0), np.empty(0)
        self._fit = np.polynomial.Polynomial([np.nan, np.nan])

    def at(self, number: float) -> float:
        """Return the time of a sample by the blocks on the line so far."""
        return float(self._fit(number))

    def holds(
        self, numbers: IntArray, times: FloatArray, steps_s: FloatArray, band_hz: float
    ) -> bool:
        """Return whether the times of the next block and all before it lie on one line.

        They may stray by their rounding and by what matters little up to `band_hz`. `steps_s` are
        the steps of the block without gaps.
        """
        error_s = MOST_ERROR / (2 * math.pi * band_hz)
        self._resolution_s = max(self._resolution_s, _resolution(steps_s, error_s / 10))
        self._n += len(times)
        all_numbers = np.concatenate([self._numbers, numbers])
        all_times = np.concatenate([self._times, times])
        if self._n > 1:
            fit = np.polynomial.Polynomial.fit(all_numbers, all_times, 1)
            strays_s = float(np.ptp(all_times - fit(all_numbers)))
            most_s = ROUNDED * self._resolution_s + 2 * error_s
            if self._n > LEAST_STEPS and strays_s > most_s:
                return False
            self._fit = fit
        self._numbers = np.concatenate([self._numbers, numbers[::THIN]])
        self._times = np.concatenate([self._times, times[::THIN]])
        if len(self._times) > MOST_POINTS:
            self._numbers, self._times = self._numbers[::2], self._times[::2]
        return True


def _resolution(steps_s: FloatArray, least_s: float) -> float:
    """Return to what multiples times were rounded by their steps, 0 if below `least_s` or not."""
    ordered = np.sort(steps_s)
    apart = np.diff(ordered)
    apart = apart[apart > least_s]
    if len(apart) == 0:
        return 0.0
    multiples = (ordered - ordered[0]) / apart.min()
    if np.abs(multiples - np.round(multiples)).max() > 0.05:
        return 0.0
    # numbers have so many decimals or bits; single precision has fewer at late times
    for step in (float(ordered[-1] - ordered[0]), float(apart.min())):
        if any(abs(power - round(power)) < 1e-3 for power in (math.log10(step), math.log2(step))):
            return step
    return 0.0


class Grid:
    """Interpolates a stream of samples at uneven times onto an even grid, block by block.

    The result does not depend on how the stream is cut into blocks. `first_s` is the first instant
    of the grid; `steps_s` are steps whose mean without gaps gives `rate_hz` unless `step_s` does.
    Where a sample is missing, the result is NaN: within steps above `gap_s`. `words` states what
    was done.
    """

    def __init__(
        self,
        where: str,
        first_s: float,
        steps_s: FloatArray,
        band_hz: float,
        step_s: float | None = None,
    ) -> None:
        self.where, self.band_hz = where, band_hz
        usual_s = float(np.median(steps_s))
        deviation_s = 1.4826 * float(np.median(np.abs(steps_s - usual_s)))
        self.gap_s = usual_s + max(DEVIATIONS * deviation_s, LEAST_GAP * usual_s)
        even = steps_s[steps_s <= self.gap_s]
        self.step_s = float(even.mean()) if step_s is None else step_s
        self.rate_hz = 1 / self.step_s
        low, high = 1e3 * np.quantile(even, [0.01, 0.99])
        self._uneven = Finding("times-uneven", low=low, high=high)
        self.words = Finding("interpolated", uneven=self._uneven, rate_hz=self.rate_hz)
        self._first_s, self._n_done = first_s, 0
        self._times, self._values = np.empty(0), np.empty(0)
        self._n_summed, self._sum_of_squares = 0, 0.0

    def push(self, times: FloatArray, values: FloatArray) -> FloatArray:
        """Return the values that the next samples complete."""
        good = ~find_gaps(values)
        self._times = np.concatenate([self._times, times[good]])
        self._values = np.concatenate([self._values, values[good]])
        return self._until(POINTS // 2)

    def finish(self) -> FloatArray:
        """Return the remaining values.

        Raises TripError if interpolation is too inaccurate.
        """
        return self._until(1)

    def _until(self, n_after: int) -> FloatArray:
        """Return the values up to the sample that `n_after` - 1 others follow."""
        if len(self._times) < 2 * POINTS:
            return np.empty(0)
        n = math.floor((self._times[-n_after] - self._first_s) / self.step_s + 1e-6) + 1
        instants = self._first_s + self.step_s * np.arange(self._n_done, n)
        blocks = [
            self._at(instants[start : start + BLOCK_ROWS])
            for start in range(0, len(instants), BLOCK_ROWS)
        ]
        self._n_done = max(n, self._n_done)
        # the next values need the last samples, and those before a gap among them
        self._times, self._values = self._times[-3 * POINTS :], self._values[-3 * POINTS :]
        self._check()
        return np.concatenate([np.empty(0), *blocks])

    def _at(self, instants: FloatArray) -> FloatArray:
        times, half = self._times, POINTS // 2
        after = np.clip(np.searchsorted(times, instants), 1, len(times) - 1)
        # the samples around each instant, on one side of a long gap
        borders = np.flatnonzero(np.diff(times) > SHORT_GAP * self.step_s) + 1
        starts, stops = np.append(0, borders), np.append(borders, len(times))
        is_later = instants - times[after - 1] > times[after] - instants
        part = np.searchsorted(borders, after - 1 + is_later, side="right")
        first = np.clip(after - half, starts[part], np.maximum(stops[part] - POINTS, starts[part]))
        around = first[:, None] + np.arange(POINTS)
        is_known = around[:, -1] < stops[part]
        around = np.minimum(around, len(times) - 1)
        to_samples = times[around] - instants[:, None]
        nearest = np.abs(to_samples).min(axis=1)
        is_known &= (times[after] - times[after - 1] <= self.gap_s) | (nearest < self.step_s / 2)
        weights = _weights(to_samples[is_known])
        # sums of differences, so that equal samples stay equal
        values = self._values[around[is_known]]
        level = values[:, half - 1]
        result = np.full(len(instants), np.nan)
        result[is_known] = level + np.einsum("ij,ij->i", weights, values - level[:, None])
        # the error of a sine at the end of the band, by the same weights
        turned = np.exp(2j * math.pi * self.band_hz * to_samples[is_known])
        errors = np.abs(np.einsum("ij,ij->i", weights, turned) - 1)
        self._sum_of_squares += float(np.square(errors).sum())
        self._n_summed += len(errors)
        return result

    def _check(self) -> None:
        error = math.sqrt(self._sum_of_squares / max(self._n_summed, 1))
        if error > MOST_ERROR:
            errors = {"error": 100 * error, "most_error": 100 * MOST_ERROR}
            values = {"uneven": self._uneven, "band_hz": self.band_hz} | errors
            raise TripError.at(self.where, "too-uneven", **values)


def _weights(offsets: FloatArray) -> FloatArray:
    """Return the weights of samples at `offsets` (n, POINTS) from an instant, by Lagrange."""
    weights = np.empty_like(offsets)
    for i in range(POINTS):
        others = np.delete(offsets, i, axis=1)
        weights[:, i] = np.prod(others / (others - offsets[:, [i]]), axis=1)
    return weights
