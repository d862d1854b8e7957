"""Clocks of two sensors that run apart: the delay between them along the trip.

Sensors of one vehicle feel the same track, so that the cross-correlation of two has its peak at a
delay that depends on the vehicle and its speed only. If one clock runs fast, the delay grows with
time; if a logger loses samples, it jumps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.signal import get_window

from suspnet.recordings.checked_mapping import TripError
from suspnet.recordings.cleaning import Fault
from suspnet.recordings.manifest import CHANNELS, SIDES, Channel, TripManifest
from suspnet.types import BoolArray, ComplexArray, FloatArray

WINDOW_S = 20.0
"""Length of the windows whose delays are compared, [s]."""

BAND_HZ = (1.0, 15.0)
"""Band of the cross-correlation, [Hz]."""

LEAST_WINDOWS = 6
"""Least number of windows with a clear peak."""

LEAST_CORRELATION = 0.4
"""Least correlation of a window's cross-spectrum with the common one for its peak to be clear."""

NEWTON_STEPS = 3
"""Number of steps from the highest sample of the cross-correlation to its peak."""

MEMORY = 0.2
"""Weight of the newest window in the common cross-spectrum that follows a drifting clock."""

SIGNIFICANT = 6.0
"""A drift or jump is told if it is larger than this many standard deviations ..."""

TOLD_S, REFUSED_S = 0.003, 0.02
"""... and changes the delay along the trip by more than the first, [s]. More than the second costs
estimates 2 % and more: such a trip is refused."""


@dataclass(frozen=True)
class Drift:
    """How the delay of one sensor behind another changes along a trip.

    Attributes
    ----------
    rate : float, [-]
        Change of the delay over time.
    deviation : float, [-]
        Its standard deviation.
    jump_s, jump_deviation_s : float, [s]
        The largest jump if the delay jumps rather than drifts, and its deviation; otherwise 0.
    jump_at_s : float, [s]
    seconds : float, [s]
        Time between the first and the last window.
    """

    rate: float
    deviation: float
    jump_s: float
    jump_deviation_s: float
    jump_at_s: float
    seconds: float


def clock_faults(
    manifest: TripManifest,
    values: Mapping[str, FloatArray],
    usable: BoolArray,
    speed_m_per_s: FloatArray,
    rate_hz: float,
) -> tuple[Fault, ...]:
    """Return the faults of clocks that run apart.

    Parameters
    ----------
    manifest : TripManifest
    values : dict of arrays of shape (n,), [m/s2]
        Each sensor on the common clock.
    usable : array of shape (n,)
    speed_m_per_s : array of shape (n,), [m/s]
    rate_hz : float, [Hz]

    Raises
    ------
    TripError
        If two run apart by more than ``REFUSED_S``.
    """
    faults = []
    for first, second in _compared(manifest):
        drift = find_drift(values[first], values[second], usable, speed_m_per_s, rate_hz)
        if drift is None:
            continue
        words, size_s = _words(manifest, first, second, drift)
        if size_s > REFUSED_S:
            raise TripError(
                f"{manifest.path}: channel {second!r}: clock {words}; correct that or give a "
                "column of `time`"
            )
        if size_s > TOLD_S:
            faults.append(
                Fault(second, "clock", len(usable), drift.seconds, 0.0, False, None, words)
            )
    return tuple(faults)


def _compared(manifest: TripManifest) -> list[tuple[str, str]]:
    """Return the pairs of sensors that are compared: along the chain, and at each place."""
    sides = {
        name: [name] if isinstance(one, Channel) else [f"{name} {side}" for side in SIDES]
        for name, one in manifest.channels.items()
    }
    firsts = [sides[name][0] for name in CHANNELS]
    pairs = [(sides[name][0], sides[name][1]) for name in CHANNELS if len(sides[name]) == 2]
    return [*pairwise(firsts), *pairs]


def _words(manifest: TripManifest, first: str, second: str, drift: Drift) -> tuple[str, float]:
    """Return what is wrong with the second sensor's clock, and how much the delay changes [s]."""
    if abs(drift.jump_s) > SIGNIFICANT * drift.jump_deviation_s:
        later = "ahead of" if drift.jump_s < 0 else "behind"
        words = (
            f"jumps {1e3 * abs(drift.jump_s):.3g} ms {later} that of {first} about "
            f"{drift.jump_at_s:.0f} s after the begin: were samples lost?"
        )
        return words, abs(drift.jump_s)
    if abs(drift.rate) < SIGNIFICANT * drift.deviation:
        return "", 0.0
    size_s = abs(drift.rate) * drift.seconds
    words = (
        f"runs {1e6 * drift.rate:+.3g} ppm against that of {first}, {1e3 * size_s:.3g} ms along "
        "the trip"
    )
    stated_hz = manifest.sensors()[second].rate_hz
    if stated_hz is not None:
        words += f"; with `rate_hz` {stated_hz * (1 + drift.rate):.8g} they would agree"
    return words, size_s


def find_drift(
    first: FloatArray,
    second: FloatArray,
    usable: BoolArray,
    speed_m_per_s: FloatArray,
    rate_hz: float,
) -> Drift | None:
    """Return how the delay of the second signal behind the first changes; None if that is unclear.

    Parameters
    ----------
    first, second : arrays of shape (n,), [m/s2]
    usable : array of shape (n,)
    speed_m_per_s : array of shape (n,), [m/s]
    rate_hz : float, [Hz]
    """
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
    if np.count_nonzero(clear) < LEAST_WINDOWS:
        return None
    middles_s = WINDOW_S * (np.flatnonzero(good)[clear] + 0.5)
    slowness = 1 / speed_m_per_s[whole].reshape(n_windows, size)[good].mean(axis=1)[clear]
    return _fitted(np.asarray(middles_s), delays_s[clear], slowness)


def _cross_spectra(
    first: FloatArray, second: FloatArray, good: BoolArray, size: int, rate_hz: float
) -> ComplexArray:
    """Return conj(X) Y of each good window in the band, each bin over its mean size."""
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
    """Return the bins of the band."""
    low, high = (round(edge * n_fft / rate_hz) for edge in BAND_HZ)
    return slice(low, high + 1)


def _delays(spectra: ComplexArray, size: int, rate_hz: float) -> tuple[FloatArray, BoolArray]:
    """Return the delay of each window relative to the others [s], and whether it is clear.

    The common spectrum first follows the windows one after the other, whatever the drift. Then it
    is the mean of all windows, each without its delay.
    """
    n_fft = 2 * size
    omega = (2 * np.pi * rfftfreq(n_fft, 1 / rate_hz))[_band(n_fft, rate_hz)]
    common = spectra[0]
    delays = np.zeros(len(spectra))
    for k in range(1, len(spectra)):
        delays[k] = _peak(spectra[k : k + 1] * common.conj(), omega, n_fft, rate_hz)[0]
        aligned = spectra[k] * np.exp(1j * omega * delays[k])
        common = (1 - MEMORY) * common + MEMORY * aligned
    for _ in range(2):
        aligned = spectra * np.exp(1j * omega * delays[:, None])
        common = aligned.mean(axis=0)
        delays += _peak(aligned * common.conj(), omega, n_fft, rate_hz)
    aligned = spectra * np.exp(1j * omega * delays[:, None])
    matched = (aligned * common.conj()).real.sum(axis=1)
    sizes = np.sqrt((np.abs(spectra) ** 2).sum(axis=1) * (np.abs(common) ** 2).sum())
    return delays, matched > LEAST_CORRELATION * np.where(sizes > 0, sizes, np.inf)


def _peak(spectra: ComplexArray, omega: FloatArray, n_fft: int, rate_hz: float) -> FloatArray:
    """Return the delay at the peak of the correlation of each of these spectra, (n,), [s].

    The peak of the sampled correlation is where Newton's method starts on Re sum G exp(i w t).
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


def _fitted(middles_s: FloatArray, delays_s: FloatArray, slowness: FloatArray) -> Drift:
    """Return drift and jump of delays, which also depend on the slowness of the train, [s/m]."""
    ramp = middles_s - middles_s.mean()
    columns = [np.ones_like(ramp), ramp]
    if slowness.std() > 0.01 * slowness.mean():
        columns.append(slowness - slowness.mean())
    design = np.stack(columns, axis=1)
    kept = np.ones(len(ramp), dtype=np.bool_)
    for _ in range(3):
        solution = np.linalg.lstsq(design[kept], delays_s[kept], rcond=None)[0]
        residuals = delays_s - design @ solution
        spread = 1.4826 * float(np.median(np.abs(residuals[kept])))
        kept = np.abs(residuals) <= max(4 * spread, 1e-6)
    n_free = max(np.count_nonzero(kept) - design.shape[1], 1)
    variance = float((residuals[kept] ** 2).sum()) / n_free
    covariance = np.linalg.pinv(design[kept].T @ design[kept]) * variance
    rate, deviation = float(solution[1]), float(np.sqrt(covariance[1, 1]))
    steps = np.diff(delays_s)
    noise = 1.4826 * float(np.median(np.abs(steps - np.median(steps)))) + 1e-5
    k = int(np.argmax(np.abs(steps)))
    before, after = (np.median(part) for part in (delays_s[: k + 1][-10:], delays_s[k + 1 :][:10]))
    jump = float(after - before)
    lasting = min(k + 1, len(steps) - k) >= 2 and abs(jump) > 0.5 * abs(steps[k])
    seconds = float(middles_s[-1] - middles_s[0])
    if not lasting or abs(steps[k]) < SIGNIFICANT * noise:
        return Drift(rate, deviation, 0.0, 0.0, 0.0, seconds)
    at_s = float(middles_s[k] + middles_s[k + 1]) / 2
    return Drift(rate, deviation, jump, noise, at_s, seconds)
