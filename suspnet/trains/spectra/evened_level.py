"""Signals scaled as if the track were equally rough throughout.

Rough stretches, welds and crossings would outweigh all others in averaged spectra: fewer averages
would count, dampers that blow off are softer there, and their incoherent forces
(`suspnet.trains.spectra.damper_distortion`) grow faster than the motion. All signals are divided by
one slowly varying level, whose logarithm is half the mean log spectrum of all sensors in short
windows, so that no ratio of two signals changes but where the level does within the time that the
vehicle remembers.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from suspnet.curves.welch import Welch, segment_spectra
from suspnet.ground.tensors import as_tensor
from suspnet.ground.types import FloatArray

BAND_HZ = 0.5, 18.0
"""Band of the level."""
WINDOWS = Welch(4.0, 0.75)
"""Windows of its spectra."""
SMOOTH_S = 2.0
"""Standard deviation of the kernel it is smoothed with, [s]."""
SILENT = 1e-12
"""Least density that counts, [(m/s^2)^2/Hz]."""


def log_levels(signals: FloatArray, usable: NDArray[np.bool_], rate_hz: float) -> FloatArray:
    """Return the logarithm of the level at each sample, (n_samples,).

    `signals` (n_sensors, n_samples) [m/s^2], `usable` (n_samples,). It is 0 on average
    over the windows, and everywhere if fewer than two are usable.
    """
    n_samples = signals.shape[1]
    length, step = WINDOWS.sizes(rate_hz)
    if n_samples < length:
        return np.zeros(n_samples)
    found = segment_spectra(
        as_tensor(signals, copy=False), rate_hz, WINDOWS, *BAND_HZ, as_tensor(usable, np.bool_)
    )
    if len(found.first) < 2:
        return np.zeros(n_samples)
    powers = found.values.abs().square().clamp(min=SILENT)
    logs = torch.log(powers).mean(dim=(1, 2)).numpy() / 2
    middles = found.first.numpy() + length / 2
    every = np.arange(middles[0], middles[-1] + 1, step)
    even = gaussian_filter1d(
        np.interp(every, middles, logs), SMOOTH_S * rate_hz / step, mode="nearest"
    )
    at = np.clip(np.arange(n_samples), every[0], every[-1])
    return np.asarray(CubicSpline(every, even)(at) - even.mean())
