"""Welch's method: windowed, overlapping segments, and what they do to averaged spectra."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.signal import get_window
from torch import Tensor

from suspnet.ground.checks import check_number
from suspnet.ground.types import FloatArray

NEGLIGIBLE = 1e-4
"""Leakage and correlation between bins below this, relative to a bin's own, are neglected."""


@dataclass(frozen=True)
class Welch:
    """How a recording is cut into windowed segments whose spectra are averaged.

    Parameters
    ----------
    segment_s : float, [s]
        Length of a segment; its inverse is the spacing of the bins.
    overlap : float, [-]
        Fraction shared by neighbouring segments.
    window : str
        A window of ``scipy.signal.get_window``.

    Raises
    ------
    TypeError, ValueError
        If a setting is out of range or there is no such window.
    """

    segment_s: float = 20.0
    overlap: float = 0.5
    window: str = "hann"

    def __post_init__(self) -> None:
        check_number("segment_s", self.segment_s, above=0, most=1e5)
        check_number("overlap", self.overlap, low=0, below=1)
        get_window(self.window, 8)

    def sizes(self, rate_hz: float) -> tuple[int, int]:
        """Return the samples of a segment and of the step from one to the next."""
        length = round(self.segment_s * rate_hz)
        return length, max(1, length - round(self.overlap * length))

    def n_averages(self, n_segments: float) -> float:
        """Return the number of independent segments that average as well as overlapping ones.

        n / (1 + 2 sum_j (1 - j/n) rho_j), rho_j = (sum w(t) w(t + j step) / sum w^2)^2: Welch 1967.
        """
        length, step = self.sizes(256 / self.segment_s)
        window = get_window(self.window, length)
        total = 1.0
        for j in range(1, min(math.ceil(length / step), math.ceil(n_segments))):
            shared = float(window[j * step :] @ window[: length - j * step])
            total += 2 * (1 - j / n_segments) * (shared / float(window @ window)) ** 2
        return n_segments / total

    def smear(self) -> Tensor:
        """Return the weights with which neighbouring bins leak into one, symmetric, sum 1.

        The expected spectrum is the true one convolved with abs(W(f))^2. Sampled at the bins that
        is exact for a system whose ringing is short against the segment. Hann: 1/6, 2/3, 1/6.
        """
        transform = np.fft.fft(get_window(self.window, 256)) / 256
        return _symmetric(np.abs(transform) ** 2)

    @property
    def correlated_bins(self) -> float:
        """Number of neighbouring bins with the information of one: r = rho_0 + 2 sum_k rho_k.

        rho is the `correlation`; Hann: 1.94.
        """
        rho = self.correlation()
        return float(2 * rho.sum() - rho[0])

    def correlation(self) -> Tensor:
        """Return the correlation of averaged spectra between a bin and its next ones, from lag 0.

        abs(sum_t w^2 exp(-2 pi j k t / T) / sum_t w^2)^2; Hann: 1, 4/9, 1/36.
        """
        transform = np.fft.fft(get_window(self.window, 256) ** 2)
        rho = np.abs(transform[:128] / transform[0]) ** 2
        return torch.as_tensor(rho[: np.flatnonzero(rho > NEGLIGIBLE)[-1] + 1])


def _symmetric(power: FloatArray) -> Tensor:
    """Return power[-k] to power[k] scaled to sum 1, with k the last bin that is not negligible."""
    half = len(power) // 2
    k = int(np.flatnonzero(power[:half] > NEGLIGIBLE * power[0])[-1])
    taps = np.concatenate([power[k:0:-1], power[: k + 1]])
    return torch.as_tensor(taps / taps.sum())
