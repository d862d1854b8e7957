"""Faults of one accelerometer: detected in its samples, repaired if short, otherwise marked.

Detectors take one piece of a signal; masks have shape (n_samples,). `Cleaner` cuts a channel into
pieces and joins the results.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from suspnet.ground.findings import at, of
from suspnet.ground.types import BoolArray, FloatArray, IntArray

LARGEST_M_PER_S2 = 1e30
"""Magnitude above which a value is missing: loggers write 3.4e38 or infinity for that."""
STRIDE = 7  # stride of the samples from which level and spread are estimated
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
    in_bounds = stops - starts >= at_least
    if at_most is not None:
        in_bounds &= stops - starts <= at_most
    return starts[in_bounds], stops[in_bounds]


def paint(n_samples: int, starts: IntArray, stops: IntArray) -> BoolArray:
    """Return a mask of True from each start up to its stop; up to 100 runs may overlap."""
    steps = np.zeros(n_samples + 1, dtype=np.int8)
    np.add.at(steps, starts, 1)
    np.add.at(steps, stops, -1)
    return np.asarray(np.cumsum(steps[:-1], dtype=np.int8) > 0)


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


KINDS = tuple("gap spike saturation constant offset zero jump stuck loose clock dead".split())
"""Kinds of faults; zero, jump and stuck concern the speed, the last three several sensors."""
CORE_SAMPLES = 2**18
"""Approximate number of samples checked at once, which fit in the processor's cache."""
SEGMENT_S, SEGMENT_SAMPLES = 1.0, 64
"""Length of a segment for level and spread [s], and its least number of samples."""
SPIKE_DEVIATIONS, SPIKE_SAMPLES = 25.0, 3
"""Least height of a spike above the level on both sides, in robust standard deviations (1.4826
times the median absolute deviation of a segment), and its largest number of samples; anything
longer counts as motion."""
GAP_SAMPLES = 3  # number of samples of the longest gap that is repaired
SATURATION_FRACTION, SATURATION_SAMPLES = 0.999, 4
"""Fraction of the sensor's range from which a sample is saturated; if no range is given, least
number of equal samples in a row at the highest or lowest value of a window."""
CONSTANT_S = 0.1  # duration beyond which identical values are marked as those of a dead sensor, [s]
OFFSET_FRACTION = 0.5  # fraction of the standard deviation above which a mean is reported
ODD_MEAN_M_PER_S2, LARGEST_MEAN_M_PER_S2 = 30.0, 5000.0
"""Means above which a sensor's unit is doubted, and refused: gravity has 9.81 m/s2, a zero point
that was not subtracted about the sensor's range, and gravity in mg read as g 9,810 m/s2."""


@dataclass(frozen=True)
class Fault:
    """All samples of one channel that share one kind of fault.

    `kind` is one of ``KINDS``; the channel may be "speed". `seconds` is the total duration and
    `first_s` the first occurrence on the trip's clock. `repaired` samples were interpolated, or a
    later high-pass filter removes the fault (offset); others are marked as unusable.
    `size_m_per_s2` is the mean of an offset. `words` describes a clock fault, or a loose or dead
    sensor.
    """

    channel: str
    kind: str
    n_samples: int
    seconds: float
    first_s: float
    repaired: bool
    size_m_per_s2: float | None = None
    words: str = ""

    def __str__(self) -> str:
        if self.words:
            return of(self.channel, self.words)
        if (size := self.size_m_per_s2) is not None:
            is_odd = self.kind == "offset" and abs(size) > ODD_MEAN_M_PER_S2
            kind = "odd-offset" if is_odd else "harmless"
            return at(self.channel, kind, kind=self.kind, m_per_s2=size)
        values = {"kind": self.kind, "seconds": self.seconds, "first_s": self.first_s}
        fate = "repaired" if self.repaired else "not usable"
        return at(self.channel, "sample", n=self.n_samples, fate=fate, **values)


class Cleaner:
    """Cleans one channel block by block, and counts its faults.

    The result does not depend on how the channel is cut into blocks. `range_m_per_s2` is the
    largest magnitude that the sensor can measure.
    """

    def __init__(self, channel: str, rate_hz: float, range_m_per_s2: float | None = None) -> None:
        self.channel, self.rate_hz, self.range_m_per_s2 = channel, rate_hz, range_m_per_s2
        self.segment = max(round(rate_hz * SEGMENT_S), SEGMENT_SAMPLES)
        self.n_samples, self.n_bad = 0, 0
        self.lowest, self.highest = math.inf, -math.inf
        self._counts: dict[tuple[str, bool], tuple[int, int]] = {}  # kind, repaired: count, first
        self._sum = self._sum_of_squares = 0.0
        self._longest_constant = int(CONSTANT_S * rate_hz + 1e-9)
        context = math.ceil(max(self._longest_constant, 1) / self.segment) * self.segment
        core = math.ceil(max(CORE_SAMPLES, context) / self.segment) * self.segment
        self._windows = _Windows(core, context)

    def push(self, block: FloatArray) -> Iterator[tuple[FloatArray, BoolArray]]:
        """Yield values without NaN [m/s2] and a mask of bad ones, of windows that are complete."""
        for window in self._windows.push(block):
            yield self._cleaned(*window)

    def finish(self) -> Iterator[tuple[FloatArray, BoolArray]]:
        """Yield the same for the remaining samples."""
        for window in self._windows.finish():
            yield self._cleaned(*window)

    def _cleaned(self, window: FloatArray, lead: int, length: int) -> tuple[FloatArray, BoolArray]:
        """Return values and bad samples of the core of a window: `length` samples from `lead`."""
        values, bad, masks = self._check(window)
        inside = slice(lead, lead + length)
        for (kind, repaired), mask in masks.items():
            self._count(kind, repaired, mask[inside])
        self._add(values[inside], bad[inside])
        return values[inside], bad[inside]

    def state(self) -> dict[str, Any]:
        """Return arrays and JSON-able values from which `restore` continues."""
        return {
            "pending": np.concatenate([np.empty(0), *self._windows.pending]),
            "lead": self._windows.lead,
            "sums": [self.lowest, self.highest, self._sum, self._sum_of_squares],
            "counts": [self.n_samples, self.n_bad],
            "found": [[*kind, *counts] for kind, counts in self._counts.items()],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the state of a cleaner of the same channel."""
        self._windows.pending = [state["pending"]]
        self._windows.held, self._windows.lead = len(state["pending"]), state["lead"]
        self.lowest, self.highest, self._sum, self._sum_of_squares = state["sums"]
        self.n_samples, self.n_bad = state["counts"]
        self._counts = {(kind, fixed): (n, first) for kind, fixed, n, first in state["found"]}

    def _check(
        self, window: FloatArray
    ) -> tuple[FloatArray, BoolArray, dict[tuple[str, bool], BoolArray]]:
        """Return filled values, bad samples, and masks by (kind, repaired)."""
        gap = find_gaps(window)
        filled = fill(window, gap)
        centre, spread = local_level(filled, self.segment)
        # motion may start within a segment: use the widest spread of it and its neighbours
        padded = np.pad(spread, 1, mode="edge")
        widest = np.maximum(np.maximum(padded[:-2], spread), padded[2:])
        reach = SPIKE_DEVIATIONS * widest
        spike = find_spikes(filled, self.segment, centre, reach, SPIKE_SAMPLES)
        constant = find_constant(window, self._longest_constant)
        # without a range, only clipping shows saturation; gaps and dead sensors look alike there
        if self.range_m_per_s2 is None:
            saturation = find_clipping(filled, SATURATION_SAMPLES) & ~(gap | constant)
        else:
            saturation = (np.abs(filled) >= SATURATION_FRACTION * self.range_m_per_s2) & ~gap
        short = paint(len(gap), *runs(gap, at_most=GAP_SAMPLES))
        bad = (gap & ~short) | saturation | constant
        masks = {
            ("gap", True): short,
            ("gap", False): gap & ~short,
            ("spike", True): spike & ~(bad | gap),
            ("saturation", False): saturation,
            ("constant", False): constant,
        }
        return fill(filled, bad | spike), bad, masks

    def _count(self, kind: str, repaired: bool, mask: BoolArray) -> None:
        if count := int(np.count_nonzero(mask)):
            first_here = self.n_samples + int(mask.argmax())
            before, first = self._counts.get((kind, repaired), (0, first_here))
            self._counts[kind, repaired] = (before + count, first)

    def _add(self, values: FloatArray, bad: BoolArray) -> None:
        n_bad = int(np.count_nonzero(bad))
        self.n_samples += len(values)
        self.n_bad += n_bad
        self.lowest = min(self.lowest, float(values.min()))
        self.highest = max(self.highest, float(values.max()))
        good = values[~bad] if n_bad else values
        self._sum += float(good.sum())
        # not BLAS: it would start threads and wait for them longer than the sum takes
        self._sum_of_squares += float(np.einsum("i,i->", good, good))

    @property
    def mean(self) -> float:
        """Mean of the good samples so far, [m/s2]; NaN without one."""
        n_good = self.n_samples - self.n_bad
        return self._sum / n_good if n_good else math.nan

    def faults(self, start_s: float = 0.0) -> tuple[Fault, ...]:
        """Return the faults so far, sorted by ``KINDS``; the first sample is at `start_s`."""
        faults = [
            Fault(self.channel, kind, n, n / self.rate_hz, start_s + first / self.rate_hz, repaired)
            for (kind, repaired), (n, first) in self._counts.items()
        ]
        if n_good := self.n_samples - self.n_bad:
            rms = math.sqrt(max(self._sum_of_squares / n_good - self.mean * self.mean, 0.0))
            if abs(self.mean) > OFFSET_FRACTION * rms:
                whole = self.n_samples, self.n_samples / self.rate_hz, start_s, True
                faults.append(Fault(self.channel, "offset", *whole, self.mean))
        return tuple(sorted(faults, key=lambda f: (KINDS.index(f.kind), not f.repaired)))


class _Windows:
    """Cuts a stream into windows: consecutive cores with `context` samples on both sides.

    It yields (window, samples before its core, samples of its core).
    """

    def __init__(self, core: int, context: int) -> None:
        self.core, self.context = core, context  # core >= context
        self.pending: list[FloatArray] = []
        self.held = self.lead = 0

    def push(self, block: FloatArray) -> Iterator[tuple[FloatArray, int, int]]:
        """Yield the windows that the next samples complete."""
        self.pending.append(block)
        self.held += len(block)
        if self.held >= self.lead + self.core + self.context:
            yield from self._complete()

    def _complete(self) -> Iterator[tuple[FloatArray, int, int]]:
        buffer, size = np.concatenate([np.empty(0), *self.pending]), self.core + self.context
        # each window after the first removes `core` samples from the buffer
        while len(buffer) >= self.lead + size:
            yield buffer[: self.lead + size], self.lead, self.core
            buffer, self.lead = buffer[self.lead + self.core - self.context :], self.context
        self.pending, self.held = [buffer.copy()], len(buffer)  # a view would keep all alive

    def finish(self) -> Iterator[tuple[FloatArray, int, int]]:
        """Yield the remaining windows, of which the last may have a shorter core."""
        yield from self._complete()
        if self.held > self.lead:
            yield self.pending[0], self.lead, self.held - self.lead
