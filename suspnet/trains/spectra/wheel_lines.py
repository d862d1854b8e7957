"""Out-of-round wheels: lines of the axle box's spectrum at multiples of the wheel's rotation.

A wheel of the diameter d whose radius varies by X cos(n phi), phi its angle, moves the axle box by
X cos(2 pi n kappa x) along the distance x, kappa = 1 / (pi d): a line at n kappa cycles per metre,
whatever the speed. The acceleration divided by v^2 is therefore resampled to even steps of x (order
tracking), where a line of the amplitude (2 pi n kappa)^2 X stands out of the track's spectrum. The
track does not repeat itself with the wheel, and no other wheelset shares the line.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import torch
from scipy.signal import get_window, resample_poly
from torch import Tensor

from suspnet.ground.findings import Finding, at, together
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_sources import channel_of
from suspnet.trains.recordings.recording import Recording

WINDOW_M = 200.0
"""Length of a window, [m]: its inverse, the distance of the bins, is 1.3 % of a wheel's order 1."""
REACH = 0.35
"""Highest frequency over the rate of the recording: its low-pass has a gain of 0.98 there, and
weakens what it mirrors there by 35 dB."""
SLOWEST_M_PER_S = 10.0
"""Lowest speed in use, [m/s]; below it noise divided by v^2 hides the lines."""
DIAMETERS_M = (0.76, 0.92)
"""Diameters of a rail vehicle's wheels, worn and new, among which one is searched, [m]."""
TOLERANCE = 0.02
"""Relative tolerance of these diameters, or of one that is given, by the error of the speed."""
HIGHEST_ORDER = 8
"""Highest order that is searched: from 5 on the orders of the diameters overlap."""
UPSAMPLED = 8
"""Factor of the rate before linear interpolation, whose error is then below 0.7 %."""
SIDE_BINS, NEAR_BINS = 10, 3
"""A line is compared with the bins up to 10 away on each side, less the nearest 3."""
LEAST_WINDOWS = 20
"""Smallest number of windows behind a bin that is searched."""
CERTAIN, LEAST_RISE = 7.0, 0.4
"""A line stands out by 7 standard deviations, and by 0.4 in the mean logarithm of the power (a
factor of 1.5): by chance none does in 10^8 trips, and periodic traces of a real track are weak."""
STRETCHES, LEAST_OF_STRETCH = 3, 0.25
"""A wheel's line stands out in each third of a trip by a quarter of its mean; a bridge's does not.
"""
DEVIATION = 1.5
"""Standard deviation of the logarithm of one window's power over the mean of one side: pi / sqrt(6)
of an exponential variable, times 1.13 for the neighbours and 1.03 for the overlap of windows."""
LEAK = 0.001
"""Leakage of a line over the track's power above which a bin is left out. A line of 0.2 mm then
changes no estimate; with 0.1 it would (docs/methods.md)."""


@dataclass(frozen=True)
class WheelLine:
    """A line of an out-of-round wheel.

    `channel` is the sensor, `order` the number of waves around the wheel of `diameter_m`, and
    `per_m` that of cycles per metre. `size_mm` is the amplitude of the radius, half of peak to
    valley; `m_per_s2` that of the acceleration at `speed_m_per_s`, the mean over the windows in
    use. `height` is the line's power over the density of the background, [1/m].
    """

    channel: str
    order: int
    per_m: float
    diameter_m: float
    size_mm: float
    m_per_s2: float
    speed_m_per_s: float
    height: float

    def __str__(self) -> str:
        return at(
            self.channel,
            "wheel-order",
            order=self.order,
            size_mm=self.size_mm,
            m_per_s2=self.m_per_s2,
            speed_m_per_s=self.speed_m_per_s,
        )


@dataclass(frozen=True)
class _Windows:
    """Power density (n_windows, n_bins) of a / v^2, [1/m], and which bins are in reach."""

    per_m: FloatArray
    power: FloatArray
    valid: BoolArray
    speeds: FloatArray


@dataclass(frozen=True)
class _Peak:
    per_m: float
    certainty: float
    power: float
    background: float
    speed_m_per_s: float


_FOUND: WeakKeyDictionary[Recording, tuple[WheelLine, ...]] = WeakKeyDictionary()
"""Lines of the recordings in memory, as several estimates of a trip ask for them."""


def wheel_lines(recording: Recording) -> tuple[WheelLine, ...]:
    """Return the lines of out-of-round wheels in the axle box's signals, by sensor and order.

    Only sensors at axle 1 count, so that all are on one wheelset: its diameter is the one that
    explains most of the lines. It is searched within ``DIAMETERS_M`` unless the manifest gives it.
    """
    if recording not in _FOUND:
        _FOUND[recording] = _search(recording)
    return _FOUND[recording]


def _search(recording: Recording) -> tuple[WheelLine, ...]:
    peaks = {
        name: _peaks(_windows(recording, signal))
        for name, signal in recording.sensors().items()
        if channel_of(name) == CHANNELS[0]
    }
    every = [peak for several in peaks.values() for peak in several]
    low, high = _diameters_m(recording)
    # each order that a peak may be gives a diameter; take the one with most lines
    tried = [
        n / (math.pi * peak.per_m)
        for peak in every
        for n in range(1, HIGHEST_ORDER + 1)
        if low <= n / (math.pi * peak.per_m) <= high
    ]
    if not tried:
        return ()
    diameter = max(tried, key=lambda d: sum(p.certainty for p in every if _order(p, d)))
    return tuple(
        _line(name, peak, order, diameter)
        for name, several in peaks.items()
        for peak in several
        if (order := _order(peak, diameter))
    )


def wheel_words(recording: Recording, lines: Sequence[WheelLine]) -> str:
    """Return the lines as text; empty if there are none, or that no order can be seen."""
    low, high = _diameters_m(recording)
    if not lines:
        speeds = recording.speed_m_per_s[recording.usable]
        slowest = float(np.quantile(speeds, 0.1))
        per_m = 1 / (math.pi * high) + SIDE_BINS / WINDOW_M
        first_hz, top_hz = slowest * per_m, REACH * recording.rate_hz
        if first_hz <= top_hz:
            return ""
        return Finding("wheels-not-seen", first_hz=first_hz, top_hz=top_hz)
    is_stated = recording.manifest.wheel_diameter_m is not None
    listed, diameter_m = together(map(str, lines), ", "), lines[0].diameter_m
    kind = "wheel" if is_stated else "wheel-found"
    return Finding(kind, diameter_m=diameter_m, low=low, high=high, lines=listed)


def line_bins(
    lines: Sequence[WheelLine],
    speeds: Tensor,
    frequencies_hz: Tensor,
    segment_s: float,
    n_bins: int = 1,
) -> Tensor:
    """Return which bins (n_freq,) hold lines, or their leakage, in segments of these speeds.

    `speeds`: (n_segments, n_samples), [m/s]; each bin is the mean of `n_bins` of a segment's. The
    power of a Hann window falls as 1 / (pi d^3)^2 with the distance of d bins.
    """
    is_line = torch.zeros(len(frequencies_hz), dtype=torch.bool)
    for line in lines:
        height = line.height * float(speeds.mean()) * segment_s
        reach_bins = max(2.0, (height / (LEAK * math.pi**2)) ** (1 / 6)) + n_bins // 2
        reach_hz = reach_bins / segment_s
        low, high = line.per_m * float(speeds.min()), line.per_m * float(speeds.max())
        is_line |= (frequencies_hz >= low - reach_hz) & (frequencies_hz <= high + reach_hz)
    return is_line


def _diameters_m(recording: Recording) -> tuple[float, float]:
    stated = recording.manifest.wheel_diameter_m
    low, high = DIAMETERS_M if stated is None else (stated, stated)
    return low * (1 - TOLERANCE), high * (1 + TOLERANCE)


def _order(peak: _Peak, diameter_m: float) -> int:
    """Return the order of a peak for a wheel, 0 if it is none within one and a half bins."""
    order = round(peak.per_m * math.pi * diameter_m)
    away = abs(order / (math.pi * diameter_m) - peak.per_m)
    return order if order <= HIGHEST_ORDER and away <= 1.5 / WINDOW_M else 0


def _line(channel: str, peak: _Peak, order: int, diameter_m: float) -> WheelLine:
    amplitude, omega = math.sqrt(2 * peak.power), 2 * math.pi * peak.per_m
    v = peak.speed_m_per_s
    return WheelLine(
        channel,
        order,
        peak.per_m,
        diameter_m,
        1e3 * amplitude / omega**2,
        amplitude * v**2,
        v,
        peak.power / peak.background,
    )


def _windows(recording: Recording, signal: FloatArray) -> _Windows | None:
    """Return the spectra over distance of all windows without faults; None if there are few."""
    rate_hz = recording.rate_hz
    speed = np.nan_to_num(recording.speed_m_per_s)
    usable = recording.usable & (speed >= SLOWEST_M_PER_S)
    if usable.sum() < 2:
        return None
    # even steps of the distance, fine enough for all frequencies at the slowest speed
    step_m = max(SLOWEST_M_PER_S, float(np.quantile(speed[usable], 0.02)) * 0.99) / rate_hz
    usable &= speed >= step_m * rate_hz
    fine = np.arange(len(speed) * UPSAMPLED) / UPSAMPLED
    fast = np.interp(fine, np.arange(len(speed)), speed)
    # sampled evenly along the track, an out-of-round wheel is a line at any speed
    distance_m = np.cumsum(fast) / (rate_hz * UPSAMPLED)
    curvature = resample_poly(signal, UPSAMPLED, 1) / np.maximum(fast, SLOWEST_M_PER_S) ** 2
    grid = np.arange(distance_m[0], distance_m[-1], step_m)
    length = round(WINDOW_M / step_m)
    if len(grid) < length * LEAST_WINDOWS / 2:
        return None
    at = np.interp(grid, distance_m, fine)
    values = np.interp(at, fine, curvature)
    good, velocity = usable[at.astype(np.intp)], np.interp(at, fine, fast)
    # windows of half overlap
    pieces, is_good, fastest = (
        np.lib.stride_tricks.sliding_window_view(values_along, length)[:: length // 2]
        for values_along in (values, good, velocity)
    )
    whole = is_good.all(axis=1)
    if whole.sum() < LEAST_WINDOWS:
        return None
    pieces, fastest = pieces[whole], fastest[whole]
    window = get_window("hann", length)
    per_m: FloatArray = np.asarray(np.fft.rfftfreq(length, step_m), dtype=np.float64)
    is_used = per_m <= (HIGHEST_ORDER + 1) / (math.pi * DIAMETERS_M[0])
    spectra = np.fft.rfft((pieces - pieces.mean(axis=1, keepdims=True)) * window)[:, is_used]
    power = np.abs(spectra) ** 2 * (2 * step_m / float(window @ window))
    valid = per_m[is_used] * fastest.max(axis=1, keepdims=True) <= REACH * rate_hz
    return _Windows(per_m[is_used], power, valid, fastest.mean(axis=1))


def _beside(values: FloatArray, side: int) -> FloatArray:
    """Return the mean of the bins on the left (-1) or right (1) of each bin; NaN at the ends."""
    n_near, n_bins = SIDE_BINS - NEAR_BINS, values.shape[1]
    sums = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
    means = (sums[:, n_near:] - sums[:, :-n_near]) / n_near  # of the bins from each one on
    beside = np.full_like(values, np.nan)
    inside = np.arange(SIDE_BINS, n_bins - SIDE_BINS)
    beside[:, inside] = means[:, inside + (NEAR_BINS + 1 if side > 0 else -SIDE_BINS)]
    return beside


def _peaks(windows: _Windows | None) -> list[_Peak]:
    if windows is None or len(windows.per_m) <= 2 * SIDE_BINS:
        return []
    # a bin needs its neighbours in reach as well
    valid = windows.valid.copy()
    valid[:, :-SIDE_BINS] &= windows.valid[:, SIDE_BINS:]
    valid[:, -SIDE_BINS:] = valid[:, :SIDE_BINS] = False
    logs = np.log(np.maximum(windows.power, np.finfo(float).tiny))
    sides = [logs - _beside(logs, side) for side in (-1, 1)]

    def rise_of(rows: IntArray) -> FloatArray:
        """Return the mean height over the higher side, so that a step of the track is no line."""
        means = (np.ma.array(side[rows], mask=~valid[rows]).mean(axis=0) for side in sides)
        return np.asarray(np.minimum(*(mean.filled(np.nan) for mean in means)))

    n, rows = valid.sum(axis=0), np.arange(len(logs))
    rise, rises = rise_of(rows), [rise_of(stretch) for stretch in np.array_split(rows, STRETCHES)]
    certainty = np.where(n >= LEAST_WINDOWS, rise * np.sqrt(n) / DEVIATION, 0.0)
    peaks = []
    for k in np.flatnonzero((certainty >= CERTAIN) & (rise >= LEAST_RISE)).tolist():
        near = slice(max(k - SIDE_BINS, 0), k + SIDE_BINS + 1)
        in_all = all(not stretch[k] < LEAST_OF_STRETCH * rise[k] for stretch in rises)
        if in_all and rise[k] >= np.nanmax(rise[near]):
            peaks.append(_peak(windows, valid[:, k], k, float(certainty[k])))
    return [peak for peak in peaks if peak.power > 0]


def _peak(windows: _Windows, used: BoolArray, k: int, certainty: float) -> _Peak:
    """Return the line at bin `k`, measured in the windows `used`: its power above both sides."""
    mean = windows.power[used].mean(axis=0)
    away = np.abs(np.arange(len(mean)) - k)
    level = float(mean[(away > NEAR_BINS) & (away <= SIDE_BINS)].mean())
    above = np.where(away <= NEAR_BINS, mean - level, 0.0)
    weights = np.where(away < NEAR_BINS, np.maximum(above, 1e-9 * level), 0.0)
    place, speed = np.average(windows.per_m, weights=weights), windows.speeds[used].mean()
    return _Peak(float(place), certainty, float(above.sum() / WINDOW_M), level, float(speed))
