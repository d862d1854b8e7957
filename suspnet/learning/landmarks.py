"""Feature maps from landmarks: Nystroem, and the exact kernel with every sample as a landmark."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from suspnet.learning.feature_maps import TensorMap, generator

CANDIDATES = 16_384
"""Landmarks are chosen among at most this many samples, drawn at random."""
PROPOSALS = 64
"""Pivots proposed at a time."""


@dataclass(frozen=True)
class LandmarkFeatures(TensorMap):
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

    @property
    def basis(self) -> Tensor:
        """What the kernel's columns are multiplied with at the end."""
        return self.whitening

    def raw(self, X: Tensor) -> Tensor:
        """Return the kernel of samples and landmarks, shape (n_samples, n_landmarks)."""
        return rbf_kernel(X, self.landmarks, float(self.sigma))

    def __call__(self, X: Tensor) -> Tensor:
        """Return features of shape (n_samples, n_features)."""
        return self.raw(X) @ self.whitening

    def apply(self, X: Tensor, coef: Tensor) -> Tensor:
        """Return Phi coef, shape (n_samples, n_outputs)."""
        return self.raw(X) @ (self.whitening @ coef)


def rbf_kernel(X: Tensor, Z: Tensor, sigma: float) -> Tensor:
    """Return exp(-|x_i - z_j|^2 / sigma^2), shape (n_samples, n_landmarks)."""
    squared = (X * X).sum(1, keepdim=True) + (Z * Z).sum(1) - 2 * X @ Z.T
    return squared.clamp_(min=0).mul_(-1 / sigma**2).exp_()


def nystroem(
    X: Tensor, sigma: float, n_components: int, seed: int, kernel_tol: float = 1e-6
) -> LandmarkFeatures:
    """Choose landmarks by randomly pivoted Cholesky (Chen et al., 2023) and whiten.

    As many landmarks as it takes to bring the mean error of k(x, x) down to `kernel_tol`, at most
    `n_components`.
    """
    chosen = torch.arange(len(X))
    if len(X) > CANDIDATES:
        chosen = torch.randperm(len(X), generator=generator(seed))[:CANDIDATES].sort().values
    candidates = X[chosen.to(X.device)]
    n_pivots = min(n_components, len(candidates))
    pivots = pivoted_cholesky(candidates.double(), sigma, n_pivots, seed, kernel_tol)
    return _landmarks(X, candidates[pivots], sigma)


def exact(
    X: Tensor, sigma: float, n_components: int, seed: int, kernel_tol: float = 0.0
) -> LandmarkFeatures:
    """Take every sample as a landmark: the exact kernel on the training data; for small n.

    Kernel directions below rounding are dropped; the last three parameters are not used.
    """
    return _landmarks(X, X, sigma)


def pivoted_cholesky(
    X: Tensor, sigma: float, n_pivots: int, seed: int, kernel_tol: float = 0.0
) -> Tensor:
    """Return row indices drawn in proportion to the kernel's remaining diagonal.

    Several are proposed at a time, and each is accepted with the probability that makes the
    outcome that of drawing one at a time (Epperly, Tropp and Webber, 2024). Stops when the mean of
    the remaining diagonal is at most `kernel_tol`, or rounding.
    """
    source = generator(seed)
    residual = X.new_ones(len(X))
    factor = X.new_zeros(n_pivots, len(X))
    pivots = torch.empty(0, dtype=torch.int64, device=X.device)
    while len(pivots) < n_pivots and float(residual.mean()) > max(kernel_tol, 1e-13):
        drawn = torch.multinomial(residual.cpu(), PROPOSALS, replacement=True, generator=source)
        chances = torch.rand(PROPOSALS, generator=source, dtype=torch.float64)
        drawn = drawn.to(X.device)
        known = factor[: len(pivots)]
        block = rbf_kernel(X[drawn], X[drawn], sigma) - known[:, drawn].T @ known[:, drawn]
        accepted, lower = _accept(block.cpu(), residual[drawn].cpu(), chances)
        accepted = accepted[: n_pivots - len(pivots)]
        lower = lower[: len(accepted), : len(accepted)].to(X)
        new = drawn[accepted.to(X.device)]
        columns = rbf_kernel(X[new], X, sigma) - known[:, new].T @ known
        rows = torch.linalg.solve_triangular(lower, columns, upper=False)
        factor[len(pivots) : len(pivots) + len(new)] = rows
        residual = (residual - rows.square().sum(dim=0)).clamp_(min=0)
        residual[new] = 0
        pivots = torch.cat([pivots, new])
    return pivots


def _accept(block: Tensor, proposed: Tensor, chances: Tensor) -> tuple[Tensor, Tensor]:
    """Return which proposals are accepted, and the Cholesky factor of their block."""
    remaining, columns, accepted = block.clone(), [], []
    for i in range(len(block)):
        pivot = float(remaining[i, i])
        if pivot <= float(chances[i] * proposed[i]) or pivot <= 1e-14:
            continue
        column = remaining[:, i] / pivot**0.5
        remaining -= torch.outer(column, column)
        columns.append(column)
        accepted.append(i)
    index = torch.tensor(accepted, dtype=torch.int64)
    if not accepted:
        return index, block.new_zeros(0, 0)
    return index, torch.stack(columns, dim=1)[index].tril()


def _landmarks(X: Tensor, landmarks: Tensor, sigma: float) -> LandmarkFeatures:
    exact_landmarks = landmarks.double()
    values, vectors = torch.linalg.eigh(rbf_kernel(exact_landmarks, exact_landmarks, sigma))
    kept = values > values[-1] * len(values) * torch.finfo(values.dtype).eps
    whitening = vectors[:, kept] / values[kept].sqrt()
    width = torch.tensor(float(sigma), dtype=X.dtype, device=X.device)
    return LandmarkFeatures(landmarks, whitening.to(X).contiguous(), width)
