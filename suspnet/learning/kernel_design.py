"""The design of the exact kernel, in dual coefficients: W = sum_i beta_i phi(x_i).

The features phi need not be known: every vector of their space that the solver meets is such a sum,
and is stored as the pair (beta, K beta), with K the kernel matrix of the samples. Then Phi W is the
second half, and inner products are beta^T K beta'.
"""

from __future__ import annotations

import torch
from torch import Tensor, cholesky_solve

from suspnet.learning.design import Coefficients, Columns, Design, Gradient, cholesky
from suspnet.learning.feature_maps import KernelColumns

ADVICE = "lower C, or scale the outputs"
"""What to do where a system is singular to working precision."""


class KernelDesign(Design):
    """Phi of the exact kernel on its own samples.

    A direction d of the solver has d = eta - g, with g the gradient: eta is 0 for samples whose
    weight is 0, and solves (H^-1 + K) eta = K g - 1 db, 1^T eta = g_b, where H is the second
    derivative of the samples' losses, of which each kind of equations has its own. Those of Eq. (9)
    take the place of Newton's.

    `X`: (n_samples, n_inputs), the samples of the map.
    """

    def __init__(self, kernel: KernelColumns, X: Tensor) -> None:
        self.matrix = kernel(X)  # (n_samples, n_samples)
        self.n_samples = len(X)
        self.n_features = 2 * len(X)

    def inner(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the sum over outputs of the inner products of two vectors of features."""
        return (first[: self.n_samples] * second[self.n_samples :]).sum()

    def coefficients(self, coef: Tensor) -> Tensor:
        """Return the dual coefficients, (n_samples, n_outputs)."""
        return coef[: self.n_samples]

    def rmatvec(self, columns: Tensor) -> Tensor:
        """Return Phi^T columns as pairs, (2 n_samples, n_columns)."""
        rows = columns.any(dim=1).nonzero()[:, 0]
        if 2 * len(rows) < self.n_samples:  # most samples lie within the tube
            return torch.cat([columns, self.matrix[rows].T @ columns[rows]])
        return torch.cat([columns, self.matrix @ columns])

    def matvec_rmatvec(self, change: Coefficients, columns: Columns) -> tuple[Tensor, Tensor]:
        """Return Phi W + b, and Phi^T V with V = columns(rows, (Phi W + b)[rows])."""
        moved = change.coef[self.n_samples :] + change.intercept
        return moved, self.rmatvec(columns(slice(0, self.n_samples), moved))

    def fixed(self, C: float, fit_intercept: bool) -> FixedKernel:
        """Return the equations of all weights 2 C, computed once."""
        return FixedKernel(self, C, fit_intercept)

    def reweighted(self, C: float, fit_intercept: bool) -> ReweightedKernel:
        """Return the equations of Eq. (9), factored for the weights of every iteration."""
        return ReweightedKernel(self, fit_intercept)


class FixedKernel:
    """Directions of all weights 2 C, H = 2 C: one factorisation serves every iteration."""

    def __init__(self, design: KernelDesign, C: float, fit_intercept: bool) -> None:
        self._design, self._fit_intercept = design, fit_intercept
        self._weight = 2 * C
        weights = torch.full_like(design.matrix[0], self._weight)
        self._factor = _factor(design.matrix, weights)

    def direction(self, gradient: Gradient) -> Coefficients:
        """Return -H^-1 g, exactly."""
        right = gradient.coef[self._design.n_samples :]
        eta, shift = _solve(self._factor, right, gradient.intercept, self._fit_intercept)
        # K eta - K g follows from the equations, without a product with K
        moved = -eta / self._weight - shift
        gamma = gradient.coef[: self._design.n_samples]
        return Coefficients(torch.cat([eta - gamma, moved]), shift)


class ReweightedKernel:
    """Directions of Eq. (9), H = a of Eq. (10): a row for each sample outside the tube."""

    def __init__(self, design: KernelDesign, fit_intercept: bool) -> None:
        self._design, self._fit_intercept = design, fit_intercept

    def direction(self, gradient: Gradient) -> Coefficients:
        """Return (W^s - W, b^s - b) of Eq. (11), exactly."""
        design, support = self._design, gradient.weights.nonzero()[:, 0]
        factor = _factor(design.matrix[support][:, support], gradient.weights[support])
        right = gradient.coef[design.n_samples :][support]
        eta = torch.zeros_like(gradient.coef[: design.n_samples])
        eta[support], shift = _solve(factor, right, gradient.intercept, self._fit_intercept)
        return Coefficients(design.rmatvec(eta) - gradient.coef, shift)


def _solve(
    factor: Tensor, right: Tensor, total: Tensor, fit_intercept: bool
) -> tuple[Tensor, Tensor]:
    """Return eta and db with A eta = right - 1 db and 1^T eta = total, db = 0 without an intercept.

    `factor` is the Cholesky factor of A; `right` (n, n_outputs), `total` (n_outputs,).
    """
    shift = torch.zeros_like(total)
    if not fit_intercept or not len(right):
        return cholesky_solve(right, factor), shift
    solved = cholesky_solve(torch.cat([right, torch.ones_like(right[:, :1])], dim=1), factor)
    free, by_shift = solved[:, :-1], solved[:, -1:]
    shift = (free.sum(dim=0) - total) / by_shift.sum()
    return free - by_shift * shift, shift


def _factor(kernel: Tensor, weights: Tensor) -> Tensor:
    """Return the Cholesky factor of K + 1 / weights."""
    matrix = kernel.clone()
    matrix.diagonal().add_(1 / weights)
    return cholesky(matrix, f"kernel matrix with weights of total {weights.sum():.1e}", ADVICE)
