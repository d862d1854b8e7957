"""Iterative reweighted least squares for MSVR, in the primal, with backtracking.

Minimises the functional of Eq. (7), sums not means, b unpenalised::

    F(W, b) = 1/2 |W|^2 + C sum_i L(|y_i - W^T phi_i - b|)

F is convex and continuously differentiable, so it has one value at the optimum. Each iteration
solves the weighted ridge problem of Eq. (9) for a direction (Eq. 11) and backtracks along it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import torch
from torch import Tensor

from suspnet.learning.feature_maps import FeatureBlocks
from suspnet.learning.loss import loss, weight

SUFFICIENT_DECREASE = 1e-4
SMALLEST_STEP = 1e-10


class Status(StrEnum):
    """How a solver ended."""

    CONVERGED = "converged"
    MAX_ITER = "max_iter reached"
    STAGNATED = "no step decreases the objective any more"


@dataclass(frozen=True)
class Iteration:
    """What a callback is told after each iteration."""

    n_iter: int
    objective: float
    grad_norm: float
    step: float
    support_fraction: float


@dataclass(frozen=True)
class Solution:
    """Where the solver ended.

    Attributes
    ----------
    coef : tensor of shape (n_features, n_outputs)
    intercept : tensor of shape (n_outputs,)
    objective, grad_norm : float
        F and the norm of its gradient over W and b, at (coef, intercept).
    gap : float
        Proven bound on (F - F*) / F, and the stopping rule. L is convex in u^2, so the quadratic of
        Eq. (9) lies below F everywhere and touches it here; F minus the quadratic's least value,
        half the squared norm of the gradient in the inverse of its Hessian, bounds F - F*.
    support_fraction : float
        Fraction of the samples outside the tube.
    objectives : list of float
        F before the first and after every iteration; it never rises.
    """

    coef: Tensor
    intercept: Tensor
    objective: float
    grad_norm: float
    gap: float
    support_fraction: float
    n_iter: int
    status: Status
    objectives: list[float] = field(default_factory=list)


def irwls(
    blocks: FeatureBlocks,
    Y: Tensor,
    C: float,
    epsilon: float,
    *,
    fit_intercept: bool = True,
    max_iter: int = 200,
    tol: float = 1e-8,
    on_iteration: Callable[[Iteration], None] | None = None,
) -> Solution:
    """Return the minimiser of F and how far it is from the optimum.

    Parameters
    ----------
    blocks : FeatureBlocks
        Phi, (n_samples, n_features).
    Y : tensor of shape (n_samples, n_outputs)
    C, epsilon : float
        Penalty and radius of the tube.
    fit_intercept : bool
    max_iter : int
    tol : float
        Stop when ``gap`` falls to this value.
    on_iteration : callable, optional
        Called with an ``Iteration`` after each.

    Returns
    -------
    Solution
        Its status says whether `tol` was reached.

    Raises
    ------
    ValueError
        If a system is singular to working precision.
    """
    coef = torch.zeros(blocks.n_features, Y.shape[1], dtype=torch.float64, device=Y.device)
    intercept = torch.zeros_like(coef[0])
    residual = Y.double().clone()
    objective = _objective(coef, residual, C, epsilon)
    objectives, status, n_iter, step = [objective], Status.MAX_ITER, 0, 0.0
    while True:
        weights = C * weight(residual.norm(dim=1), epsilon)
        slope = _direction(blocks, residual, weights, coef, fit_intercept)
        gap = 0.5 * slope.decrement / max(objective, torch.finfo(torch.float64).tiny)
        support = float((weights > 0).double().mean())
        if on_iteration is not None and n_iter:
            on_iteration(Iteration(n_iter, objective, slope.grad_norm, step, support))
        if gap <= tol:
            status = Status.CONVERGED
        if gap <= tol or n_iter == max_iter:
            break
        change = _apply(blocks, slope.coef, slope.intercept)
        step, objective = _backtrack(coef, residual, slope, change, objective, C, epsilon)
        if step == 0:
            status = Status.STAGNATED
            break
        coef += step * slope.coef
        intercept += step * slope.intercept
        residual -= step * change
        objectives.append(objective)
        n_iter += 1
    return Solution(
        coef, intercept, objective, slope.grad_norm, gap, support, n_iter, status, objectives
    )


@dataclass(frozen=True)
class _Direction:
    coef: Tensor
    intercept: Tensor
    grad_norm: float
    decrement: float


def _objective(coef: Tensor, residual: Tensor, C: float, epsilon: float) -> float:
    return float(0.5 * coef.square().sum() + C * loss(residual.norm(dim=1), epsilon).sum())


def _direction(
    blocks: FeatureBlocks, residual: Tensor, weights: Tensor, coef: Tensor, fit_intercept: bool
) -> _Direction:
    """Solve Eq. (9) for the change of W and b: (W^s - W, b^s - b) of Eq. (11).

    In terms of the gradient g, the change is -B^-1 g with B = I + [Phi 1]^T D_a [Phi 1]; b is
    eliminated, so the matrix factored is I plus the Gram matrix of the centred features.
    """
    weighted = weights[:, None] * residual
    gram = torch.eye(blocks.n_features, dtype=torch.float64, device=coef.device)
    pull = torch.zeros_like(coef)
    mean = torch.zeros_like(coef[:, 0])
    for rows, phi in blocks:
        scaled = phi * weights[rows, None].to(phi.dtype)
        gram += scaled.T @ phi
        pull += phi.T @ weighted[rows].to(phi.dtype)
        mean += scaled.sum(dim=0)
    gradient, total = coef - pull, weights.sum()
    offset = torch.zeros_like(coef[0])
    if fit_intercept:
        offset = -weighted.sum(dim=0)
    norm = float(torch.cat([gradient, offset[None]]).norm())
    right = -gradient
    if fit_intercept and total > 0:
        mean, offset_change = mean / total, -offset / total
        gram -= total * torch.outer(mean, mean)
        right = right - total * torch.outer(mean, offset_change)
    factor, info = torch.linalg.cholesky_ex(gram)
    if int(info) or not bool(torch.isfinite(right).all()):
        raise ValueError(
            f"the {len(gram)} x {len(gram)} system of IRWLS is singular to working precision with "
            f"weights up to {float(weights.max()):.1e}; lower C, or scale the outputs"
        )
    change = torch.cholesky_solve(right, factor)
    intercept_change = torch.zeros_like(offset)
    if fit_intercept and total > 0:
        intercept_change = offset_change - mean @ change
    decrement = -float((gradient * change).sum() + (offset * intercept_change).sum())
    return _Direction(change, intercept_change, norm, max(decrement, 0.0))


def _apply(blocks: FeatureBlocks, coef: Tensor, intercept: Tensor) -> Tensor:
    product = torch.empty(len(blocks.X), coef.shape[1], dtype=coef.dtype, device=coef.device)
    for rows, phi in blocks:
        product[rows] = (phi @ coef.to(phi.dtype)).double() + intercept
    return product


def _backtrack(
    coef: Tensor,
    residual: Tensor,
    direction: _Direction,
    change: Tensor,
    objective: float,
    C: float,
    epsilon: float,
) -> tuple[float, float]:
    """Halve the step from 1 until F falls enough; (0, F) if no step does."""
    step = 1.0
    while step > SMALLEST_STEP:
        value = _objective(coef + step * direction.coef, residual - step * change, C, epsilon)
        if value <= objective - SUFFICIENT_DECREASE * step * direction.decrement:
            return step, value
        step /= 2
    return 0.0, objective
