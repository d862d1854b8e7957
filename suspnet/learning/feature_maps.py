"""Finite feature maps phi with phi(x) . phi(z) close to the RBF kernel exp(-|x - z|^2 / sigma^2).

A map is made from data by a function of ``FEATURE_MAPS`` and holds its arrays as tensors; to add
one, write such a function and enter it there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any, Protocol

import torch
from torch import Tensor

CACHE_BYTES = 400_000_000
"""Features of a whole training set are kept in memory up to this size, else made again."""


class FeatureMap(Protocol):
    """Maps samples (n_samples, n_inputs) to features (n_samples, n_features)."""

    @property
    def n_inputs(self) -> int:
        """Number of columns the map takes."""
        ...

    def __call__(self, X: Tensor) -> Tensor:
        """Return the features of `X`."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """Return what the map consists of, by name."""
        ...


class _TensorMap:
    def tensors(self) -> dict[str, Tensor]:
        """Return what the map consists of, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]


@dataclass(frozen=True)
class FourierFeatures(_TensorMap):
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


@dataclass(frozen=True)
class LandmarkFeatures(_TensorMap):
    """phi(x) = V k(Z, x) with V^T V the inverse of k(Z, Z) on landmarks Z (Nystroem).

    Attributes
    ----------
    landmarks : tensor of shape (n_landmarks, n_inputs)
    whitening : tensor of shape (n_landmarks, n_features)
    sigma : tensor of shape ()
    """

    landmarks: Tensor
    whitening: Tensor
    sigma: Tensor

    @property
    def n_inputs(self) -> int:
        """Number of columns the map takes."""
        return self.landmarks.shape[1]

    def __call__(self, X: Tensor) -> Tensor:
        """Return features of shape (n_samples, n_features)."""
        return rbf_kernel(X, self.landmarks, float(self.sigma)) @ self.whitening


def rbf_kernel(X: Tensor, Z: Tensor, sigma: float) -> Tensor:
    """Return exp(-|x_i - z_j|^2 / sigma^2), shape (n_samples, n_landmarks)."""
    squared = (X * X).sum(1, keepdim=True) + (Z * Z).sum(1) - 2 * X @ Z.T
    return squared.clamp_(min=0).mul_(-1 / sigma**2).exp_()


def random_fourier(X: Tensor, sigma: float, n_components: int, seed: int) -> FourierFeatures:
    """Draw plain random Fourier features: w_j ~ N(0, 2 / sigma^2 I)."""
    draws = torch.randn(X.shape[1], _pairs(n_components), generator=_generator(seed))
    return FourierFeatures((draws.double() * math.sqrt(2) / sigma).to(X))


def orthogonal_fourier(X: Tensor, sigma: float, n_components: int, seed: int) -> FourierFeatures:
    """Draw orthogonal random features: blocks of orthogonal directions (Yu et al., 2016).

    Each direction is uniform on the sphere and its length that of a Gaussian vector, so every
    single w_j is still N(0, 2 / sigma^2 I).
    """
    n_inputs, source, blocks = X.shape[1], _generator(seed), []
    for _ in range(-(-_pairs(n_components) // n_inputs)):
        gaussian = torch.randn(n_inputs, n_inputs, generator=source, dtype=torch.float64)
        q, r = torch.linalg.qr(gaussian)
        lengths = torch.randn(n_inputs, n_inputs, generator=source, dtype=torch.float64).norm(dim=0)
        blocks.append(q * r.diagonal().sign() * lengths)
    draws = torch.cat(blocks, dim=1)[:, : _pairs(n_components)]
    return FourierFeatures((draws * math.sqrt(2) / sigma).to(X).contiguous())


def nystroem(X: Tensor, sigma: float, n_components: int, seed: int) -> LandmarkFeatures:
    """Choose landmarks by randomly pivoted Cholesky (Chen et al., 2023) and whiten.

    At most `n_components` landmarks; fewer when the kernel's residual vanishes before.
    """
    pivots = pivoted_cholesky(X.double(), sigma, min(n_components, len(X)), seed)
    return _landmarks(X, X[pivots], sigma)


def exact(X: Tensor, sigma: float, n_components: int, seed: int) -> LandmarkFeatures:
    """Take every sample as a landmark: the exact kernel on the training data; for small n.

    `n_components` and `seed` are not used. Kernel directions below rounding are dropped.
    """
    return _landmarks(X, X, sigma)


def pivoted_cholesky(X: Tensor, sigma: float, n_pivots: int, seed: int) -> Tensor:
    """Return row indices drawn in proportion to the kernel's remaining diagonal, one at a time."""
    source = _generator(seed)
    residual = torch.ones(len(X), dtype=X.dtype, device=X.device)
    factor = X.new_zeros(n_pivots, len(X))
    pivots: list[int] = []
    for k in range(n_pivots):
        if float(residual.max()) <= 1e-12:
            break
        pivot = int(torch.multinomial(residual.cpu(), 1, generator=source))
        column = rbf_kernel(X[pivot : pivot + 1], X, sigma)[0] - factor[:k, pivot] @ factor[:k]
        factor[k] = column / column[pivot].sqrt()
        residual = (residual - factor[k].square()).clamp_(min=0)
        residual[pivot] = 0
        pivots.append(pivot)
    return torch.tensor(pivots, device=X.device)


FEATURE_MAPS: dict[str, Callable[[Tensor, float, int, int], Any]] = {
    "rff": random_fourier,
    "orf": orthogonal_fourier,
    "nystroem": nystroem,
    "exact": exact,
}
MAP_TYPES: dict[str, type[Any]] = {
    "rff": FourierFeatures,
    "orf": FourierFeatures,
    "nystroem": LandmarkFeatures,
    "exact": LandmarkFeatures,
}


@dataclass
class FeatureBlocks:
    """The feature matrix Phi of a training set, one block of rows at a time.

    Parameters
    ----------
    feature_map : FeatureMap
    X : tensor of shape (n_samples, n_inputs)
    block_rows : int
        Rows of Phi in memory at once, unless all of it fits ``CACHE_BYTES``.
    """

    feature_map: FeatureMap
    X: Tensor
    block_rows: int = 8192

    def __post_init__(self) -> None:
        self.slices = [
            slice(start, min(start + self.block_rows, len(self.X)))
            for start in range(0, len(self.X), self.block_rows)
        ]
        first = self.feature_map(self.X[:1])
        self.n_features = first.shape[1]
        whole = len(self.X) * self.n_features * first.element_size()
        self._kept = (
            [self.feature_map(self.X[s]) for s in self.slices] if whole <= CACHE_BYTES else []
        )

    def __iter__(self) -> Iterator[tuple[slice, Tensor]]:
        """Yield (rows, Phi[rows])."""
        if self._kept:
            yield from zip(self.slices, self._kept, strict=True)
        else:
            for rows in self.slices:
                yield rows, self.feature_map(self.X[rows])


def _landmarks(X: Tensor, landmarks: Tensor, sigma: float) -> LandmarkFeatures:
    exact_landmarks = landmarks.double()
    values, vectors = torch.linalg.eigh(rbf_kernel(exact_landmarks, exact_landmarks, sigma))
    kept = values > values[-1] * len(values) * torch.finfo(values.dtype).eps
    whitening = vectors[:, kept] / values[kept].sqrt()
    width = torch.tensor(float(sigma), dtype=X.dtype, device=X.device)
    return LandmarkFeatures(landmarks, whitening.to(X).contiguous(), width)


def _pairs(n_components: int) -> int:
    return (n_components + 1) // 2


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
