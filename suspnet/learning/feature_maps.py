"""Finite feature maps phi with phi(x) . phi(z) close to the RBF kernel exp(-|x - z|^2 / sigma^2).

What a map is, and random Fourier features. Maps from landmarks are in ``landmarks``, that on a
regular grid of frequencies in ``equispaced``; ``maps.MAPS`` lists them all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Protocol

import torch
from torch import Tensor


class FeatureMap(Protocol):
    """Maps samples (n_samples, n_inputs) to features (n_samples, n_features)."""

    @property
    def n_inputs(self) -> int:
        """Number of columns the map takes."""
        ...

    def __call__(self, X: Tensor) -> Tensor:
        """Return the features of `X`."""
        ...

    def apply(self, X: Tensor, coef: Tensor) -> Tensor:
        """Return the features of `X` times coef (n_features, n_outputs)."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """Return what the map consists of, by name."""
        ...


class TensorMap:
    """Base of every feature map: a dataclass of tensors that can be called."""

    def apply(self, X: Tensor, coef: Tensor) -> Tensor:
        """Return Phi coef, shape (n_samples, n_outputs)."""
        product: Tensor = self(X) @ coef  # type: ignore[operator]
        return product

    def tensors(self) -> dict[str, Tensor]:
        """Return what the map consists of, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]


@dataclass(frozen=True)
class FourierFeatures(TensorMap):
    """phi(x) = sqrt(2 / D) (cos(x . w_1), ..., sin(x . w_1), ...) for D / 2 frequencies w_j.

    Squared norm 1 and exact shift invariance for any draw (Rahimi and Recht, 2007).

    Attributes
    ----------
    random_weights : tensor of shape (n_inputs, D / 2)
    """

    random_weights: Tensor

    @property
    def n_inputs(self) -> int:
        """Number of columns the map takes."""
        return self.random_weights.shape[0]

    def __call__(self, X: Tensor) -> Tensor:
        """Return features of shape (n_samples, D)."""
        n_pairs = self.random_weights.shape[1]
        features = X.new_empty(len(X), 2 * n_pairs)
        angles = X @ self.random_weights
        torch.cos(angles, out=features[:, :n_pairs])
        torch.sin(angles, out=features[:, n_pairs:])
        return features.mul_(math.sqrt(1 / n_pairs))


def random_fourier(
    X: Tensor, sigma: float, n_components: int, seed: int, kernel_tol: float = 0.0
) -> FourierFeatures:
    """Draw random Fourier features: w_j ~ N(0, 2 / sigma^2 I); `kernel_tol` is not used."""
    draws = torch.randn(X.shape[1], _pairs(n_components), generator=generator(seed))
    return FourierFeatures((draws.double() * math.sqrt(2) / sigma).to(X))


def orthogonal_fourier(
    X: Tensor, sigma: float, n_components: int, seed: int, kernel_tol: float = 0.0
) -> FourierFeatures:
    """Draw orthogonal random features: blocks of orthogonal directions (Yu et al., 2016).

    Each direction is uniform on the sphere and its length that of a Gaussian vector, so every
    single w_j is still N(0, 2 / sigma^2 I). `kernel_tol` is not used.
    """
    n_inputs, source, blocks = X.shape[1], generator(seed), []
    for _ in range(-(-_pairs(n_components) // n_inputs)):
        gaussian = torch.randn(n_inputs, n_inputs, generator=source, dtype=torch.float64)
        q, r = torch.linalg.qr(gaussian)
        lengths = torch.randn(n_inputs, n_inputs, generator=source, dtype=torch.float64).norm(dim=0)
        blocks.append(q * r.diagonal().sign() * lengths)
    draws = torch.cat(blocks, dim=1)[:, : _pairs(n_components)]
    return FourierFeatures((draws * math.sqrt(2) / sigma).to(X).contiguous())


def _pairs(n_components: int) -> int:
    """Return the number of cosine and sine pairs, an odd number of components rounded up."""
    return (n_components + 1) // 2


def generator(seed: int) -> torch.Generator:
    """Return a generator of its own for a seed, on the CPU."""
    return torch.Generator().manual_seed(seed)
