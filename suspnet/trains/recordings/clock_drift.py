"""Clock drift between two sensors, from the delay between their signals along the trip.

Sensors of one vehicle are excited by the same track, so the cross-correlation of two peaks at a
delay that depends only on the vehicle and its speed. If one clock runs fast, the delay grows with
time; if a logger loses samples, the delay jumps.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.signal import get_window

from suspnet.ground.findings import Finding, together
from suspnet.ground.types import BoolArray, ComplexArray, FloatArray, IntArray
from suspnet.trains.recordings.cleaning import Fault
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS, RIG_CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_sources import channel_of
from suspnet.trains.recordings.speed import STANDING_M_PER_S

WINDOW_S = 20.0  # length of the windows whose delays are compared, [s]
BAND_HZ = (1.0, 15.0)  # band of the cross-correlation, [Hz]
LEAST_WINDOWS = 6  # least number of windows with a clear correlation peak
SPEED_CLASS = 0.05
"""Relative width of a speed class, and largest relative change of the speed within a window."""
TRIMS = 3  # number of rounds in which outlying windows are excluded
JUMP_SHARE = 0.25
"""The delay jumps if a jump leaves less than this share of a drift's sum of squared residuals."""
FINEST_S = 1e-5  # lower bound for the standard deviation of a delay, [s]
LEAST_CORRELATION = 0.4
"""Least correlation of a window's cross-spectrum with the mean one for its peak to be clear."""
CLEAR_SHARE = 0.5
"""Least share of the windows at a steady speed that must have a clear peak: both axle boxes of a
wheelset of tests/rich_train.py had .43 of 14 on two trips, and seemed to jump by 2.4 and 3.5 s."""
NEWTON_STEPS = 3
"""Number of Newton steps from the highest sample of the cross-correlation to its peak."""
MEMORY = 0.2
"""Weight of the newest window in the reference cross-spectrum that tracks a drifting clock."""
SIGNIFICANT = 6.0  # least size of a drift or jump that is reported, in standard deviations
REPORTED_S, REFUSED_S = 0.003, 0.02
"""Changes of the delay along the trip from which a drift or jump is reported, and above which the
trip is refused, [s]: above the second, errors of estimates grow by 2 % or more."""


@dataclass(frozen=True)
class Drift:
    """Change of the delay of one sensor behind another along a trip.

    `size` is the jump [s] or the drift [s/s], `deviation` its standard deviation. `seconds` is the
    time between the first and the last window.
    """

    is_jump: bool
    size: float
    deviation: float
    jump_at_s: float
    seconds: float


def clock_faults(
    manifest: TripManifest,
    values: Mapping[str, FloatArray],
    usable: BoolArray,
    speed_m_per_s: FloatArray,
    rate_hz: float,
) -> tuple[Fault, ...]:
    """Return the clock faults of the sensors in `values`, each (n,) [m/s2] on the common clock.

    Raises TripError if two sensors drift by more than ``REFUSED_S``.
    """
    faults = []
    for first, second in compared_pairs(values):
        drift = find_drift(values[first], values[second], usable, speed_m_per_s, rate_hz)
        if drift is None:
            continue
        words, size_s = _words(manifest, first, second, drift)
        if size_s > REFUSED_S:
            raise TripError.at(manifest.path, "channel-clock", name=repr(second), words=words)
        if size_s >= REPORTED_S:
            fault = Fault(second, "clock", len(usable), drift.seconds, 0.0, False, None, words)
            faults.append(fault)
    return tuple(faults)


def compared_pairs(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the pairs of sensors to compare.

    They are neighbouring channels, both sides of each, and those of the other axle with the first.
    """
    channels = (*RIG_CHANNELS[:2], *CHANNELS)  # one recording has those of a rig or of a train
    by_channel = [[name for name in names if channel_of(name) == channel] for channel in channels]
    sides = [sensors for sensors in by_channel if sensors]
    elsewhere = [(sides[0][0], name) for name in names if sides and not channel_of(name)]
    pairs = [(sensors[0], sensors[1]) for sensors in sides if len(sensors) == 2]
    return [*pairwise(sensors[0] for sensors in sides), *pairs, *elsewhere]


def _words(manifest: TripManifest, first: str, second: str, drift: Drift) -> tuple[str, float]:
    if abs(drift.size) < SIGNIFICANT * drift.deviation:
        return "", 0.0
    if drift.is_jump:
        ms, jump_at_s = 1e3 * drift.size, drift.jump_at_s
        return Finding("clock-jumps", ms=ms, first=first, jump_at_s=jump_at_s), abs(drift.size)
    size_s = abs(drift.size) * drift.seconds
    words = Finding("clock-runs", ppm=1e6 * drift.size, first=first, ms=1e3 * size_s)
    stated_hz = manifest.sensors()[second].rate_hz
    if stated_hz is None:
        return words, size_s
    agreed = Finding("rate-would-agree", rate_hz=stated_hz * (1 + drift.size))
    return together((words, agreed)), size_s


def find_drift(
    first: FloatArray,
    second: FloatArray,
    usable: BoolArray,
    speed_m_per_s: FloatArray,
    rate_hz: float,
) -> Drift | None:
    """Return how the delay of the second signal behind the first changes; None if unclear.

    All arrays have shape (n,); the signals may have any common unit.
    """
    # delays of the windows that are usable throughout
    size = round(WINDOW_S * rate_hz)
    n_windows = len(first) // size
    if n_windows < LEAST_WINDOWS:
        return None
    whole = slice(0, n_windows * size)
    good = np.asarray(usable[whole].reshape(n_windows, size).all(axis=1))
    if np.count_nonzero(good) < LEAST_WINDOWS:
        return None
    spectra = _cross_spectra(first[whole], second[whole], good, size, rate_hz)
    delays_s, clear = _delays(spectra, size, rate_hz)
    classes = _speed_classes(speed_m_per_s[whole].reshape(n_windows, size)[good])
    # where the signals have little in common, a few windows agree on a wrong delay by chance
    n_clear = np.count_nonzero(clear & (classes >= 0))
    if n_clear < max(LEAST_WINDOWS, CLEAR_SHARE * np.count_nonzero(classes >= 0)):
        return None
    begins_s = WINDOW_S * np.flatnonzero(good)
    middles_s = np.asarray(begins_s[clear] + WINDOW_S / 2, dtype=np.float64)
    return _fitted(middles_s, delays_s[clear], classes[clear])


def _speed_classes(speeds: FloatArray) -> IntArray:
    mean = speeds.mean(axis=1)
    steady = (mean > STANDING_M_PER_S) & (np.ptp(speeds, axis=1) <= SPEED_CLASS * mean)
    classes = np.round(np.log(np.maximum(mean, STANDING_M_PER_S)) / SPEED_CLASS).astype(np.intp)
    return np.where(steady, classes - classes.min(), -1)


def _cross_spectra(
    first: FloatArray, second: FloatArray, good: BoolArray, size: int, rate_hz: float
) -> ComplexArray:
    """Return conj(X) Y of each good window in the band, each bin divided by its rms size."""
    window = get_window("hann", size)
    n_fft = 2 * size
    band = _band(n_fft, rate_hz)
    x, y = (
        rfft(window * signal.reshape(-1, size)[good], n_fft, axis=1)[:, band]
        for signal in (first, second)
    )
    scale = np.sqrt((np.abs(x) ** 2).mean(axis=0) * (np.abs(y) ** 2).mean(axis=0))
    return np.asarray(x.conj() * y / np.where(scale == 0, 1.0, scale))


def _band(n_fft: int, rate_hz: float) -> slice:
    low, high = (round(edge * n_fft / rate_hz) for edge in BAND_HZ)
    return slice(low, high + 1)


def _delays(spectra: ComplexArray, size: int, rate_hz: float) -> tuple[FloatArray, BoolArray]:
    """Return the delay of each window relative to the others [s], and whether its peak is clear.

    The reference spectrum first tracks the windows in order, whatever the drift. It is then the
    mean of all windows, each with its delay removed.
    """
    n_fft = 2 * size
    omega = (2 * np.pi * rfftfreq(n_fft, 1 / rate_hz))[_band(n_fft, rate_hz)]
    # track in order: a mean over the trip would be blurred by a drift
    common = spectra[0]
    delays = np.zeros(len(spectra))
    for k in range(1, len(spectra)):
        delays[k] = _peak(spectra[k : k + 1] * common.conj(), omega, n_fft, rate_hz)[0]
        aligned = spectra[k] * np.exp(1j * omega * delays[k])
        common = (1 - MEMORY) * common + MEMORY * aligned
    # then the mean of all aligned windows is the less noisy reference
    for _ in range(2):
        aligned = spectra * np.exp(1j * omega * delays[:, None])
        common = aligned.mean(axis=0)
        delays += _peak(aligned * common.conj(), omega, n_fft, rate_hz)
    aligned = spectra * np.exp(1j * omega * delays[:, None])
    matched = (aligned * common.conj()).real.sum(axis=1)
    sizes = np.sqrt((np.abs(spectra) ** 2).sum(axis=1) * (np.abs(common) ** 2).sum())
    return delays, matched > LEAST_CORRELATION * np.where(sizes > 0, sizes, np.inf)


def _peak(spectra: ComplexArray, omega: FloatArray, n_fft: int, rate_hz: float) -> FloatArray:
    """Return the delay at the correlation peak of each spectrum, (n,), [s].

    Newton's method on Re sum G exp(i w t) starts at the peak of the sampled correlation.
    """
    whole = np.zeros((len(spectra), n_fft // 2 + 1), dtype=np.complex128)
    whole[:, _band(n_fft, rate_hz)] = spectra
    top = irfft(whole, n_fft, axis=1).argmax(axis=1)
    delays = np.where(top > n_fft // 2, top - n_fft, top) / rate_hz
    for _ in range(NEWTON_STEPS):
        turned = spectra * np.exp(1j * omega * delays[:, None])
        slope, bend = -(turned.imag @ omega), turned.real @ omega**2
        step = np.divide(slope, bend, out=np.zeros(len(slope)), where=bend > 0)
        delays += step.clip(-0.5 / rate_hz, 0.5 / rate_hz)
    return np.asarray(delays)


def _fitted(middles_s: FloatArray, delays_s: FloatArray, classes: IntArray) -> Drift | None:
    """Return the drift or jump that better explains the delays; None if neither is determined.

    Delays depend on the speed, so each speed class has its own mean.
    """
    is_used = classes >= 0
    # fit again without the windows that lie far off the fit before
    for _ in range(1 + TRIMS):
        at = np.flatnonzero(is_used)
        if len(at) < LEAST_WINDOWS:
            return None
        _, place, count = np.unique(classes[at], return_inverse=True, return_counts=True)
        # regressors: time, for a drift, and a step after each window, for a jump
        later = np.tri(len(at), len(at), -1)[:, 1:-2]  # column k: after window k + 1
        regressors = np.column_stack([middles_s[at], later, delays_s[at]])
        # subtract the mean of each speed class
        sums = np.zeros((len(count), regressors.shape[1]))
        np.add.at(sums, place, regressors)
        regressors -= (sums / count[:, None])[place]
        target, regressors = regressors[:, -1], regressors[:, :-1]
        # fit each regressor alone; compare the drift with the best jump
        power = np.einsum("ij,ij->j", regressors, regressors)
        is_determined = power > 1e-6 * len(at)
        shared, zeros = regressors.T @ target, np.zeros(len(power))
        slopes = np.divide(shared, power, out=zeros, where=is_determined)
        explained = slopes**2 * power
        best = 1 + int(np.argmax(explained[1:]))
        misfits = np.maximum(target @ target - explained[[0, best]], 0.0)
        is_jump = bool(misfits[1] < JUMP_SHARE * misfits[0])
        chosen = best if is_jump else 0
        if not is_determined[chosen]:
            return None
        residuals = target - slopes[chosen] * regressors[:, chosen]
        spread = max(1.4826 * float(np.median(np.abs(residuals))), FINEST_S)
        is_used[at[np.abs(residuals) > 5 * spread]] = False
    deviation = spread / math.sqrt(power[chosen])
    seconds = float(middles_s[at[-1]] - middles_s[at[0]])
    jump_at_s = float(middles_s[at[best]] + middles_s[at[best + 1]]) / 2 if is_jump else 0.0
    return Drift(is_jump, float(slopes[chosen]), deviation, jump_at_s, seconds)
