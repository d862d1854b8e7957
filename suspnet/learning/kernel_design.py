"""The design of the exact kernel, in dual coefficients: W = sum_i beta_i phi(x_i).

The features phi need not be known: every vector of their space that the solver meets is such a sum,
and is stored as the pair (beta, K beta), with K the kernel matrix of the samples. Then Phi W is the
second half, and inner products are beta^T K beta'.
"""

import functools
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, cholesky_solve

from suspnet.learning.design import (
    Coefficients,
    Columns,
    Design,
    Gradient,
    Kind,
    NormalEquations,
    cholesky,
)
from suspnet.learning.feature_maps import KernelColumns, generator, partial_cholesky
from suspnet.learning.irwls import IRWLS

Solve = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Function that returns eta and db from the right-hand side and the sum of eta."""
LARGEST_RANK, LOW_RANK_ERROR = 0.25, 0.1
"""Rank of F^T F, as a share of the samples, and its mean error times the largest weight."""
FORCING, MOST_GRADIENTS = 1e-8, 100
"""Relative energy of the error and number of iterations at which conjugate gradients end."""
FEW_UNKNOWNS = 600  # number of unknowns up to which Newton's equations are factored as a whole
START_SHARE, FEWEST_START, START_TOL, MOST_OUTSIDE = 4, 100, 1e-2, 0.95
"""The minimum is sought first on one in `START_SHARE` of the samples if that is at least
`FEWEST_START`, to `START_TOL`, and kept unless more than `MOST_OUTSIDE` of them leave the tube."""
NARROW = 0.01
"""Largest epsilon, as a share of the outputs' deviation, of a tube that holds few samples."""


class KernelDesign(Design):
    """Phi of the exact kernel on its own samples.

    A direction d of the solver has d = eta - g, with g the gradient: eta is 0 for samples whose
    weight is 0, and solves (H^-1 + K) eta = K g - 1 db, 1^T eta = g_b, where H is the second
    derivative of the samples' losses, of which each kind of equations has its own.

    `X`: (n_samples, n_inputs), the samples of the map.
    """

    def __init__(self, kernel: KernelColumns, X: Tensor) -> None:
        self.kernel, self.X = kernel, X
        self.n_samples = len(X)
        self.n_features = 2 * len(X)
        self._rows = X.new_empty(len(X), len(X))
        self.every = torch.arange(len(X), device=X.device)
        self._is_known = torch.zeros(len(X), dtype=torch.bool, device=X.device)

    def rows(self, rows: Tensor) -> Tensor:
        """Return some rows of the kernel matrix, each computed when it is needed first."""
        is_new = ~self._is_known[rows]
        if bool(is_new.any()):
            new = rows[is_new]
            self._is_known[new] = True
            if len(new) == self.n_samples:
                self._rows = self.kernel.raw(self.X)
            else:
                self._rows[new] = self.kernel(self.X[new])
        return self._rows if len(rows) == self.n_samples else self._rows[rows]

    def block(self, rows: Tensor) -> Tensor:
        """Return the kernel matrix of some samples."""
        kernel = self.rows(rows)
        return kernel if len(rows) == self.n_samples else kernel[:, rows]

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
            return torch.cat([columns, self.rows(rows).T @ columns[rows]])
        return torch.cat([columns, self.rows(self.every) @ columns])

    def matvec_rmatvec(self, change: Coefficients, columns: Columns) -> tuple[Tensor, Tensor]:
        """Return Phi W + b, and Phi^T V with V = columns(rows, (Phi W + b)[rows])."""
        moved = change.coef[self.n_samples :] + change.intercept
        return moved, self.rmatvec(columns(slice(0, self.n_samples), moved))

    def start(self, solver: IRWLS, Y: Tensor) -> Coefficients | None:
        """Return about the minimum, from some of the samples; None if the tube holds almost none.

        From there on the solver meets samples that lie outside the tube of almost the best model,
        and needs the rows of the kernel matrix of these alone.
        """
        n_few = self.n_samples // START_SHARE
        is_narrow = solver.epsilon <= NARROW * float(Y.std(dim=0, correction=0).max())
        if is_narrow or solver.solver != "newton" or n_few < FEWEST_START:
            return None
        few = torch.randperm(self.n_samples, generator=generator(0))[:n_few].to(Y.device)
        design = KernelDesign(replace(self.kernel, landmarks=self.X[few]), self.X[few])
        coarse = replace(solver, C=solver.C * START_SHARE, tol=START_TOL)
        solution = coarse.minimise(design, Y[few])
        if solution.support_fraction > MOST_OUTSIDE:
            return None
        dual = torch.zeros_like(Y, dtype=torch.float64)
        dual[few] = solution.coef
        return Coefficients(self.rmatvec(dual), solution.intercept)

    def equations(self, kind: Kind, C: float, fit_intercept: bool) -> NormalEquations:
        """Return equations of a kind."""
        if kind == "reweighted":
            return ReweightedKernel(self, fit_intercept)
        return (FixedKernel if kind == "fixed" else NewtonKernel)(self, C, fit_intercept)

    def direction(
        self, gradient: Gradient, rows: Tensor, eta: Tensor, shift: Tensor
    ) -> Coefficients:
        """Return eta - g, with `eta` that of some rows."""
        whole = torch.zeros_like(gradient.coef[: self.n_samples])
        whole[rows] = eta
        return Coefficients(self.rmatvec(whole) - gradient.coef, shift)


class FixedKernel:
    """Directions of all weights 2 C, H = 2 C: one factorisation serves every iteration."""

    def __init__(self, design: KernelDesign, C: float, fit_intercept: bool) -> None:
        self._design, self._fit_intercept = design, fit_intercept
        self._weight = 2 * C
        weights = torch.full_like(design.X[:, 0], self._weight)
        self._factor = _factor(design.block(design.every), weights)

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
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

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
        """Return (W^s - W, b^s - b) of Eq. (11), exactly."""
        design, support = self._design, gradient.weights.nonzero()[:, 0]
        kernel = design.block(support)
        factor = _factor(kernel, gradient.weights[support])
        right = gradient.coef[design.n_samples :][support]
        eta, shift = _solve(factor, right, gradient.intercept, self._fit_intercept)
        return design.direction(gradient, support, eta, shift)


class NewtonKernel:
    """Directions of Newton's method: H is the second derivative of L(|r|), as in `NewtonGram`.

    The system has a row for each output of each sample outside the tube. Conjugate gradients solve
    it. Their preconditioner replaces K by a product F^T F where F has few rows, else H^-1 by 1 / a,
    the same for all outputs; it is the system itself where that is small.
    """

    def __init__(self, design: KernelDesign, C: float, fit_intercept: bool) -> None:
        self._design, self._weight = design, 2 * C
        self._fit_intercept = fit_intercept

    @functools.cached_property
    def _low_rank(self) -> Tensor | None:
        """F, (n_rows, n_samples), None if it would have many rows."""
        design, most = self._design, int(LARGEST_RANK * self._design.n_samples)
        error = LOW_RANK_ERROR / self._weight
        _, factor = partial_cholesky(design.X, float(design.kernel.sigma), most, 0, error)
        return factor if len(factor) < most else None

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
        """Return the Newton direction, to rounding of about `FORCING`."""
        design, support = self._design, gradient.weights.nonzero()[:, 0]
        actual = gradient.weights[support]
        unit = torch.nn.functional.normalize(gradient.residual[support], dim=1)
        radial = unit[:, :, None] * unit[:, None, :]
        across = torch.eye(unit.shape[1]).to(radial) - radial
        # the inverse Hessian of the loss: one value along the residual, another across it
        inverse = radial / self._weight + across / actual[:, None, None]
        kernel = design.block(support)
        if inverse.numel() <= FEW_UNKNOWNS * unit.shape[1]:
            approximate = _whole(kernel, inverse)
        elif self._low_rank is None:
            factor = _factor(kernel, actual)

            def approximate(right: Tensor) -> Tensor:
                return cholesky_solve(right, factor)

        else:
            second = radial * self._weight + across * actual[:, None, None]
            approximate = _woodbury(self._low_rank[:, support], second)
        eta, shift = _conjugate_gradients(
            lambda eta: kernel @ eta + (inverse @ eta[:, :, None])[:, :, 0],
            _with_intercept(approximate, unit, self._fit_intercept),
            gradient.coef[design.n_samples :][support],
            gradient.intercept,
        )
        return design.direction(gradient, support, eta, shift)


def _whole(kernel: Tensor, inverse: Tensor) -> Callable[[Tensor], Tensor]:
    """Return what multiplies by the inverse of H^-1 + K, with the rows ordered output by output."""
    n, q = inverse.shape[:2]
    matrix = torch.kron(torch.eye(q).to(kernel), kernel).reshape(q, n, q, n)
    matrix.diagonal(dim1=1, dim2=3).add_(inverse.permute(1, 2, 0))
    factor = cholesky(matrix.reshape(n * q, n * q), f"system of {n} samples outside the tube")
    return lambda right: cholesky_solve(right.T.reshape(-1, 1), factor).reshape(q, n).T


def _woodbury(factor: Tensor, second: Tensor) -> Callable[[Tensor], Tensor]:
    """Return what multiplies by the inverse of H^-1 + F^T F, H of each sample (n, q, q)."""
    rank, q = len(factor), second.shape[1]
    core = factor.new_zeros(q, rank, q, rank)
    for j in range(q):
        core[j, :, j].diagonal().add_(1.0)
        for k in range(q):
            core[j, :, k] += (factor * second[:, j, k]) @ factor.T
    lower = cholesky(core.reshape(q * rank, -1), f"system of {rank} rows of a factor of the kernel")

    def apply(right: Tensor) -> Tensor:
        scaled = (second @ right[:, :, None])[:, :, 0]
        inner = cholesky_solve((factor @ scaled).T.reshape(-1, 1), lower).reshape(q, rank)
        return scaled - (second @ (inner @ factor).T[:, :, None])[:, :, 0]

    return apply


def _with_intercept(
    approximate: Callable[[Tensor], Tensor], like: Tensor, fit_intercept: bool
) -> Solve:
    """Return what solves A eta = right - 1 db and 1^T eta = total for `approximate` of A^-1."""
    if not fit_intercept or not len(like):
        return lambda right, total: (approximate(right), torch.zeros_like(total))
    ones = torch.eye(like.shape[1]).to(like)[:, None].expand(-1, *like.shape)
    by_shift = torch.stack([approximate(shift) for shift in ones])
    sums = by_shift.sum(dim=1).T

    def solve(right: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
        free = approximate(right)
        shift = torch.linalg.solve(sums, free.sum(dim=0) - total)
        return free - torch.tensordot(shift, by_shift, dims=1), shift

    return solve


def _conjugate_gradients(
    multiply: Callable[[Tensor], Tensor], solve: Solve, right: Tensor, total: Tensor
) -> tuple[Tensor, Tensor]:
    """Return eta and db with A eta = right - 1 db and 1^T eta = total.

    `multiply` is by A, `solve` solves the same for a matrix near A, and so keeps the sum of eta.
    """
    eta, _ = solve(right, total)
    residual = right - multiply(eta)
    search, shift = solve(residual, torch.zeros_like(total))
    energy = float((residual * search).sum())
    least = FORCING * abs(float((right * eta).sum()))
    for _ in range(MOST_GRADIENTS):
        if not energy > least:
            break
        product = multiply(search)
        length = energy / float((search * product).sum())
        eta, residual = eta + length * search, residual - length * product
        step, shift = solve(residual, torch.zeros_like(total))
        before, energy = energy, float((residual * step).sum())
        search = step + energy / before * search
    return eta, shift


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
    return cholesky(matrix, f"kernel matrix with weights of total {weights.sum():.1e}")
