"""Finite feature maps phi with phi(x) . phi(z) close to the RBF kernel exp(-|x - z|^2 / sigma^2).

This module holds the interface of a map, random Fourier features, Nystroem landmarks and the exact
kernel. The map on a regular grid of frequencies is in ``equispaced``; `MAPS` of ``msvr`` lists all
maps.
"""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

ROUNDING = 1e-13
"""Residual of the kernel's unit diagonal below which it is rounding and counts as 0."""


class FeatureMap:
    """Maps samples (n_samples, n_inputs) to features (n_samples, n_features), from tensors."""

    @property
    def n_inputs(self) -> int:
        """Number of columns the map takes."""
        raise NotImplementedError

    def __call__(self, X: Tensor) -> Tensor:
        """Return the features of `X`."""
        raise NotImplementedError

    @property
    def basis(self) -> Tensor | None:
        """Matrix V if the features are Phi = K V with a fixed V, else None."""
        return None

    def raw(self, X: Tensor) -> Tensor:
        """Return K in Phi = K V; Phi itself if there is no `basis`."""
        return self(X)

    def apply(self, X: Tensor, coef: Tensor) -> Tensor:
        """Return Phi coef, shape (n_samples, n_outputs)."""
        return self(X) @ coef

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that define the map, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]


@dataclass(frozen=True)
class FourierFeatures(FeatureMap):
    """phi(x) = sqrt(2 / D) (cos(x . w_1), ..., sin(x . w_1), ...) for D / 2 frequencies w_j.

    The squared norm is 1, and shift invariance exact, for any draw (Rahimi and Recht, 2007).
    `random_weights`: (n_inputs, D / 2).
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
    shape, source = (X.shape[1], _pairs(n_components)), generator(seed)
    draws = torch.randn(shape, generator=source, dtype=torch.float64)
    return FourierFeatures((draws * math.sqrt(2) / sigma).to(X))


def orthogonal_fourier(
    X: Tensor, sigma: float, n_components: int, seed: int, kernel_tol: float = 0.0
) -> FourierFeatures:
    """Draw orthogonal random features: blocks of orthogonal directions (Yu et al., 2016).

    Each direction is uniform on the sphere and has the length of a Gaussian vector, so each w_j by
    itself is still N(0, 2 / sigma^2 I). `kernel_tol` is not used.
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
    """Return a new random generator on the CPU."""
    return torch.Generator().manual_seed(seed)


@dataclass(frozen=True)
class KernelColumns(FeatureMap):
    """The exact kernel: columns k(x, x_i) of the training samples, for dual coefficients.

    `landmarks`: the samples (n_samples, n_inputs), `sigma`: ().
    """

    landmarks: Tensor
    sigma: Tensor

    @property
    def n_inputs(self) -> int:
        """Number of columns the map takes."""
        return self.landmarks.shape[1]

    def __call__(self, X: Tensor) -> Tensor:
        """Return the kernel of samples and training samples, (n_samples, n_training)."""
        return rbf_kernel(X, self.landmarks, float(self.sigma))


@dataclass(frozen=True)
class LandmarkFeatures(KernelColumns):
    """phi(x) = V^T k(Z, x) with V V^T the inverse of k(Z, Z) on landmarks Z (Nystroem).

    `landmarks`: Z (n_landmarks, n_inputs), `sigma`: (), `whitening`: V (n_landmarks, n_features).
    """

    whitening: Tensor

    @property
    def basis(self) -> Tensor:
        """Matrix V in Phi = K V, (n_landmarks, n_features)."""
        return self.whitening

    def raw(self, X: Tensor) -> Tensor:
        """Return the kernel of samples and landmarks, shape (n_samples, n_landmarks)."""
        return super().__call__(X)

    def __call__(self, X: Tensor) -> Tensor:
        """Return features of shape (n_samples, n_features)."""
        return self.raw(X) @ self.whitening

    def apply(self, X: Tensor, coef: Tensor) -> Tensor:
        """Return Phi coef, shape (n_samples, n_outputs)."""
        return self.raw(X) @ (self.whitening @ coef)


def rbf_kernel(X: Tensor, Z: Tensor, sigma: float) -> Tensor:
    """Return exp(-|x_i - z_j|^2 / sigma^2), shape (n_samples, n_landmarks)."""
    return squared_distances(X, Z).mul_(-1 / sigma**2).exp_()


def squared_distances(X: Tensor, Z: Tensor) -> Tensor:
    """Return |x_i - z_j|^2 from differences, which do not cancel far from the origin."""
    return torch.cdist(X, Z, compute_mode="donot_use_mm_for_euclid_dist").square_()


def nystroem(
    X: Tensor,
    sigma: float,
    n_components: int,
    seed: int,
    kernel_tol: float = 1e-6,
    *,
    n_candidates: int = 16_384,
) -> LandmarkFeatures:
    """Choose landmarks by randomly pivoted Cholesky (Chen et al., 2023) and whiten.

    Landmarks are added until the mean error of k(x, x) is at most `kernel_tol` or there are
    `n_components`, from at most `n_candidates` samples drawn at random.
    """
    chosen = torch.arange(len(X))
    if len(X) > n_candidates:
        chosen = torch.randperm(len(X), generator=generator(seed))[:n_candidates].sort().values
    candidates = X[chosen.to(X.device)]
    n_pivots = min(n_components, len(candidates))
    pivots, _ = partial_cholesky(candidates.double(), sigma, n_pivots, seed, kernel_tol)
    return _landmarks(X, candidates[pivots], sigma)


def exact(
    X: Tensor, sigma: float, n_components: int, seed: int, kernel_tol: float = 0.0
) -> KernelColumns:
    """Return the exact kernel of the samples; the other arguments are not used."""
    return KernelColumns(X, torch.tensor(float(sigma), dtype=X.dtype, device=X.device))


def partial_cholesky(
    X: Tensor,
    sigma: float,
    n_pivots: int,
    seed: int,
    kernel_tol: float = 0.0,
    n_proposals: int = 64,
) -> tuple[Tensor, Tensor]:
    """Return rows (n_drawn,) of X, and F (n_drawn, n_samples) with F^T F about the kernel K.

    Rows are drawn in proportion to the residual of the kernel's diagonal: `n_proposals` at a time,
    each accepted with the probability for which the distribution is that of drawing one at a time
    (Epperly, Tropp and Webber, 2024). The search stops when the mean of the residual is at most
    `kernel_tol`, or all of it is rounding.
    """
    source = generator(seed)
    residual = X.new_ones(len(X))
    factor = X.new_zeros(n_pivots, len(X))
    pivots = torch.empty(0, dtype=torch.int64, device=X.device)
    # Each round accepts at least its first proposal, so n_pivots rounds are enough.
    for _ in range(n_pivots):
        if len(pivots) == n_pivots or float(residual.mean()) <= kernel_tol:
            break
        shares = residual.cpu()
        rows = torch.multinomial(shares, n_proposals, replacement=True, generator=source)
        chances = torch.rand(n_proposals, generator=source, dtype=torch.float64)
        proposals = rows.to(X.device)
        factored = factor[: len(pivots)]
        explained = factored[:, proposals].T @ factored[:, proposals]
        block = rbf_kernel(X[proposals], X[proposals], sigma) - explained
        # The block's diagonal must equal the residual that the draws are from, despite rounding.
        block = torch.where(proposals[:, None] == proposals, residual[proposals], block)
        accepted, lower = _accept(block.cpu(), chances)
        # No more pivots than required: the factor has room for n_pivots rows.
        accepted = accepted[: n_pivots - len(pivots)]
        lower = lower[: len(accepted), : len(accepted)].to(X)
        new = proposals[accepted.to(X.device)]
        columns = rbf_kernel(X[new], X, sigma) - factored[:, new].T @ factored
        rows = torch.linalg.solve_triangular(lower, columns, upper=False)
        factor[len(pivots) : len(pivots) + len(new)] = rows
        residual = residual - rows.square().sum(dim=0)
        residual = torch.where(residual > ROUNDING, residual, 0.0)
        residual[new] = 0
        pivots = torch.cat([pivots, new])
    return pivots, factor[: len(pivots)]


def _accept(block: Tensor, chances: Tensor) -> tuple[Tensor, Tensor]:
    """Return which proposals are accepted, and the Cholesky factor of their block.

    A proposal is accepted if its residual after the earlier ones exceeds its chance, in [0, 1),
    times its residual before the round; the first always is.
    """
    remaining, columns, accepted = block.clone(), [], []
    for i in range(len(block)):
        pivot = float(remaining[i, i])
        if pivot <= max(float(chances[i] * block[i, i]), ROUNDING):
            continue
        column = remaining[:, i] / pivot**0.5
        remaining -= torch.outer(column, column)
        columns.append(column)
        accepted.append(i)
    return torch.tensor(accepted), torch.stack(columns, dim=1)[accepted].tril()


def _landmarks(X: Tensor, landmarks: Tensor, sigma: float) -> LandmarkFeatures:
    """Return the feature map of landmarks without the null space of their kernel."""
    exact_landmarks = landmarks.double()
    values, vectors = torch.linalg.eigh(rbf_kernel(exact_landmarks, exact_landmarks, sigma))
    is_regular = values > values[-1] * len(values) * torch.finfo(values.dtype).eps
    whitening = vectors[:, is_regular] / values[is_regular].sqrt()
    width = torch.tensor(float(sigma), dtype=X.dtype, device=X.device)
    return LandmarkFeatures(landmarks, width, whitening.to(X).contiguous())
