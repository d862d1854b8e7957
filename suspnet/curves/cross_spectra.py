"""Transfer functions from spectra: H1, H2, Hv and the instrumental-variable estimate IV.

Cross spectra are S_xy = E[conj(X) Y], as in scipy. With x the input, y the output::

    H1 = S_xy / S_xx               unbiased if only the output is noisy (tfestimate)
    H2 = S_yy / S_yx               unbiased if only the input is noisy
    Hv = sqrt(S_yy / S_xx) S_xy / abs(S_xy)     total least squares, both equally noisy
    IV = S_zy / S_zx               z a third sensor, whose noise is independent of the others'

On a train the axle box's signal lies almost all above 20 Hz, so its noise biases H1 below. With
three sensors each response has an instrument: the body's for the primary suspension, the axle box's
for the secondary (Söderström and Stoica, Instrumental Variable Methods for System Identification).
"""

import math
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.settings import check_choice
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr

METHODS = ("H1", "H2", "Hv", "IV")
Method = Literal["H1", "H2", "Hv", "IV"]
PAIRS = ((0, 1), (0, 2), (1, 2))  # channels of each column of `CrossSpectra.cross`
CHAIN = ((0, 1, 2), (1, 2, 0))  # input, output and instrument of G_p and G_s
SMOOTHED_BINS = 5  # number of neighbouring bins over which a trip's measured covariance is averaged


@dataclass(frozen=True, repr=False)
class CrossSpectra(ShortRepr):
    """Averaged auto and cross spectra of axle box, bogie and body.

    `auto` is real, (..., 3, n_freq), [(m/s^2)^2/Hz]. `cross` is complex, of the same shape, for the
    pairs of ``PAIRS``. `n_averages` counts independent averages.
    """

    auto: Tensor
    cross: Tensor
    n_averages: float

    def at(self, bins: Tensor) -> Self:
        """Return the spectra on chosen bins, a bool tensor (n_freq,)."""
        return replace(self, auto=self.auto[..., bins], cross=self.cross[..., bins])

    def between(self, x: int, y: int) -> Tensor:
        """Return S_xy, shape (..., n_freq)."""
        if x == y:
            return self.auto[..., x, :].to(self.cross.dtype)
        spectrum = self.cross[..., PAIRS.index((min(x, y), max(x, y))), :]
        return spectrum if x < y else spectrum.conj()

    def transfer(self, x: int, y: int, method: Method, instrument: int | None = None) -> Tensor:
        """Return the response from channel x to y, complex, (..., n_freq)."""
        check_choice("method", method, METHODS)
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

        With e = y - G x and instrument z (x for H1, y for H2) the complex estimate has the relative
        variance S_zz S_ee / (n abs(S_zy)^2), half of it along the magnitude. For H1 that is (1 -
        coherence) / (2 n coherence), as in Bendat and Piersol; for Hv without the coherence in the
        denominator.
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
        """Return G_p and G_s, complex (..., 2, n_freq); the third channel is the instrument."""
        return torch.stack([self.transfer(x, y, method, z) for x, y, z in CHAIN], dim=-2)

    def coherences(self) -> Tensor:
        """Return the coherence of each link, shape (..., 2, n_freq)."""
        return torch.stack([self.coherence(x, y) for x, y, _ in CHAIN], dim=-2)

    def deviations(self, method: Method) -> Tensor:
        """Return the standard deviation of the log-magnitude of G_p, G_s, (..., 2, n_freq)."""
        return torch.stack([self.deviation(x, y, method, z) for x, y, z in CHAIN], dim=-2)

    def instrument_strength(self, method: Method) -> Tensor:
        """Return the F statistic of each instrument z for its input x, (..., 2, n_freq).

        F = (n - 1) c / (1 - c) with their coherence c, infinite where z is x. With a weak
        instrument the response is a ratio of noise, and its measured covariance too small.
        """
        pairs = zip(_instruments(method), CHAIN, strict=True)
        coherences = [self.coherence(z, x) for z, (x, *_) in pairs]
        coherence = torch.stack(coherences, dim=-2).clamp(max=1)
        return (self.n_averages - 1) * coherence / (1 - coherence)

    def covariance(self, method: Method) -> Tensor:
        """Return the covariance of (log G_p, log G_s), complex Hermitian (..., 2, 2, n_freq).

        With e_i = y_i - G_i x_i and instruments z_i: S_zi_zj S_ej_ei / (n S_zi_yi conj(S_zj_yj)),
        from the fourth moments of normal variables. Hv is treated as H1.
        """
        residual, scale = self.covariance_parts(method)
        return residual / scale

    def covariance_parts(self, method: Method) -> tuple[Tensor, Tensor]:
        """Return numerator (over n) and denominator of `covariance`, each (..., 2, 2, n_freq).

        The numerator, the covariance of S_zi_yi - G_i S_zi_xi, varies slowly over the bins.
        """
        kind: Method = "H1" if method == "Hv" else method
        responses = self.responses(kind)
        chosen = _instruments(method)
        rows, scales = [], []
        for i, (x_i, y_i, _) in enumerate(CHAIN):
            row, scale = [], []
            for j, (x_j, y_j, _) in enumerate(CHAIN):
                g_i, g_j = responses[..., i, :], responses[..., j, :].conj()
                residual = (
                    self.between(y_j, y_i)
                    - g_i * self.between(y_j, x_i)
                    - g_j * self.between(x_j, y_i)
                    + g_i * g_j * self.between(x_j, x_i)
                )
                scale.append(self.between(chosen[i], y_i) * self.between(chosen[j], y_j).conj())
                row.append(self.between(chosen[i], chosen[j]) * residual / self.n_averages)
            rows.append(torch.stack(row, dim=-2))
            scales.append(torch.stack(scale, dim=-2))
        return torch.stack(rows, dim=-3), torch.stack(scales, dim=-3)

    def measured_covariance(self, method: Method, correlation: Tensor) -> Tensor:
        """Return the covariance estimated from one trip's spectra (3, n_freq), (2, 2, n_freq).

        Its numerators are smoothed over bins; `correlation` is that between bins, from lag 0.
        """
        residual, scale = self.covariance_parts(method)
        covariance = _smoothed(residual) / scale
        # the inverse of a measured covariance, 2 x 2 from n averages, is too large by n / (n - 2)
        n = self.n_averages * _independent(correlation)
        return covariance * n / (n - 2)


def _instruments(method: Method) -> list[int]:
    """Return the channel that each response of ``CHAIN`` is estimated with, Hv as H1."""
    return [{"H1": x, "H2": y, "Hv": x, "IV": z}[method] for x, y, z in CHAIN]


def _smoothed(covariance: Tensor) -> Tensor:
    """Return the moving average over bins of a covariance (2, 2, n_freq)."""
    half = SMOOTHED_BINS // 2
    ends = [covariance[..., :1].expand(2, 2, half), covariance[..., -1:].expand(2, 2, half)]
    return torch.cat([ends[0], covariance, ends[1]], dim=-1).unfold(-1, SMOOTHED_BINS, 1).mean(-1)


def _independent(correlation: Tensor) -> float:
    """Return the effective number of independent bins among those that are averaged."""
    lags = torch.arange(len(correlation))
    pairs = (SMOOTHED_BINS - lags).clamp(min=0) * torch.where(lags == 0, 1, 2)
    return SMOOTHED_BINS**2 / float(pairs.to(correlation) @ correlation)


def sample_spectra(mean: CrossSpectra, taps: FloatArray, source: torch.Generator) -> CrossSpectra:
    """Return one draw of averaged spectra for each row of their mean: M M^H / n with M = L T.

    L L^H is the mean, T lower triangular with Gamma(n - i) squares on the diagonal, i = 0, 1, 2,
    and unit complex normals below it. `mean` has shape (n_rows, 3, n_freq); `taps` from
    `moving_average_with` set the correlation of neighbouring bins.
    """
    # L, the Cholesky factor of the mean
    n = mean.n_averages
    l11 = mean.auto[:, 0].sqrt()
    l21, l31 = (mean.cross[:, k].conj() / l11 for k in (0, 1))
    l22 = (mean.auto[:, 1] - l21.abs().square()).sqrt()
    l32 = (mean.cross[:, 2].conj() - l31 * l21.conj()) / l22
    l33 = (mean.auto[:, 2] - l31.abs().square() - l32.abs().square()).sqrt()
    # T, the Bartlett factor of a unit Wishart matrix, then M = L T and M M^H / n
    g = _normals((9, *l11.shape), taps, source)
    t11, t22, t33 = (_gamma(n - i, g[i]).sqrt() for i in range(3))
    t21, t31, t32 = (torch.complex(g[i], g[i + 1]) / math.sqrt(2) for i in (3, 5, 7))
    m11, m21, m22 = l11 * t11, l21 * t11 + l22 * t21, l22 * t22
    m31, m32, m33 = l31 * t11 + l32 * t21 + l33 * t31, l32 * t22 + l33 * t32, l33 * t33
    auto = [m11.square(), m21.abs().square() + m22.square()]
    auto.append(m31.abs().square() + m32.abs().square() + m33.square())
    cross = [m11 * m21.conj(), m11 * m31.conj(), m21 * m31.conj() + m22 * m32.conj()]
    return CrossSpectra(torch.stack(auto, 1) / n, torch.stack(cross, 1) / n, n)


def _normals(shape: tuple[int, ...], taps: FloatArray, source: torch.Generator) -> Tensor:
    """Return unit normals, correlated along the last axis by the moving average `taps`."""
    wide = torch.empty(
        *shape[:-1], shape[-1] + len(taps) - 1, dtype=torch.float64, device=source.device
    ).normal_(generator=source)
    return sum(  # type: ignore[return-value]
        float(tap) * wide[..., k : k + shape[-1]] for k, tap in enumerate(taps)
    )


def moving_average_with(correlation: FloatArray) -> FloatArray:
    """Return taps h with sum_i h_i h_(i+k) = correlation[k], by spectral factorisation.

    `correlation` (n_lags,) starts at lag 0; its spectrum must not be negative. h has the same
    shape.
    """
    roots = np.roots(np.concatenate([correlation[:0:-1], correlation]))
    inside = roots[np.argsort(np.abs(roots))][: len(correlation) - 1]
    taps = np.atleast_1d(np.real(np.poly(inside)))
    return np.asarray(taps * np.sqrt(correlation[0] / (taps @ taps)))


def _gamma(shape: float, normal: Tensor) -> Tensor:
    """Return Gamma(shape, 1) draws from unit normals, by the Wilson-Hilferty cube approximation."""
    root = 1 - 1 / (9 * shape) + normal / (3 * math.sqrt(shape))
    return shape * root.clamp(min=0) ** 3
