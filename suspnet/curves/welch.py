"""Welch's method: windowed, overlapping segments, averaged spectra and transfer functions."""

import math
from bisect import bisect_left
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.signal import get_window
from torch import Tensor

from suspnet.curves.cross_spectra import PAIRS, CrossSpectra, Method
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray

NEGLIGIBLE = 1e-4
"""Leakage and correlation between bins below this, relative to the bin itself, are neglected."""
SEGMENTS = 64  # number of segments transformed at once, which limits the memory


@dataclass(frozen=True)
class Welch:
    """How a recording is cut into windowed segments whose spectra are averaged.

    `segment_s` is the length of a segment [s], whose inverse is the spacing of the bins; `overlap`
    the fraction shared by neighbouring segments; `window` one of ``scipy.signal.get_window``.
    """

    segment_s: float = 20.0
    overlap: float = 0.5
    window: str = "hann"

    def __post_init__(self) -> None:
        check_number("segment_s", self.segment_s, above=0, most=1e5)
        check_number("overlap", self.overlap, low=0, below=1)
        get_window(self.window, 8)

    def sizes(self, rate_hz: float) -> tuple[int, int]:
        """Return the number of samples of a segment, and of the step to the next segment."""
        length = round(self.segment_s * rate_hz)
        return length, max(1, length - round(self.overlap * length))

    def n_averages(self, n_segments: float, n_bins: int = 1) -> float:
        """Return the number of independent segments that average as well as overlapping ones.

        The spectra may also be averaged over `n_bins` neighbouring bins. Of n segments and m bins
        it is n m / sum_jk (1 - abs(j)/n) (1 - abs(k)/m) rho_jk, with rho_jk = abs(sum_t w(t)
        w(t + j step) exp(-2 pi i k t / T) / sum w^2)^2, abs(j) < n and abs(k) < m: Welch 1967.
        """
        length, step = self.sizes(256 / self.segment_s)
        window = get_window(self.window, length)
        away = np.arange(1, n_bins)
        turns = np.exp(-2j * np.pi * np.outer(away, np.arange(length)) / length)
        total = 0.0
        for j in range(min(math.ceil(length / step), math.ceil(n_segments))):
            first, second = window[: length - j * step], window[j * step :]
            # of the same bin, then of its neighbours
            shared = float(first @ second) ** 2
            products = np.abs(turns[:, : len(first)] @ (first * second)) ** 2
            shared += 2 * float(products @ (1 - away / n_bins))
            total += (2 if j else 1) * (1 - j / n_segments) * shared / float(window @ window) ** 2
        return n_segments * n_bins / total

    def n_segments(self, n_averages: float, n_bins: int = 1) -> int:
        """Return the least number of segments that average as well as so many independent ones."""
        # the larger their number, the less each adds
        most = math.ceil(n_averages * 1e9 / self.n_averages(1e9, n_bins))
        averages = partial(self.n_averages, n_bins=n_bins)
        return 1 + bisect_left(range(1, most + 1), n_averages, key=averages)

    def minutes(self, n_segments: int) -> float:
        """Return how long overlapping segments are together, [min]."""
        shared = self.overlap * max(0, n_segments - 1)
        return (n_segments - shared) * self.segment_s / 60

    def smear(self, n_bins: int = 1) -> Tensor:
        """Return the weights of the leakage between neighbouring bins, symmetric, with sum 1.

        The expected spectrum is the true one convolved with abs(W(f))^2. Sampling it at the bins is
        exact for an impulse response that is short compared with the segment. Hann: 1/6, 2/3, 1/6.
        The weights of the average of `n_bins` bins, an odd number, are the mean of theirs.
        """
        transform = np.fft.fft(get_window(self.window, 256)) / 256
        power = np.abs(transform) ** 2
        last = int(np.flatnonzero(power[:128] > NEGLIGIBLE * power[0])[-1])
        taps = np.concatenate([power[last:0:-1], power[: last + 1]])
        return torch.as_tensor(np.convolve(taps / taps.sum(), np.full(n_bins, 1 / n_bins)))

    @property
    def correlated_bins(self) -> float:
        """Number of neighbouring bins with the information of one: r = rho_0 + 2 sum_k rho_k.

        rho is the `correlation`; Hann: 1.94.
        """
        rho = _correlation(self.window)
        return float(2 * rho.sum() - rho[0])

    def correlation(self) -> Tensor:
        """Return the correlation of averaged spectra between neighbouring bins, from lag 0.

        abs(sum_t w^2 exp(-2 pi j k t / T) / sum_t w^2)^2; Hann: 1, 4/9, 1/36.
        """
        return torch.tensor(_correlation(self.window))


@cache  # searches ask for it at each step
def _correlation(window: str) -> FloatArray:
    """Return what ``Welch.correlation`` does."""
    transform = np.fft.fft(get_window(window, 256) ** 2)
    rho = np.abs(transform[:128] / transform[0]) ** 2
    return np.asarray(rho[: np.flatnonzero(rho > NEGLIGIBLE)[-1] + 1])


@dataclass(frozen=True)
class SegmentSpectra:
    """Windowed Fourier transforms of a recording's segments, in a band.

    `values` (n_segments, n_channels, n_freq) are scaled such that the mean of abs(values)^2 is the
    one-sided power density; `first` (n_segments,) is the first sample of each segment.
    """

    frequencies_hz: Tensor
    values: Tensor
    first: Tensor
    welch: Welch

    def average(self, chosen: Tensor) -> CrossSpectra:
        """Return the spectra averaged over the chosen segments, a bool tensor (n_segments,).

        Raises ValueError if none is chosen.
        """
        n_segments = int(chosen.sum())
        if n_segments == 0:
            raise ValueError("no segment is chosen: there is nothing to average")
        values = self.values[chosen]
        auto = values.abs().square().mean(dim=0)
        n_channels = values.shape[1]
        pairs = [(x, y) for x, y in PAIRS if y < n_channels]
        cross = torch.stack([(values[:, x].conj() * values[:, y]).mean(dim=0) for x, y in pairs])
        return CrossSpectra(auto, cross, self.welch.n_averages(n_segments))


def segment_spectra(
    signals: Tensor,
    rate_hz: float,
    welch: Welch,
    low_hz: float = 0.0,
    high_hz: float = math.inf,
    usable: Tensor | None = None,
) -> SegmentSpectra:
    """Return the spectra of all segments without an unusable sample, after removing each mean.

    `signals`: (n_channels, n_samples), [m/s^2]; `usable`: bool (n_samples,). Raises ValueError if
    the recording is shorter than a segment.
    """
    length, step = welch.sizes(rate_hz)
    if signals.shape[1] < length:
        raise ValueError(
            f"{signals.shape[1] / rate_hz:.1f} s of recording are shorter than one segment of "
            f"{welch.segment_s:g} s"
        )
    window = torch.as_tensor(get_window(welch.window, length))
    frequencies = torch.arange(length // 2 + 1, dtype=torch.float64) * (rate_hz / length)
    inside = (frequencies >= low_hz - 1e-9) & (frequencies <= high_hz + 1e-9)
    # one-sided densities: all bins but the first and the last stand for two
    scale = torch.full_like(frequencies, math.sqrt(2 / (rate_hz * float(window @ window))))
    scale[0] /= math.sqrt(2)
    if length % 2 == 0:
        scale[-1] /= math.sqrt(2)
    pieces = signals.to(torch.float64).unfold(1, length, step).transpose(0, 1)
    first = torch.arange(len(pieces)) * step
    if usable is not None:
        whole = usable.unfold(0, length, step).all(dim=1)
        pieces, first = pieces[whole], first[whole]
    blocks = [torch.empty(0, len(signals), int(inside.sum()), dtype=torch.complex128)]
    for block in pieces.split(SEGMENTS) if len(pieces) else ():
        windowed = (block - block.mean(dim=-1, keepdim=True)) * window
        blocks.append(torch.fft.rfft(windowed)[..., inside] * scale[inside])
    return SegmentSpectra(frequencies[inside], torch.cat(blocks), first, welch)


@dataclass(frozen=True)
class TransferEstimate:
    """A transfer function and its uncertainty, each tensor of shape (n_freq,).

    `response` is complex, [unit of y / unit of x]; `coherence` is abs(S_xy)^2 / (S_xx S_yy);
    `deviation` the standard deviation of the log-magnitude; `n_averages` counts independent
    averages.
    """

    frequencies_hz: Tensor
    response: Tensor
    coherence: Tensor
    deviation: Tensor
    n_averages: float


def tfestimate(
    x: ArrayLike,
    y: ArrayLike,
    rate_hz: float,
    welch: Welch | None = None,
    method: Method = "H1",
    instrument: ArrayLike | None = None,
) -> TransferEstimate:
    """Return the transfer function from x to y by Welch's method.

    `x` and `y` are input and output (n_samples,) at `rate_hz`, `instrument` the third sensor of the
    method IV. ValueError if the signals differ in length, hold NaN, are constant or shorter than a
    segment.

    Examples
    --------
    >>> x = np.random.default_rng(0).normal(size=4000)
    >>> estimate = tfestimate(x, 2 * x, rate_hz=100.0, welch=Welch(segment_s=2.0))
    >>> round(float(estimate.response[10].real), 6), round(float(estimate.coherence[10]), 6)
    (2.0, 1.0)
    """
    arrays = [np.asarray(a, dtype=np.float64) for a in (x, y, instrument) if a is not None]
    names = [n for n, a in (("x", x), ("y", y), ("instrument", instrument)) if a is not None]
    for name, array in zip(names, arrays, strict=True):
        if array.ndim != 1 or array.shape != arrays[0].shape:
            raise ValueError(f"`{name}` must have shape {arrays[0].shape}, got {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"`{name}` holds {int((~np.isfinite(array)).sum())} NaN or inf")
        if np.ptp(array) == 0:
            raise ValueError(f"`{name}` is constant: nothing can be estimated from it")
    segments = segment_spectra(torch.as_tensor(np.stack(arrays)), rate_hz, welch or Welch())
    spectra = segments.average(torch.ones(len(segments.values), dtype=torch.bool))
    third = 2 if instrument is not None else None
    response = spectra.transfer(0, 1, method, third)
    deviation = spectra.deviation(0, 1, method, third)
    parts = response, spectra.coherence(0, 1), deviation, spectra.n_averages
    return TransferEstimate(segments.frequencies_hz, *parts)
