"""Iterative reweighted least squares for MSVR in the primal.

Minimises the functional of Eq. (7), sums not means, b unpenalised::

    F(W, b) = 1/2 |W|^2 + C sum_i L(|y_i - W^T phi_i - b|)

with the hyperspherical epsilon-insensitive loss L(u) of Eq. (8), u the norm of a sample's residual
over all outputs. F is convex and continuously
differentiable, so it has one value at the optimum. Each iteration takes a direction from normal
equations and backtracks along it.

- "irwls" is the algorithm of the paper: from W = 0, b = 0 on, each direction is that of Eq. (11),
  from the equations (9) with the weights (10).
- "newton" alternates between the equations of a fixed Gram matrix, which need one factorisation,
  and those of Newton's method whenever progress is slow.

Both have the same optimum and the same stopping rule.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import torch
from torch import Tensor

from suspnet.learning.design import Coefficients, Columns, Design, Gradient, Kind

SUFFICIENT_DECREASE = 1e-4
"""Fraction of the decrease predicted by the gradient that a step must reach (Armijo's rule)."""
SMALLEST_STEP = 1e-10  # smallest fraction of the direction that backtracking tries
MAX_SLOW_STEPS = 20
"""Number of slow steps in a row after which the solver leaves Newton's equations, which can cycle
where many samples lie on the border of the tube."""
KINDS: dict[str, tuple[Kind, ...]] = {"newton": ("fixed", "newton"), "irwls": ("reweighted",)}
"""Kinds of equations of each solver, in turn."""


def loss(u: Tensor, epsilon: float) -> Tensor:
    """Return L(u) = 0 below epsilon and (u - epsilon)^2 above, Eq. (8); same shape as `u`."""
    return (u - epsilon).clamp(min=0).square()


def weight(u: Tensor, epsilon: float) -> Tensor:
    """Return a(u) = L'(u) / u, so a_i of Eq. (10) is C a(u_i); 0 inside the tube and at u = 0.

    For epsilon = 0 the weight is 2 everywhere, also at u = 0 (its limit).
    """
    if epsilon == 0:
        return torch.full_like(u, 2.0)
    outside = u > epsilon
    return torch.where(outside, 2 * (u - epsilon) / torch.where(outside, u, 1.0), 0.0)


class Status(StrEnum):
    """Outcome of a solver."""

    CONVERGED = "converged"
    MAX_ITER = "max_iter reached"
    STAGNATED = "no step decreases the objective any more"


@dataclass(frozen=True)
class Iteration:
    """State of the solver, passed to the callback after each iteration."""

    n_iter: int
    objective: float
    grad_norm: float
    step: float
    support_fraction: float


@dataclass(frozen=True)
class Solution:
    """Result of the solver: `coef` (n_features, n_outputs) and `intercept` (n_outputs,).

    `objective` and `grad_norm` are F and the norm of its gradient over W and b. `gap` is a proven
    bound on (F - F*) / F, on which the solver stops; `support_fraction` the fraction of the samples
    outside the tube; `objectives` holds F before the first and after every iteration, and never
    rises.
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


@dataclass(frozen=True)
class IRWLS:
    """The solver: minimises F over W and b, and bounds the distance from the optimum.

    It stops when ``gap`` falls to `tol`. `solver` is "newton" or "irwls". A step is slow if it
    leaves more than `slow_decrease` of the previous Newton decrement. The solver "newton" leaves
    the fixed equations after one slow step, and Newton's after ``MAX_SLOW_STEPS`` in a row.
    """

    C: float
    epsilon: float
    fit_intercept: bool = True
    max_iter: int = 200
    tol: float = 1e-8
    slow_decrease: float = 0.3
    solver: Literal["newton", "irwls"] = "newton"

    def minimise(
        self,
        design: Design,
        Y: Tensor,
        on_iteration: Callable[[Iteration], None] | None = None,
        start: Coefficients | None = None,
    ) -> Solution:
        """Return the minimiser of F and a bound on its distance from the optimum.

        `Y`: (n_samples, n_outputs); `start` is a point near the optimum, None is 0. Raises
        ValueError if a system is singular to working precision.
        """
        functional = Functional(design, self.C, self.epsilon, self.fit_intercept)
        equations = _Equations(design, self, is_near=start is not None)
        coef = torch.zeros(design.n_features, Y.shape[1], dtype=torch.float64, device=Y.device)
        intercept = torch.zeros_like(coef[0])
        residual = Y.double().clone()
        if start is not None:
            coef, intercept = start.coef.clone(), start.intercept.clone()
            residual -= design.matvec_rmatvec(start, lambda rows, moved: moved[:, :0])[0]
        objective, lower = functional.value(coef, residual), 0.0
        gradient = functional.gradient(coef, residual)
        objectives, n_iter, status = [objective], 0, Status.MAX_ITER
        # The loop ends: every pass increases n_iter, except that a step of 0 takes the next kind of
        # equations, and stops when each kind had one.
        while (gap := _gap(objective, lower)) > self.tol and n_iter < self.max_iter:
            direction = equations.direction(gradient, self.tol * objective)
            # One pass over the samples computes everything needed for the step, the next gradient
            # (after a full step) and the bound.
            columns = functional.columns(residual, gradient)
            change, products = design.matvec_rmatvec(direction, columns)
            # The bound holds for any direction; the best one so far proves the gap.
            bound = functional.lower_bound(objective, gradient, direction, change, products)
            lower = max(lower, bound)
            # The full step can raise F if epsilon is not small: backtrack until F decreases.
            decrement = functional.decrement(gradient, direction)
            step, objective = functional.backtrack(
                coef, residual, direction, change, objective, decrement
            )
            equations.follow(step, decrement)
            if equations.have_failed:
                gap, status = _gap(objective, lower), Status.STAGNATED
                break
            if step == 0:
                continue
            coef += step * direction.coef
            intercept += step * direction.intercept
            residual -= step * change
            product = products[:, : Y.shape[1]] if step == 1 else None
            gradient = functional.gradient(coef, residual, product)
            objectives.append(objective)
            n_iter += 1
            if on_iteration is not None:
                norm, support = functional.norm(gradient), _support(gradient)
                on_iteration(Iteration(n_iter, objective, norm, step, support))
        return Solution(
            design.coefficients(coef),
            intercept,
            objective,
            functional.norm(gradient),
            gap,
            _support(gradient),
            n_iter,
            Status.CONVERGED if gap <= self.tol else status,
            objectives,
        )


class _Equations:
    """The equations in use: the next kind after slow steps, without end if one kind is all."""

    def __init__(self, design: Design, solver: IRWLS, is_near: bool = False) -> None:
        self._slow_decrease = solver.slow_decrease
        self._kinds = KINDS[solver.solver]
        self._made = functools.cache(
            functools.partial(design.equations, C=solver.C, fit_intercept=solver.fit_intercept)
        )
        self._place = len(self._kinds) - 1 if is_near else 0
        self._n_slow = self._n_failed = 0
        self._decrement = float("inf")

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
        return self._made(self._kinds[self._place]).direction(gradient, accuracy)

    @property
    def have_failed(self) -> bool:
        """Whether every kind in turn gave a direction without a step."""
        return self._n_failed == len(self._kinds)

    def follow(self, step: float, decrement: float) -> None:
        """Take the next kind after a step of 0, a slow one of the fixed, or many of another."""
        is_slow = step == 0 or decrement > self._slow_decrease * self._decrement
        self._decrement, self._n_slow = decrement, self._n_slow + 1 if is_slow else 0
        self._n_failed = self._n_failed + 1 if step == 0 else 0
        patience = 1 if self._kinds[self._place] == "fixed" else MAX_SLOW_STEPS
        if step == 0 or self._n_slow >= patience:
            self._place, self._n_slow = (self._place + 1) % len(self._kinds), 0


@dataclass(frozen=True)
class Functional:
    """F on a design, its gradient, and a bound below it."""

    design: Design
    C: float
    epsilon: float
    fit_intercept: bool

    def value(self, coef: Tensor, residual: Tensor) -> float:
        """Return F."""
        losses = (self.C * loss(residual.norm(dim=1), self.epsilon)).sum()
        return float(0.5 * self.design.inner(coef, coef) + losses)

    def weights(self, residual: Tensor) -> Tensor:
        """Return the weights of Eq. (10), (n_samples,)."""
        return self.C * weight(residual.norm(dim=1), self.epsilon)

    def gradient(self, coef: Tensor, residual: Tensor, product: Tensor | None = None) -> Gradient:
        """Return g = W - Phi^T D_a R and -1^T D_a R; `product` is Phi^T D_a R if known."""
        weights = self.weights(residual)
        weighted = weights[:, None] * residual
        if product is None:
            product = self.design.rmatvec(weighted)
        offset = torch.zeros_like(coef[0])
        if self.fit_intercept:
            offset = -weighted.sum(dim=0)
        return Gradient(coef - product, offset, weights, residual)

    def norm(self, gradient: Gradient) -> float:
        """Return the Euclidean norm of a gradient over W and b."""
        squared = self.design.inner(gradient.coef, gradient.coef).clamp(min=0)
        return float((squared + gradient.intercept.square().sum()).sqrt())

    def columns(self, residual: Tensor, gradient: Gradient) -> Columns:
        """Return the columns that Phi^T multiplies for the next gradient and for the bound."""

        def make(rows: slice, change: Tensor) -> Tensor:
            weights = gradient.weights[rows, None]
            moved = residual[rows] - change
            weighted = self.weights(moved)[:, None] * moved
            return torch.cat([weighted, weights * change, weights], dim=1)

        return make

    def lower_bound(
        self,
        objective: float,
        gradient: Gradient,
        direction: Coefficients,
        change: Tensor,
        products: Tensor,
    ) -> float:
        """Return a value that F cannot fall below, from any direction d = (dW, db).

        L is convex in u^2, so the quadratic q of Eq. (9), with the Hessian B = I + [Phi 1]^T D_a
        [Phi 1], lies below F everywhere. Its minimum is at least q(d) - |r|^2 / 2, where r is the
        residual of the normal equations for W at d once b is eliminated, as B - I is positive
        semidefinite.
        """
        n_outputs = change.shape[1]
        weighted = gradient.weights[:, None] * change
        curvature, offset = (weighted * change).sum(), weighted.sum(dim=0)
        weight_sum = gradient.weights.sum()
        r = -(gradient.coef + direction.coef + products[:, n_outputs : 2 * n_outputs])
        inner = self.design.inner
        value = 0.5 * (inner(direction.coef, direction.coef) + curvature)
        value -= self.decrement(gradient, direction)
        if self.fit_intercept and weight_sum > 0:
            shift = -(gradient.intercept + offset) / weight_sum
            r -= torch.outer(products[:, -1], shift)
            value -= 0.5 * weight_sum * shift.square().sum()
        return float(objective + value - 0.5 * inner(r, r))

    def backtrack(
        self,
        coef: Tensor,
        residual: Tensor,
        direction: Coefficients,
        change: Tensor,
        objective: float,
        decrement: float,
    ) -> tuple[float, float]:
        """Return the first step of 1, 1/2, 1/4 .. that decreases F enough, and F; else (0, F)."""
        step = 1.0
        while step > SMALLEST_STEP:  # 34 halvings at most
            value = self.value(coef + step * direction.coef, residual - step * change)
            if value <= objective - SUFFICIENT_DECREASE * step * decrement:
                return step, value
            step /= 2
        return 0.0, objective

    def decrement(self, gradient: Gradient, direction: Coefficients) -> float:
        """Return -g . d, the rate at which F decreases along a direction."""
        inner = self.design.inner(gradient.coef, direction.coef)
        return float(-inner - (gradient.intercept * direction.intercept).sum())


def _support(gradient: Gradient) -> float:
    return float((gradient.weights > 0).double().mean())


def _gap(objective: float, lower: float) -> float:
    return max(objective - lower, 0.0) / max(objective, torch.finfo(torch.float64).tiny)
