"""Vectorised detectors of faulty acceleration samples, one function for each kind.

All take one piece of a signal; ``cleaning`` cuts a channel into pieces and joins the results.
Masks have shape (n_samples,).
"""

from __future__ import annotations

import math

import numpy as np

from suspnet.ground.types import BoolArray, FloatArray, IntArray

LARGEST_M_PER_S2 = 1e30
"""Magnitude above which a value is missing: loggers write 3.4e38 or infinity for that."""
STRIDE = 7
"""Stride of the samples from which level and spread are estimated."""
SIDE_SAMPLES, CALM = 8, 0.25
"""A spike is isolated if all but one of SIDE_SAMPLES samples on either side stay within the
fraction CALM of its height; the ringing after an impact exceeds that."""
COARSE_STEPS = 4
"""Number of quantisation steps by which a signal must jump to its clipping level: the rounded top
of a slow wave is as flat, but is reached in smaller steps. A spike must also be higher than this,
as the last digit of a sensor at rest flickers."""


def find_gaps(values: FloatArray) -> BoolArray:
    """Return where a value is missing: NaN, or above ``LARGEST_M_PER_S2``."""
    return np.asarray(~(np.abs(values) < LARGEST_M_PER_S2))


def find_constant(values: FloatArray, longest: int) -> BoolArray:
    """Return the runs of more than `longest` identical values; NaN is not identical to NaN."""
    coarse = values[:: max((longest + 1) // 2, 1)]  # every run that is too long holds two of these
    if not (coarse[1:] == coarse[:-1]).any():
        return np.zeros(len(values), dtype=np.bool_)
    starts, stops = runs(values[1:] == values[:-1], at_least=longest)
    return paint(len(values), starts, stops + 1)


def find_saturation(values: FloatArray, threshold: float) -> BoolArray:
    """Return where the magnitude reaches a threshold."""
    if -threshold < values.min() and values.max() < threshold:
        return np.zeros(len(values), dtype=np.bool_)
    return np.asarray(np.abs(values) >= threshold)


def find_clipping(values: FloatArray, shortest: int) -> BoolArray:
    """Return runs of at least `shortest` equal values at the extremes of `values`.

    It serves sensors of unknown range. A run counts only if the signal jumps to or from it.
    """
    mask = np.zeros(len(values), dtype=np.bool_)
    for extreme in (values.min(), values.max()):
        at = values == extreme
        if np.count_nonzero(at) < shortest:
            continue
        starts, stops = runs(at, at_least=shortest)
        before = np.abs(values[np.maximum(starts - 1, 0)] - extreme)
        after = np.abs(values[np.minimum(stops, len(values) - 1)] - extreme)
        sharp = np.maximum(before, after) > COARSE_STEPS * _smallest_step(values)
        mask |= paint(len(values), starts[sharp], stops[sharp])
    return mask


def local_level(values: FloatArray, segment: int) -> tuple[FloatArray, FloatArray]:
    """Return median and robust standard deviation of each segment, shape (n_segments,), [m/s2].

    The deviation is 1.4826 times the median absolute deviation or, if that is zero, 1.2533 times
    the mean absolute deviation. A shorter last segment takes the values of the one before it.
    """
    n_whole = len(values) // segment
    rows = values[: n_whole * segment].reshape(n_whole, segment) if n_whole else values[None]
    rows = np.ascontiguousarray(rows[:, ::STRIDE])
    centre = np.median(rows, axis=1)
    distance = np.abs(rows - centre[:, None])
    spread = 1.4826 * np.median(distance, axis=1)
    rounded = spread == 0  # more than half of the values are equal
    spread[rounded] = 1.2533 * distance[rounded].mean(axis=1)
    if n_whole and len(values) % segment:
        return np.append(centre, centre[-1]), np.append(spread, spread[-1])
    return centre, spread


def find_spikes(
    values: FloatArray, segment: int, centre: FloatArray, reach: FloatArray, longest: int
) -> BoolArray:
    """Return the isolated spikes of at most `longest` samples in `values` without NaN.

    `centre`, `reach`: (n_segments,), level of each segment of `segment` samples, and least height
    of a spike, above that level and above the samples on either side. Spikes closer to the ends
    than ``SIDE_SAMPLES`` are not found.
    """
    # candidates: samples far from the level, searched only in segments that have one
    borders = np.arange(0, len(values), segment)
    highest, lowest = (f.reduceat(values, borders) for f in (np.maximum, np.minimum))
    far = np.zeros(len(values), dtype=np.bool_)
    for i in np.flatnonzero(np.maximum(highest - centre, centre - lowest) > reach):
        part = slice(borders[i], borders[i] + segment)
        far[part] = np.abs(values[part] - centre[i]) > reach[i]
    starts, stops = runs(far, at_most=longest)
    inside = (starts >= SIDE_SAMPLES) & (stops + SIDE_SAMPLES <= len(values))
    starts, stops = starts[inside], stops[inside]
    if len(starts) == 0:
        return np.zeros(len(values), dtype=np.bool_)
    # confirm them by the samples on either side
    height, calm = _height(values, starts, stops)
    least = np.maximum(reach[starts // segment], COARSE_STEPS * _smallest_step(values))
    isolated = (height > least) & (calm < CALM * height)
    return paint(len(values), starts[isolated], stops[isolated])


def _smallest_step(values: FloatArray) -> float:
    steps = np.abs(np.diff(values))
    return float(steps.min(where=steps > 0, initial=math.inf))


def _height(values: FloatArray, starts: IntArray, stops: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the height of each run above both sides, and the largest spread there; (n_runs,)."""
    width = int((stops - starts).max())
    peak = values[np.minimum(starts[:, None] + np.arange(width), stops[:, None] - 1)]
    above, below, spread = [], [], []
    for border, side in ((starts, np.arange(-SIDE_SAMPLES, 0)), (stops, np.arange(SIDE_SAMPLES))):
        on_sides = values[border[:, None] + side]  # (n_runs, SIDE_SAMPLES)
        level = np.median(on_sides, axis=1, keepdims=True)
        above.append((peak - level).min(axis=1))
        below.append((level - peak).min(axis=1))
        spread.append(np.partition(np.abs(on_sides - level), -2, axis=1)[:, -2])
    height = np.maximum(np.minimum(*above), np.minimum(*below))
    return height, np.maximum(*spread)


def runs(
    mask: BoolArray, at_least: int = 1, at_most: int | None = None
) -> tuple[IntArray, IntArray]:
    """Return the first and one past the last index of runs of True with a length in bounds."""
    if not mask.any():
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    starts, stops = edges[::2], edges[1::2]
    kept = stops - starts >= at_least
    if at_most is not None:
        kept &= stops - starts <= at_most
    return starts[kept], stops[kept]


def paint(n_samples: int, starts: IntArray, stops: IntArray) -> BoolArray:
    """Return a mask of True from each start up to its stop, which may be the next start."""
    steps = np.zeros(n_samples + 1, dtype=np.int8)
    steps[starts] += 1
    steps[stops] -= 1
    return np.cumsum(steps[:-1], dtype=np.int8).view(np.bool_)


def fill(values: FloatArray, holes: BoolArray) -> FloatArray:
    """Return values with holes interpolated linearly, and at the ends by the nearest value.

    If all are holes, they remain unchanged, except for gaps, which become zero.
    """
    if not holes.any():
        return values
    good = np.flatnonzero(~holes)
    if len(good) == 0:
        return np.where(find_gaps(values), 0.0, values)
    filled = values.copy()
    index = np.flatnonzero(holes)
    filled[index] = np.interp(index, good, values[good])
    return filled
