"""Overview of a recording for figures: a bounded number of windows, whatever its length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspnet.ground.types import BoolArray, FloatArray
from suspnet.recordings.recording import Recording

WINDOWS = 600
"""Largest number of windows, about as many as a figure has pixels across."""


@dataclass(frozen=True, eq=False)
class Overview:
    """Range and mean of the signals of a recording in windows of equal length.

    Attributes
    ----------
    times_s : array of shape (n_windows,), [s]
        Begin of each window, from the first sample on.
    low, high, mean : arrays of shape (3, n_windows), [m/s^2]
        Least, largest and mean value of axle box, bogie and body.
    speed_m_per_s : array of shape (n_windows,), [m/s]
        Mean speed; NaN where it is unknown in part.
    faulty : bool array of shape (n_windows,), optional
        Where some sample cannot be used; None if that is not known.
    """

    times_s: FloatArray
    low: FloatArray
    high: FloatArray
    mean: FloatArray
    speed_m_per_s: FloatArray
    faulty: BoolArray | None = None


def overview(recording: Recording) -> Overview:
    """Return the signals of a recording in at most ``WINDOWS`` windows."""
    n_windows = min(WINDOWS, recording.signals.shape[1])
    size = recording.signals.shape[1] // n_windows
    windows = recording.signals[:, : n_windows * size].reshape(3, n_windows, size)
    speed = recording.speed_m_per_s[: n_windows * size].reshape(n_windows, size)
    return Overview(
        times_s=np.arange(n_windows) * size / recording.rate_hz,
        low=windows.min(axis=2),
        high=windows.max(axis=2),
        mean=windows.mean(axis=2),
        speed_m_per_s=speed.mean(axis=1),
        faulty=np.any(~recording.usable[: n_windows * size].reshape(n_windows, size), axis=1),
    )
