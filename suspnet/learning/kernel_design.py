"""The design of the exact kernel, in dual coefficients: W = sum_i beta_i phi(x_i).

The features phi need not be known: every vector of their space that the solver meets is such a sum,
and is stored as the pair (beta, K beta), with K the kernel matrix of the samples. Then Phi W is the
second half, and inner products are beta^T K beta'.
"""

from __future__ import annotations

import torch
from torch import Tensor, cholesky_solve

from suspnet.learning.design import (
    Columns,
    Direction,
    Gradient,
    Penalty,
    cholesky,
    largest_weights,
)
from suspnet.learning.feature_maps import KernelColumns
from suspnet.learning.ranks import AllReduce, identity

ADVICE = "lower C, or scale the outputs"
"""What to do where a system is singular to working precision."""


class KernelDesign:
    """Phi of the exact kernel on its own samples; a `suspnet.learning.design.Design`.

    A direction d of the solver has d = eta - g, with g the gradient: eta is 0 for samples whose
    weight is 0, and solves (H^-1 + K) eta = K g - 1 db, 1^T eta = g_b, where H is the second
    derivative of the samples' losses, of which each kind of equations has its own.

    `X`: (n_samples, n_inputs), the samples of the map.
    """

    def __init__(self, kernel: KernelColumns, X: Tensor, all_reduce: AllReduce = identity) -> None:
        self.K, self.all_reduce = kernel.raw(X), all_reduce
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
            return torch.cat([columns, self.K[rows].T @ columns[rows]])
        return torch.cat([columns, self.K @ columns])

    def matvec_rmatvec(self, change: Direction, columns: Columns) -> tuple[Tensor, Tensor]:
        """Return Phi W + b, and Phi^T V with V = columns(rows, (Phi W + b)[rows])."""
        moved = change.coef[self.n_samples :] + change.intercept
        return moved, self.rmatvec(columns(slice(0, self.n_samples), moved))

    def fixed(self, C: Penalty, fit_intercept: bool) -> FixedKernel:
        """Return the equations of all weights 2 C, computed once."""
        return FixedKernel(self, C, fit_intercept)

    def reweighted(self, C: Penalty, fit_intercept: bool) -> ReweightedKernel:
        """Return the equations of Eq. (9), factored for the weights of every iteration."""
        return ReweightedKernel(self, fit_intercept)

    def newton(self, C: Penalty, fit_intercept: bool) -> NewtonKernel:
        """Return the equations of Newton's method."""
        return NewtonKernel(self, C, fit_intercept)

    def direction(self, gradient: Gradient, rows: Tensor, eta: Tensor, shift: Tensor) -> Direction:
        """Return eta - g, with `eta` that of some rows."""
        whole = torch.zeros_like(gradient.coef[: self.n_samples])
        whole[rows] = eta
        return Direction(self.rmatvec(whole) - gradient.coef, shift)


class FixedKernel:
    """Directions of all weights 2 C, H = 2 C: one factorisation serves every iteration."""

    def __init__(self, design: KernelDesign, C: Penalty, fit_intercept: bool) -> None:
        self._design, self._fit_intercept = design, fit_intercept
        self._weights = largest_weights(C, design.K[0])[:, None]
        self._used = (self._weights[:, 0] > 0).nonzero()[:, 0]
        every = len(self._used) == design.n_samples
        kernel = design.K if every else design.K[self._used][:, self._used]
        self._factor = _factor(kernel, self._weights[self._used, 0])

    def direction(self, gradient: Gradient, accuracy: float) -> Direction:
        """Return -H^-1 g, exactly."""
        right = gradient.coef[self._design.n_samples :][self._used]
        eta, shift = _solve(self._factor, right, gradient.intercept, self._fit_intercept)
        if len(self._used) < self._design.n_samples:
            return self._design.direction(gradient, self._used, eta, shift)
        # K eta - K g follows from the equations, without a product with K
        moved = -eta / self._weights - shift
        gamma = gradient.coef[: self._design.n_samples]
        return Direction(torch.cat([eta - gamma, moved]), shift)


class ReweightedKernel:
    """Directions of Eq. (9), H = a of Eq. (10): a row for each sample outside the tube."""

    def __init__(self, design: KernelDesign, fit_intercept: bool) -> None:
        self._design, self._fit_intercept = design, fit_intercept

    def direction(self, gradient: Gradient, accuracy: float) -> Direction:
        """Return (W^s - W, b^s - b) of Eq. (11), exactly."""
        design, support = self._design, gradient.weights.nonzero()[:, 0]
        kernel = design.K[support][:, support]
        factor = _factor(kernel, gradient.weights[support])
        right = gradient.coef[design.n_samples :][support]
        eta, shift = _solve(factor, right, gradient.intercept, self._fit_intercept)
        return design.direction(gradient, support, eta, shift)


class NewtonKernel:
    """Directions of Newton's method: H is the second derivative of L(|r|), as in `NewtonGram`.

    The system has a row for each output of each sample outside the tube.
    """

    def __init__(self, design: KernelDesign, C: Penalty, fit_intercept: bool) -> None:
        self._design, self._weights = design, largest_weights(C, design.K[0])
        self._fit_intercept = fit_intercept

    def direction(self, gradient: Gradient, accuracy: float) -> Direction:
        """Return the Newton direction, exactly."""
        design, support = self._design, gradient.weights.nonzero()[:, 0]
        n, n_outputs = len(support), gradient.coef.shape[1]
        kernel = design.K[support][:, support]
        inverse = self._inverse(gradient, support)
        # the rows are ordered output by output, so the kernel stands in each block of the diagonal
        matrix = kernel.new_zeros(n_outputs, n, n_outputs, n)
        for j in range(n_outputs):
            matrix[j, :, j, :] = kernel
            for k in range(n_outputs):
                matrix[j, :, k, :].diagonal().add_(inverse[:, j, k])
        name = f"system of {n} samples outside the tube"
        factor = cholesky(matrix.reshape(n * n_outputs, -1), name, ADVICE)
        right = gradient.coef[design.n_samples :][support].T.reshape(-1, 1)
        ones = torch.eye(n_outputs).to(kernel).repeat_interleave(n, dim=0)
        solved = cholesky_solve(torch.cat([right, ones], dim=1), factor)
        free, by_shift = solved[:, 0], solved[:, 1:]
        shift = torch.zeros_like(gradient.intercept)
        if self._fit_intercept and n:
            shift = torch.linalg.solve(ones.T @ by_shift, ones.T @ free - gradient.intercept)
        eta = (free - by_shift @ shift).reshape(n_outputs, n).T
        return design.direction(gradient, support, eta, shift)

    def _inverse(self, gradient: Gradient, support: Tensor) -> Tensor:
        """Return H^-1 of each sample outside the tube, (n_support, n_outputs, n_outputs)."""
        largest, actual = self._weights[support], gradient.weights[support]
        unit = torch.nn.functional.normalize(gradient.residual[support], dim=1)
        radial = unit[:, :, None] * unit[:, None, :]
        across = torch.eye(unit.shape[1]).to(radial) - radial
        return radial / largest[:, None, None] + across / actual[:, None, None]


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
    return cholesky(matrix, f"kernel matrix with weights up to {weights.max():.1e}", ADVICE)
