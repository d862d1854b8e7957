"""Batched Levenberg-Marquardt: the least-squares fit of many rows at once.

The solver has three parts: `Descent` gives damped steps of the quadratic models of all rows,
`_Damping` adapts the damping of each row, and `LevenbergMarquardt` combines them and decides when a
row has converged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

Residual = Callable[[Tensor, Tensor], Tensor]
"""``residual(theta, rows)`` returns (n, n_points) for theta (n, n_parameters) and row indices (n,).

Each residual depends on its own row of theta only, and is differentiable in it."""
BEYOND = 20.0
"""Fits of curves search within this factor beyond the range of the training curves. At such a bound
nothing is known of a parameter."""
SMALLEST_DAMPING, LARGEST_DAMPING = 1e-12, 1e12
"""Range of the damping, relative to the diagonal of J^T J; a row stops at the largest."""
SMALLEST_SHRINKAGE, FIRST_GROWTH = 0.2, 2.0
"""Smallest factor on the damping after an accepted step, and the factor after a rejected one.

The second doubles with each further rejection."""
DIFFERENCE, ONE_SIDED_DIFFERENCE = 1e-4, 1e-5
"""Steps of central and of one-sided differences, for parameters of the order of 1.

Second differences of a shorter step would be mostly rounding."""
NEARLY_UNDAMPED = 1e-9  # damping of the step whose decrease tells whether a row has converged
PROBE, STEEPEST_BEND = 0.1, 0.75
"""Fraction of a step at which its acceleration is measured, and the largest acceleration over half
a step (Transtrum and Sethna): beyond it the step is rejected."""
SMALL_LEFT = 10.0
"""Largest decrease still possible, over `least_decrease`, at which a small step is convergence."""
AT_ONCE = 128
"""Smallest number of residuals of the Jacobian per call: a call for 1 takes as long as for 30."""


class RowStatus(IntEnum):
    """Why the fit of a row ended; the first two are convergence."""

    SMALL_STEP = 0  # every parameter moved by at most `tol` times 1 + |theta|
    SMALL_DECREASE = 1  # the next step would have lowered the cost by at most `least_decrease`
    MAX_ITER = 2  # the number of iterations was reached
    NO_DECREASE = 3  # no step lowers the cost: the damping reached its largest value
    NOT_FINITE = 4  # a residual at the parameters is not finite


@dataclass(frozen=True)
class LeastSquaresSolution:
    """One fit for each row: `parameters` (n_rows, n_parameters), `cost` (n_rows,).

    `information` is J^T J with J the derivative of the residuals at the parameters, `status`
    (n_rows,) holds values of ``RowStatus``.
    """

    parameters: Tensor
    cost: Tensor
    information: Tensor
    status: Tensor
    n_iter: int

    @property
    def converged(self) -> Tensor:
        """Whether a row ended by a small step or a small decrease, (n_rows,)."""
        return self.status <= RowStatus.SMALL_DECREASE


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Minimises 1/2 |r(theta)|^2 for each row separately, all rows at once.

    A step d solves (H + lambda diag H) d = -J^T r, where H is J^T J or J^T J + diag max(s, 0) with
    s_i = r^T d^2 r / d theta_i^2, whichever predicted the decrease of the previous step better (as
    NL2SOL: Dennis, Gay, Welsch, An adaptive nonlinear least-squares algorithm, 1981). The central
    differences of J also give the second derivatives. These shorten the steps along parameters in
    which the residuals are curved, where Gauss-Newton steps are too long and are rejected. The
    damping lambda follows the ratio of the decrease to the one predicted (Nielsen, Damping
    parameter in Marquardt's method, 1999).

    Rows that have converged take one more step. Two searches of the same row can differ by a whole
    step of length `tol`, as rounding decides whether a step of about that length ends them; the
    extra step reduces this difference twice by the rate of convergence of Gauss-Newton.

    A row has converged when every parameter moves by at most `tol` times 1 + |theta|, or when its
    next step would lower the cost by at most `least_decrease`. `first_damping` is relative to the
    diagonal of J^T J; a good start needs little. `bounds` are two tensors (n_parameters,); a
    parameter pressed against one counts as having no effect. `one_sided` differences need half the
    evaluations: the Jacobian is accurate to 1e-5, without second derivatives.

    `accelerated` steps follow a bent valley: half the second derivative of the residuals along a
    step d, projected as the step is, -(H + lambda diag H)^-1 J^T r''(d, d) / 2, is added to it
    (Transtrum and Sethna, Improvements to the Levenberg-Marquardt algorithm, 2012). It takes one
    more evaluation a step and stores the Jacobian of every row.
    """

    max_iter: int = 100
    tol: float = 1e-8
    first_damping: float = 1e-3
    bounds: tuple[Tensor, Tensor] | None = None
    one_sided: bool = False
    least_decrease: float = 0.0
    accelerated: bool = False

    def minimise(self, residual: Residual, start: Tensor) -> LeastSquaresSolution:
        """Return the fit of each row from `start`, (n_rows, n_parameters)."""
        bounds = self.bounds
        if bounds is None:
            bounds = start.new_full((1,), -math.inf), start.new_full((1,), math.inf)
        descent = Descent(residual, start, bounds, self.one_sided, self.accelerated)
        damping = _Damping(start.new_full((len(start),), self.first_damping))
        all_rows = rows = torch.arange(len(start), device=start.device)
        status = torch.full_like(rows, RowStatus.MAX_ITER)  # of rows that have not ended
        n_iter = 0
        while n_iter < self.max_iter and len(rows):
            n_iter += 1
            trial = descent.trial(rows, damping.value[rows])
            better = (trial.decrease >= 0) & trial.solved
            damping.follow(rows, better, trial.ratio)
            status[rows] = self._status(trial, better, damping.value[rows])
            descent.take(rows, better, trial)
            rows = rows[status[rows] == RowStatus.MAX_ITER]
        trial = descent.trial(all_rows, damping.value)
        # Such a small step changes the cost by about its rounding, which must not reject the step.
        last = (status <= RowStatus.SMALL_DECREASE) & trial.solved & trial.is_small(self.tol)
        last &= trial.cost <= trial.cost_before * (1 + 1e-12)
        descent.take(all_rows, last, trial)
        descent.linearise()
        cost = _cost(descent.values)
        status[~torch.isfinite(cost)] = RowStatus.NOT_FINITE
        return LeastSquaresSolution(descent.theta, cost, descent.information, status, n_iter)

    def _status(self, trial: _Trial, better: Tensor, damping: Tensor) -> Tensor:
        """Return the status of rows after a trial, MAX_ITER of those that have not ended."""
        status = torch.full_like(damping, RowStatus.MAX_ITER, dtype=torch.int64)
        status[damping >= LARGEST_DAMPING] = RowStatus.NO_DECREASE
        if self.least_decrease:
            is_low = torch.isfinite(trial.left) & (trial.left <= self.least_decrease)
            status[is_low] = RowStatus.SMALL_DECREASE
        # A small step that raises the cost means convergence only if damping did not shorten it.
        is_small = trial.is_small(self.tol) & trial.solved & (better | (damping < 1))
        # a step may be small in a bent valley far from its lowest point
        if self.accelerated and self.least_decrease:
            is_small &= trial.left <= SMALL_LEFT * self.least_decrease
        status[is_small] = RowStatus.SMALL_STEP
        return status


@dataclass(frozen=True)
class _Trial:
    """Proposed steps of some rows, and the decrease that the quadratic models predict for them."""

    before: Tensor
    theta: Tensor
    values: Tensor
    solved: Tensor
    cost_before: Tensor
    predicted: Tensor
    left: Tensor
    """-g^T d / 2 of the step d before bounds shorten it, undamped if steps are accelerated: about
    the decrease still possible."""

    @property
    def cost(self) -> Tensor:
        return _cost(self.values)

    @property
    def decrease(self) -> Tensor:
        return self.cost_before - self.cost

    @property
    def ratio(self) -> Tensor:
        return self.decrease / self.predicted

    def is_small(self, tol: float) -> Tensor:
        """Return whether no parameter of a row moves by more than `tol` times 1 + |theta|."""
        step = self.theta - self.before
        return (step.abs() <= tol * (1 + self.before.abs())).all(dim=1)


class Descent:
    """The point of every row and its quadratic models, recomputed only for rows that moved."""

    def __init__(
        self,
        residual: Residual,
        start: Tensor,
        bounds: tuple[Tensor, Tensor],
        one_sided: bool,
        accelerated: bool,
    ) -> None:
        self.residual, self.bounds, self.one_sided = residual, bounds, one_sided
        rows = torch.arange(len(start), device=start.device)
        self.theta = start.clamp(*bounds)
        self.values = residual(self.theta, rows)
        self.jacobian: Tensor | None = None
        if accelerated:
            self.jacobian = self.values.new_zeros(*self.theta.shape, self.values.shape[1])
        self.gradient, self.second = torch.zeros_like(self.theta), torch.zeros_like(self.theta)
        self.information = self.theta.new_zeros(*self.theta.shape, self.theta.shape[1])
        self.is_curved = torch.zeros_like(rows, dtype=torch.bool)
        self._moved = torch.ones_like(rows, dtype=torch.bool)

    def linearise(self) -> None:
        """Compute gradient, J^T J and second derivatives of rows that moved."""
        rows = self._moved.nonzero()[:, 0]
        if not len(rows):
            return
        theta, values, (low, high) = self.theta[rows], self.values[rows], self.bounds
        jacobian, second = derivatives(self.residual, theta, rows, values, self.one_sided)
        slope = (jacobian @ values[:, :, None])[:, :, 0]
        # A parameter pressed against a bound cannot move: it is left out of this row's model.
        pressed = ((theta <= low) & (slope > 0)) | ((theta >= high) & (slope < 0))
        jacobian = jacobian.masked_fill(pressed[:, :, None], 0.0)
        if self.jacobian is not None:
            self.jacobian[rows] = jacobian
        self.gradient[rows] = slope.masked_fill(pressed, 0.0)
        self.information[rows] = jacobian @ jacobian.transpose(1, 2)
        self.second[rows] = second.clamp(min=0).masked_fill(pressed, 0.0)
        self._moved[rows] = False

    def trial(self, rows: Tensor, damping: Tensor) -> _Trial:
        """Return damped steps, and select for each row the model that predicted its step better."""
        self.linearise()
        before, gradient, plain = self.theta[rows], self.gradient[rows], self.information[rows]
        is_curved, curvature = self.is_curved[rows], torch.diag_embed(self.second[rows])
        hessian = plain + is_curved[:, None, None] * curvature
        step, solved = _damped_step(gradient, hessian, damping)
        straight = theta = (before + step).clamp(*self.bounds)
        if self.jacobian is not None:
            # along the step that the bounds leave: beyond them values overflow
            bend, is_slight = self.bend(rows, straight - before, hessian, damping)
            # a parameter bent away from its bound by a hair would count as free, and shorten all
            # further steps: the row would end short of its minimum (Bertsekas, SIAM J. Control
            # Optim. 20, 1982)
            low, high = self.bounds
            bend = bend.masked_fill((straight <= low) | (straight >= high), 0.0)
            theta, solved = (straight + bend).clamp(*self.bounds), solved & is_slight
        values = self.residual(theta, rows)
        cost_before = _cost(self.values[rows])
        decrease = cost_before - _cost(values)
        by_plain = _model_decrease(gradient, plain, straight - before)
        by_curved = _model_decrease(gradient, plain + curvature, straight - before)
        self.is_curved[rows] = (decrease - by_curved).abs() < (decrease - by_plain).abs()
        predicted = torch.where(is_curved, by_curved, by_plain)
        whole = step
        if self.jacobian is not None:  # a valley is bent: damped steps in it are short
            whole, _ = _damped_step(gradient, plain, torch.full_like(damping, NEARLY_UNDAMPED))
        left = -0.5 * (gradient * whole).sum(dim=1)
        return _Trial(before, theta, values, solved, cost_before, predicted, left)

    def bend(
        self, rows: Tensor, step: Tensor, hessian: Tensor, damping: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return half the geodesic acceleration along steps, and whether it is slight enough."""
        assert self.jacobian is not None
        before, values, jacobian = self.theta[rows], self.values[rows], self.jacobian[rows]
        probed = self.residual(before + PROBE * step, rows)
        straight = (step[:, None] @ jacobian)[:, 0]
        second = (2 / PROBE) * ((probed - values) / PROBE - straight)
        slope = (jacobian @ second[:, :, None])[:, :, 0]
        bend = 0.5 * _damped_step(slope, hessian, damping)[0]
        scale = hessian.diagonal(dim1=1, dim2=2)
        bend_size, step_size = ((scale * v.square()).sum(dim=1).sqrt() for v in (bend, step))
        is_slight = 4 * bend_size <= STEEPEST_BEND * step_size
        usable = (is_slight & torch.isfinite(bend).all(dim=1))[:, None]
        return torch.where(usable, bend, 0.0), is_slight

    def take(self, rows: Tensor, taken: Tensor, trial: _Trial) -> None:
        """Move the rows whose steps are `taken` to the end of their steps."""
        self.theta[rows] = torch.where(taken[:, None], trial.theta, self.theta[rows])
        self.values[rows] = torch.where(taken[:, None], trial.values, self.values[rows])
        self._moved[rows] = taken


class _Damping:
    """The damping of every row, by Nielsen's rule."""

    def __init__(self, first: Tensor) -> None:
        self.value, self._growth = first, torch.full_like(first, FIRST_GROWTH)

    def follow(self, rows: Tensor, better: Tensor, ratio: Tensor) -> None:
        """Scale the damping by how well the decrease was predicted; raise it after a rejection."""
        shrinkage = (1 - (2 * ratio.nan_to_num(1.0) - 1) ** 3).clamp(SMALLEST_SHRINKAGE, 2.0)
        factor = torch.where(better, shrinkage, self._growth[rows])
        self._growth[rows] = torch.where(better, FIRST_GROWTH, 2 * self._growth[rows])
        self.value[rows] = (self.value[rows] * factor).clamp(SMALLEST_DAMPING, LARGEST_DAMPING)


def _cost(values: Tensor) -> Tensor:
    return 0.5 * values.square().sum(dim=1)


def _model_decrease(gradient: Tensor, hessian: Tensor, step: Tensor) -> Tensor:
    """Return the decrease -g^T d - d^T H d / 2 of the quadratic model for a step of each row."""
    slope = gradient + 0.5 * (hessian @ step[:, :, None])[:, :, 0]
    decrease: Tensor = -(slope * step).sum(dim=1)
    return decrease


def _damped_step(gradient: Tensor, hessian: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Return -(H + damping diag H)^-1 g, 0 for singular rows, and which rows are solved."""
    # Damping times the diagonal must have a reciprocal, or a parameter of no effect stops its row.
    smallest = torch.finfo(hessian.dtype).tiny / SMALLEST_DAMPING
    scale = hessian.diagonal(dim1=1, dim2=2).clamp(min=smallest)
    system = hessian + torch.diag_embed(damping[:, None] * scale)
    step, info = torch.linalg.solve_ex(system, -gradient[:, :, None])
    solved = (info == 0) & torch.isfinite(step[:, :, 0]).all(dim=1)
    return torch.where(solved[:, None], step[:, :, 0], 0.0), solved


def derivatives(
    residual: Callable[[Tensor, Tensor], Tensor],
    theta: Tensor,
    rows: Tensor,
    values: Tensor,
    one_sided: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return d r / d theta_i and r^T d^2 r / d theta_i^2 by differences; `values` is r at `theta`.

    Shapes (n, n_parameters, n_points) and (n, n_parameters); the second is 0 for one-sided
    differences. These are accurate to about 1e-5, central ones to 1e-8. On a CPU differences take a
    fifth of the time of dual numbers.
    """
    n_rows = len(theta)
    size = ONE_SIDED_DIFFERENCE if one_sided else DIFFERENCE
    unit_steps = size * torch.eye(theta.shape[1], dtype=theta.dtype, device=theta.device)
    columns, second = [], []
    for steps in unit_steps.split(max(1, AT_ONCE // n_rows)):
        repeated = rows.repeat(len(steps))
        moved = (theta + steps[:, None]).flatten(0, 1)
        above = residual(moved, repeated).unflatten(0, (-1, n_rows))
        below = values
        if not one_sided:
            moved = (theta - steps[:, None]).flatten(0, 1)
            below = residual(moved, repeated).unflatten(0, (-1, n_rows))
        columns.append(above - below)
        bent = torch.zeros_like(columns[-1]) if one_sided else above + below - 2 * values
        second.append((bent * values).sum(dim=2))
    jacobian = torch.cat(columns).transpose(0, 1) / (size if one_sided else 2 * size)
    return jacobian, torch.cat(second).T / size**2
