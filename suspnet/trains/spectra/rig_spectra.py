"""The signals of a rig by frequency, in which its equations hold without leakage.

A segment of length T is windowed by v(t) = (1 - cos(2 pi t / T)) / 2, so that with x_m its Fourier
coefficients without a window, at f + m / T, and c = (-1, 2, -1) / 4 ::

    integral of v e^(-j omega t) R(d/dt) x dt = sum_m c_m R(j omega_m) x_m,    m = -1, 0, 1

exactly for an R of second order, by integration by parts: v and v' are 0 at both ends. A resonance
may thus be as narrow as it likes, and the record may start in the middle of a vibration.

The base moves the rig alone: in each bin the segments' signals are of one direction. With N the
sensors' noise and y_k = sum_m c_m x_m of segment k, u are the weights of the segments that make
N^-1/2 sum_k u_k y_k the largest, lambda its square over that of a sensor's noise. Those weights
add up the x_m, too, in which the equations still hold. The factor 1 - lambda_0 / lambda takes bins
without power out: lambda_0 = (1 + sqrt(3 / n))^2 is the largest of noise alone, of n averages.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import gamma

from suspnet.curves.speeds import NoEstimateError
from suspnet.curves.welch import Welch, segment_spectra
from suspnet.ground.types import BoolArray, ComplexArray, FloatArray

TAPS = np.array([-1.0, 2.0, -1.0]) / np.sqrt(6.0)
"""The c_m, scaled to equal power of noise."""
LEAST_AVERAGES = 5.0
"""Least number of independent segments: three sensors leave two for their noise."""
NOISE_QUANTILE = 0.2
"""Quantile over frequency of what other sensors do not explain of one, which is its noise."""


@dataclass(frozen=True)
class RigSpectra:
    """The signals of a rig's base, frame and body by frequency.

    `taps` (n_freq, 3, 3) are the x_m by m and sensor [m/s2 / sqrt(Hz)], summed over the segments
    with the weights of the module's docstring, and `shares` (n_freq,) their factor, from 0 to 1.
    `noise` (3,) is the density of the sensors' noise [(m/s2)^2/Hz].
    """

    frequencies_hz: FloatArray
    taps: ComplexArray
    shares: FloatArray
    noise: FloatArray
    segment_s: float

    @classmethod
    def of(
        cls,
        signals: FloatArray,
        rate_hz: float,
        segment_s: float,
        band_hz: tuple[float, float],
        usable: BoolArray | None = None,
    ) -> RigSpectra:
        """Return those of signals (3, n), [m/s2]; `usable` (n,): where they have no faults.

        NoEstimateError if there are too few segments without faults.
        """
        # without a window: the taps make that of Hann
        welch = Welch(segment_s, window="boxcar")
        good = torch.as_tensor(np.ones(signals.shape[1], bool) if usable is None else usable)
        n_averages = 0.0
        if signals.shape[1] >= welch.sizes(rate_hz)[0]:
            segments = segment_spectra(torch.as_tensor(signals), rate_hz, welch, usable=good)
            n_averages = Welch(segment_s).n_averages(max(1, len(segments.values)))
        if n_averages < LEAST_AVERAGES:
            needed = Welch(segment_s).minutes(Welch(segment_s).n_segments(LEAST_AVERAGES))
            raise NoEstimateError(
                f"too little of the record is free of faults: at least {60 * needed:.3g} s without "
                "a gap are needed"
            )
        every_hz, values = segments.frequencies_hz.numpy(), segments.values.numpy()
        # bin 0 has lost its mean, which a tap must not meet
        inside = (every_hz >= band_hz[0]) & (every_hz <= band_hz[1])
        bins = np.flatnonzero(inside & (np.arange(len(every_hz)) >= 2))
        bins = bins[bins < len(every_hz) - 1]
        parts = np.stack([values[:, :, bins + m] for m in (-1, 0, 1)]).transpose(3, 0, 2, 1)
        hann = np.einsum("m,fmsk->fsk", TAPS, parts)  # (n_freq, 3, n_segments)
        matrix = hann @ hann.conj().transpose(0, 2, 1) / hann.shape[2]
        noise = _noise(matrix, n_averages)
        _, power, weights = np.linalg.svd(hann / np.sqrt(noise)[:, None], full_matrices=False)
        # as many independent segments as overlapping ones are worth
        scale = np.sqrt(n_averages / hann.shape[2])
        largest = hann.shape[2] * (1 + np.sqrt(3 / n_averages)) ** 2
        above = np.maximum(0.0, 1 - largest / power[:, 0] ** 2)
        taps = np.einsum("fmsk,fk->fms", parts, weights[:, 0].conj())
        return cls(
            every_hz[bins],
            scale * above[:, None, None] * taps,
            above,
            noise,
            segment_s,
        )

    @property
    def powers(self) -> FloatArray:
        """Squares of the signals with Hann's window, (n_freq, 3), n_averages times densities."""
        return np.asarray(np.abs(np.einsum("m,fms->fs", TAPS, self.taps)) ** 2)


def _noise(matrix: ComplexArray, n_averages: float) -> FloatArray:
    """Return the density of each sensor's noise, (3,)."""
    inverse = np.linalg.inv(matrix).diagonal(axis1=1, axis2=2).real
    # noise alone has that quantile: two other sensors explain as much as two averages
    expected = gamma.ppf(NOISE_QUANTILE, n_averages - 2) / n_averages
    return np.asarray(np.quantile(1 / inverse, NOISE_QUANTILE, axis=0) / expected)
