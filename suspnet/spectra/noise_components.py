"""Principal components of rows of numbers, whitened by the noise of each column."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

ROUNDING = 1e-12
"""Noise below this means that all rows are equal in the column: no information."""


@dataclass(frozen=True)
class NoiseComponents:
    """Principal components of rows v, whitened by their noise: B ((v - mean) / noise).

    `mean`, `noise` (n_columns,); `directions` (n_components, n_columns) is B; `explained`
    (n_components,) are fractions of the noise-free variance.
    """

    mean: Tensor
    noise: Tensor
    directions: Tensor
    explained: Tensor

    def __call__(self, rows: Tensor) -> Tensor:
        """Return the components of rows (n_rows, n_columns), (n_rows, n_components)."""
        return ((rows - self.mean) / self.noise) @ self.directions.T


def noise_components(
    clean: Tensor, noisy: Tensor, count: int | None, explained: float = 1.0
) -> NoiseComponents:
    """Return the leading components of rows (n_rows, n_columns) without and with noise.

    `count` None: as many as keep the fraction `explained` of the noise-free variance. ValueError if
    there are fewer rows or columns than components.
    """
    noise = (noisy - clean).square().mean(dim=0).sqrt()
    noise = noise.where(noise > ROUNDING, 1.0)  # avoids division by 0: no information there
    mean = clean.mean(dim=0)
    power, directions = _principal((clean - mean) / noise)
    n_possible = min(len(clean) - 1, clean.shape[1])
    directions = directions[:n_possible]
    share = power[:n_possible].clamp(min=0.0) / power.sum()
    if count is None:
        count = int((share.cumsum(dim=0) < explained).sum()) + 1
    if count > len(directions):
        raise ValueError(
            f"{count} components were asked for, {len(clean)} curves of {clean.shape[1]} numbers "
            f"have {len(directions)}"
        )
    leading = directions[:count].contiguous()  # memory layout as restored: equal bit for bit
    return NoiseComponents(mean, noise, leading, share[:count])


def _principal(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the variances along principal axes, largest first, and these as rows.

    The eigenvectors of the smaller Gram matrix, that of columns or that of rows, are several times
    quicker than singular vectors.
    """
    n_rows, n_columns = rows.shape
    if n_rows >= n_columns:
        power, vectors = torch.linalg.eigh(torch.cov(rows.T))
        return power.flip(0), vectors.T.flip(0)
    power, vectors = torch.linalg.eigh(rows @ rows.T / (n_rows - 1))
    # weak axes still hold some of the strong ones, by rounding: the QR factors remove that
    axes, _ = torch.linalg.qr(rows.T @ vectors.flip(1))
    return power.flip(0), axes.T
