"""Transfer functions from recordings: Welch's spectra, H1, H2, Hv and the instrument estimate IV.

Cross spectra are S_xy = E[conj(X) Y], as in scipy. With x the input, y the output::

    H1 = S_xy / S_xx               unbiased if only the output is noisy (tfestimate)
    H2 = S_yy / S_yx               unbiased if only the input is noisy
    Hv = sqrt(S_yy / S_xx) S_xy / abs(S_xy)     total least squares, both equally noisy
    IV = S_zy / S_zx               z a third sensor, whose noise is independent of the others'

On a train the axle box's signal lies almost all above 20 Hz: its noise biases H1. With three
sensors each response has an instrument: the body's for the primary suspension, the axle box's for
the secondary (Söderström and Stoica, Instrumental Variable Methods for System Identification).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.signal import get_window
from torch import Tensor

FloatArray = NDArray[np.float64]
METHODS = ("H1", "H2", "Hv", "IV")
Method = Literal["H1", "H2", "Hv", "IV"]
PAIRS = ((0, 1), (0, 2), (1, 2))
"""The channels of each column of `CrossSpectra.cross`."""
CHAIN = ((0, 1, 2), (1, 2, 0))
"""Input, output and instrument of G_p and of G_s."""
SEGMENTS = 64
"""Segments transformed at once, to bound memory."""
NEGLIGIBLE = 1e-4
"""Window effects on further bins, relative to the first, that are left out."""


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
        for name in ("segment_s", "overlap"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise TypeError(f"`{name}` must be a number, got {value!r}")
        if not 0 < self.segment_s < math.inf:
            raise ValueError(f"`segment_s` must be > 0, got {self.segment_s}")
        if not 0 <= self.overlap < 1:
            raise ValueError(f"`overlap` must lie in 0 <= overlap < 1, got {self.overlap}")
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

    def correlation(self) -> Tensor:
        """Return the correlation of averaged spectra between a bin and its next ones, from lag 0.

        abs(sum_t w^2 exp(-2 pi j k t / T) / sum_t w^2)^2; Hann: 1, 4/9, 1/36.
        """
        transform = np.fft.fft(get_window(self.window, 256) ** 2)
        rho = np.abs(transform[:128] / transform[0]) ** 2
        return torch.as_tensor(rho[: np.flatnonzero(rho > NEGLIGIBLE)[-1] + 1])


@dataclass(frozen=True)
class CrossSpectra:
    """Averaged auto and cross spectra of axle box, bogie and body.

    Attributes
    ----------
    auto : real tensor of shape (..., 3, n_freq), [(m/s^2)^2/Hz]
    cross : complex tensor of shape (..., 3, n_freq)
        The pairs of ``PAIRS``: axle box - bogie, axle box - body, bogie - body.
    n_averages : float
        Independent averages behind them.
    """

    auto: Tensor
    cross: Tensor
    n_averages: float

    def at(self, bins: Tensor) -> CrossSpectra:
        """Return the spectra on chosen bins, a bool tensor (n_freq,)."""
        return CrossSpectra(self.auto[..., bins], self.cross[..., bins], self.n_averages)

    def between(self, x: int, y: int) -> Tensor:
        """Return S_xy, shape (..., n_freq)."""
        if x == y:
            return self.auto[..., x, :].to(self.cross.dtype)
        spectrum = self.cross[..., PAIRS.index((min(x, y), max(x, y))), :]
        return spectrum if x < y else spectrum.conj()

    def transfer(self, x: int, y: int, method: Method, instrument: int | None = None) -> Tensor:
        """Return the response from channel x to y, complex, shape (..., n_freq).

        Raises
        ------
        ValueError
            If the method is unknown, or IV has no instrument.
        """
        if method not in METHODS:
            raise ValueError(f"`method` must be one of {METHODS}, got {method!r}")
        if method == "Hv":
            cross = self.between(x, y)
            return (self.auto[..., y, :] / self.auto[..., x, :]).sqrt() * cross / cross.abs()
        z = {"H1": x, "H2": y, "IV": instrument}[method]
        if z is None:
            raise ValueError("method 'IV' needs a third channel as its instrument")
        return self.between(z, y) / self.between(z, x)

    def coherence(self, x: int, y: int) -> Tensor:
        """Return abs(S_xy)^2 / (S_xx S_yy), shape (..., n_freq)."""
        power = self.auto[..., x, :] * self.auto[..., y, :]
        return self.between(x, y).abs().square() / power

    def deviation(self, x: int, y: int, method: Method, instrument: int | None = None) -> Tensor:
        """Return the standard deviation of the log-magnitude of a response, (..., n_freq), [-].

        With e = y - G x and instrument z (x for H1, y for H2) the complex estimate has the
        relative variance S_zz S_ee / (n abs(S_zy)^2), half of it along the magnitude. For H1 that
        is (1 - coherence) / (2 n coherence), as in Bendat and Piersol; for Hv the coherence in the
        denominator is missing.
        """
        if method == "Hv":
            return ((1 - self.coherence(x, y)).clamp(min=0) / (2 * self.n_averages)).sqrt()
        response = self.transfer(x, y, method, instrument)
        z = {"H1": x, "H2": y}.get(method, instrument)
        assert z is not None
        residual = (
            self.auto[..., y, :]
            - 2 * (response * self.between(x, y).conj()).real
            + response.abs().square() * self.auto[..., x, :]
        )
        relative = self.auto[..., z, :] * residual / self.between(z, y).abs().square()
        return (relative.clamp(min=0) / (2 * self.n_averages)).sqrt()

    def responses(self, method: Method) -> Tensor:
        """Return G_p and G_s, complex, shape (..., 2, n_freq); each has the third as instrument."""
        return torch.stack([self.transfer(x, y, method, z) for x, y, z in CHAIN], dim=-2)

    def coherences(self) -> Tensor:
        """Return the coherence of each link, shape (..., 2, n_freq)."""
        return torch.stack([self.coherence(x, y) for x, y, _ in CHAIN], dim=-2)

    def deviations(self, method: Method) -> Tensor:
        """Return the standard deviation of the log-magnitude of G_p, G_s, (..., 2, n_freq)."""
        return torch.stack([self.deviation(x, y, method, z) for x, y, z in CHAIN], dim=-2)

    def covariance(self, method: Method) -> Tensor:
        """Return the covariance of (log G_p, log G_s), complex Hermitian (..., 2, 2, n_freq).

        With e_i = y_i - G_i x_i and instruments z_i: S_zi_zj S_ej_ei / (n S_zi_yi conj(S_zj_yj)),
        the expectation of four normal variables. Hv is taken as H1.
        """
        kind: Method = "H1" if method == "Hv" else method
        responses = self.responses(kind)
        chosen = [{"H1": x, "H2": y, "IV": z}[kind] for x, y, z in CHAIN]
        rows = []
        for i, (x_i, y_i, _) in enumerate(CHAIN):
            row = []
            for j, (x_j, y_j, _) in enumerate(CHAIN):
                g_i, g_j = responses[..., i, :], responses[..., j, :].conj()
                residual = (
                    self.between(y_j, y_i)
                    - g_i * self.between(y_j, x_i)
                    - g_j * self.between(x_j, y_i)
                    + g_i * g_j * self.between(x_j, x_i)
                )
                scale = self.between(chosen[i], y_i) * self.between(chosen[j], y_j).conj()
                shared = self.between(chosen[i], chosen[j])
                row.append(shared * residual / (self.n_averages * scale))
            rows.append(torch.stack(row, dim=-2))
        return torch.stack(rows, dim=-3)


@dataclass(frozen=True)
class SegmentSpectra:
    """Windowed Fourier transforms of a recording's segments, in a band.

    Attributes
    ----------
    frequencies_hz : tensor of shape (n_freq,), [Hz]
    values : complex tensor of shape (n_segments, n_channels, n_freq)
        Scaled such that the mean of abs(values)^2 is the one-sided power density.
    first : int64 tensor of shape (n_segments,)
        First sample of each segment.
    welch : Welch
    """

    frequencies_hz: Tensor
    values: Tensor
    first: Tensor
    welch: Welch

    def average(self, chosen: Tensor) -> CrossSpectra:
        """Return the spectra averaged over chosen segments, a bool tensor (n_segments,).

        Raises
        ------
        ValueError
            If none is chosen.
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
    """Return the spectra of all segments without an unusable sample, the mean of each removed.

    Parameters
    ----------
    signals : tensor of shape (n_channels, n_samples), [m/s^2]
    rate_hz : float, [Hz]
    welch : Welch
    low_hz, high_hz : float, [Hz]
        Band that is kept.
    usable : bool tensor of shape (n_samples,), optional
        Segments with a sample that is not usable are left out.

    Raises
    ------
    ValueError
        If the recording is shorter than a segment.
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
    """A transfer function and how well it is known.

    Attributes
    ----------
    frequencies_hz : tensor of shape (n_freq,), [Hz]
    response : complex tensor of shape (n_freq,), [unit of y / unit of x]
    coherence : tensor of shape (n_freq,), [-]
        abs(S_xy)^2 / (S_xx S_yy).
    deviation : tensor of shape (n_freq,), [-]
        Standard deviation of the log-magnitude.
    n_averages : float
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
    normalise: bool = False,
) -> TransferEstimate:
    """Return the transfer function from x to y by Welch's method.

    Parameters
    ----------
    x, y : arrays of shape (n_samples,)
        Input and output.
    rate_hz : float, [Hz]
    welch : Welch, optional
    method : {"H1", "H2", "Hv", "IV"}
    instrument : array of shape (n_samples,), optional
        The third sensor of IV.
    normalise : bool
        Divide each signal by its own standard deviation first, as the paper does; the scale is
        restored afterwards, so that the gain stays the physical one.

    Raises
    ------
    ValueError
        If the signals differ in length, hold NaN, are constant or shorter than a segment.

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
    scales = [array.std() if normalise else 1.0 for array in arrays]
    signals = torch.as_tensor(np.stack([a / s for a, s in zip(arrays, scales, strict=True)]))
    segments = segment_spectra(signals, rate_hz, welch or Welch())
    spectra = segments.average(torch.ones(len(segments.values), dtype=torch.bool))
    third = 2 if instrument is not None else None
    response = spectra.transfer(0, 1, method, third) * (scales[1] / scales[0])
    return TransferEstimate(
        segments.frequencies_hz,
        response,
        spectra.coherence(0, 1),
        spectra.deviation(0, 1, method, third),
        spectra.n_averages,
    )


def _symmetric(power: FloatArray) -> Tensor:
    """Return power[-k] ... power[k] with sum 1, k the last that is not negligible."""
    half = len(power) // 2
    k = int(np.flatnonzero(power[:half] > NEGLIGIBLE * power[0])[-1])
    taps = np.concatenate([power[k:0:-1], power[: k + 1]])
    return torch.as_tensor(taps / taps.sum())
