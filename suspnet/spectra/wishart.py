"""Draws of averaged cross spectra: complex Wishart matrices by Bartlett's decomposition.

Goodman, Statistical analysis based on a certain multivariate complex Gaussian distribution, 1963.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.types import FloatArray
from suspnet.spectra.cross_spectra import CrossSpectra


def sample_spectra(mean: CrossSpectra, taps: FloatArray, source: torch.Generator) -> CrossSpectra:
    """Return one draw of averaged spectra for each row of their mean: M M^H / n with M = L T.

    L L^H is the mean, T lower triangular with Gamma(n - i) squares on the diagonal, i = 0, 1, 2,
    and unit complex normals below it.

    Parameters
    ----------
    mean : CrossSpectra
        Of shape (n_rows, 3, n_freq).
    taps : array
        From `moving_average_with`: they set the correlation of neighbouring bins.
    source : torch.Generator
    """
    n = mean.n_averages
    l11 = mean.auto[:, 0].sqrt()
    l21, l31 = (mean.cross[:, k].conj() / l11 for k in (0, 1))
    l22 = (mean.auto[:, 1] - l21.abs().square()).sqrt()
    l32 = (mean.cross[:, 2].conj() - l31 * l21.conj()) / l22
    l33 = (mean.auto[:, 2] - l31.abs().square() - l32.abs().square()).sqrt()
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
    """Return unit normals, correlated along the last axis as `taps` say."""
    wide = torch.empty(
        *shape[:-1], shape[-1] + len(taps) - 1, dtype=torch.float64, device=source.device
    ).normal_(generator=source)
    return sum(  # type: ignore[return-value]
        float(tap) * wide[..., k : k + shape[-1]] for k, tap in enumerate(taps)
    )


def moving_average_with(correlation: FloatArray) -> FloatArray:
    """Return taps h with sum_i h_i h_(i+k) = correlation[k], by spectral factorisation.

    Parameters
    ----------
    correlation : array of shape (n_lags,)
        From lag 0 on; its spectrum must not be negative.

    Returns
    -------
    array of shape (n_lags,)
    """
    roots = np.roots(np.concatenate([correlation[:0:-1], correlation]))
    inside = roots[np.argsort(np.abs(roots))][: len(correlation) - 1]
    taps = np.atleast_1d(np.real(np.poly(inside)))
    return np.asarray(taps * np.sqrt(correlation[0] / (taps @ taps)))


def _gamma(shape: float, normal: Tensor) -> Tensor:
    """Return Gamma(shape, 1) draws from unit normals by Wilson and Hilferty's cube."""
    root = 1 - 1 / (9 * shape) + normal / (3 * math.sqrt(shape))
    return shape * root.clamp(min=0) ** 3
