"""Batched Levenberg-Marquardt: direct least-squares fit of a model's curves, beyond the paper.

It is the model-based method a structural dynamicist would pick instead of a regression.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from sklearn.base import BaseEstimator
from torch import Tensor

from suspnet.ground.settings import Setting, check_values
from suspnet.ground.types import FloatArray

Forward = Callable[[Tensor, Tensor], Tensor]
SMALLEST_DAMPING, LARGEST_DAMPING = 1e-12, 1e12
"""Range of the damping, relative to the diagonal of J^T J; a row whose damping reaches an end
stops."""
SMALLEST_SHRINKAGE, FIRST_GROWTH = 0.2, 2.0
"""Smallest factor on the damping after a step that is taken, and factor after the first one that is
not, which doubles with each further one."""
DIFFERENCE, ONE_SIDED_DIFFERENCE = 1e-4, 1e-5
"""Steps of central and of one-sided differences; parameters are of the order of 1. A shorter step
would leave less of the second differences than their rounding."""
AT_ONCE = 128
"""Residuals of the Jacobian evaluated in one call at least: those of one row take as long as 30."""


@dataclass(frozen=True)
class LeastSquaresSolution:
    """One fit for each row of the data.

    Attributes
    ----------
    parameters : tensor of shape (n_rows, n_parameters)
    cost : tensor of shape (n_rows,)
        Half the sum of squared residuals.
    information : tensor of shape (n_rows, n_parameters, n_parameters)
        J^T J, with J the derivative of the residuals at the parameters.
    converged : bool tensor of shape (n_rows,)
    n_iter : int
    """

    parameters: Tensor
    cost: Tensor
    information: Tensor
    converged: Tensor
    n_iter: int


def levenberg_marquardt(
    residual: Callable[[Tensor, Tensor], Tensor],
    start: Tensor,
    *,
    max_iter: int = 100,
    tol: float = 1e-8,
    first_damping: float = 1e-3,
    bounds: tuple[Tensor, Tensor] | None = None,
    one_sided: bool = False,
    least_decrease: float = 0.0,
) -> LeastSquaresSolution:
    """Minimise 1/2 |r(theta)|^2 for each row on its own, all rows at once.

    A step d solves (H + lambda diag H) d = -J^T r, where H is J^T J or J^T J + diag max(s, 0) with
    s_i = r^T d^2 r / d theta_i^2, whichever predicted the decrease by the step before better (as
    NL2SOL: Dennis, Gay, Welsch, An adaptive nonlinear least-squares algorithm, 1981). The second
    derivatives come with the central differences of J. They shorten the steps along parameters in
    which the residuals are curved, where those of Gauss-Newton are too long and are not taken. The
    damping lambda follows the ratio of the decrease to the one predicted (Nielsen, Damping
    parameter in Marquardt's method, 1999).

    Rows that have converged take one step more. Two searches of the same row can differ by a whole
    step of length `tol`, as rounding decides whether one of about that length ends them; the step
    more reduces this difference twice by the rate of convergence of Gauss-Newton.

    Parameters
    ----------
    residual : callable
        ``residual(theta, rows)`` gives (n, n_points) residuals for theta (n, n_parameters) and
        the indices (n,) of the rows it belongs to; row by row, differentiable in theta.
    start : tensor of shape (n_rows, n_parameters)
    max_iter : int
    tol : float
        A row has converged when every parameter moves by less than this (relative to 1 + |theta|).
    first_damping : float
        Of the first step, relative to the diagonal of J^T J; a good start needs little.
    bounds : pair of tensors of shape (n_parameters,), optional
        Lower and upper. A parameter that is pressed against one counts as having no effect.
    one_sided : bool
        Half the evaluations, for a Jacobian that is right to 1e-5 and no second derivatives.
    least_decrease : float
        A row has also converged when its next step would lower the cost by no more: for
        residuals in units of the noise, by a hundredth of what the noise does, say.

    Returns
    -------
    LeastSquaresSolution
    """
    low, high = bounds or (start.new_full((1,), -math.inf), start.new_full((1,), math.inf))

    everything = rows = torch.arange(len(start), device=start.device)
    theta = start.clamp(low, high)
    values = residual(theta, rows)
    gradient, second = torch.zeros_like(theta), torch.zeros_like(theta)
    information = theta.new_zeros(*theta.shape, theta.shape[1])
    moved = torch.ones_like(rows, dtype=torch.bool)

    def linearise() -> None:
        """Renew gradient, J^T J and second derivatives of rows that moved.

        Parameters that are pressed against a bound are left out.
        """
        which = moved.nonzero()[:, 0]
        if not len(which):
            return
        here, there = theta[which], values[which]
        jacobian, curved = _derivatives(residual, here, which, there, one_sided)
        slope = (jacobian @ there[:, :, None])[:, :, 0]
        pressed = ((here <= low) & (slope > 0)) | ((here >= high) & (slope < 0))
        jacobian = jacobian.masked_fill(pressed[:, :, None], 0.0)
        gradient[which] = slope.masked_fill(pressed, 0.0)
        information[which] = jacobian @ jacobian.transpose(1, 2)
        second[which] = curved.clamp(min=0).masked_fill(pressed, 0.0)
        moved[which] = False

    def move(which: Tensor, taken: Tensor, trial: Tensor, trial_values: Tensor) -> None:
        """Let rows take their steps, where these are taken."""
        theta[which] = torch.where(taken[:, None], trial, theta[which])
        values[which] = torch.where(taken[:, None], trial_values, values[which])
        moved[which] = taken

    damping = theta.new_full((len(start),), first_damping)
    growth = torch.full_like(damping, FIRST_GROWTH)
    is_curved = torch.zeros_like(rows, dtype=torch.bool)
    converged = torch.zeros_like(rows, dtype=torch.bool)
    n_iter = 0
    while n_iter < max_iter and len(rows):
        n_iter += 1
        linearise()
        here, here_cost = theta[rows], _cost(values[rows])
        curvature = torch.diag_embed(second[rows])
        hessian = information[rows] + is_curved[rows, None, None] * curvature
        step, solved = _damped_step(gradient[rows], hessian, damping[rows])
        trial = (here + step).clamp(low, high)
        trial_values = residual(trial, rows)
        decrease = here_cost - _cost(trial_values)
        better = (decrease >= 0) & solved
        plain = _model_decrease(gradient[rows], information[rows], trial - here)
        curved = _model_decrease(gradient[rows], information[rows] + curvature, trial - here)
        ratio = decrease / torch.where(is_curved[rows], curved, plain)
        is_curved[rows] = (decrease - curved).abs() < (decrease - plain).abs()
        shrinkage = (1 - (2 * ratio.nan_to_num(1.0) - 1) ** 3).clamp(SMALLEST_SHRINKAGE, 2.0)
        factor = torch.where(better, shrinkage, growth[rows])
        growth[rows] = torch.where(better, FIRST_GROWTH, 2 * growth[rows])
        damping[rows] = (damping[rows] * factor).clamp(SMALLEST_DAMPING, LARGEST_DAMPING)
        small = _is_small(trial - here, here, tol) & solved
        converged[rows] = small & (better | (damping[rows] < 1))
        if least_decrease:
            left = -0.5 * (gradient[rows] * step).sum(dim=1)
            converged[rows] |= solved & (left <= least_decrease)
        move(rows, better, trial, trial_values)
        rows = rows[~converged[rows] & (damping[rows] < LARGEST_DAMPING)]
    linearise()
    hessian = information + torch.diag_embed(is_curved[:, None] * second)
    step, solved = _damped_step(gradient, hessian, damping)
    trial = (theta + step).clamp(low, high)
    trial_values = residual(trial, everything)
    # so small a step changes the cost by no more than its rounding, which must not decide
    taken = converged & solved & _is_small(trial - theta, theta, tol)
    taken &= _cost(trial_values) <= _cost(values) * (1 + 1e-12)
    move(everything, taken, trial, trial_values)
    linearise()
    return LeastSquaresSolution(theta, _cost(values), information, converged, n_iter)


def _cost(values: Tensor) -> Tensor:
    """Return half the sum of squares of each row."""
    return 0.5 * values.square().sum(dim=1)


def _model_decrease(gradient: Tensor, hessian: Tensor, step: Tensor) -> Tensor:
    """Return the decrease -g^T d - d^T H d / 2 of the quadratic model for a step of each row."""
    slope = gradient + 0.5 * (hessian @ step[:, :, None])[:, :, 0]
    decrease: Tensor = -(slope * step).sum(dim=1)
    return decrease


def _is_small(step: Tensor, theta: Tensor, tol: float) -> Tensor:
    """Return whether no parameter of a row moves by more than `tol` relative to 1 + |theta|."""
    return (step.abs() <= tol * (1 + theta.abs())).all(dim=1)


def _damped_step(gradient: Tensor, hessian: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Return -(H + damping diag H)^-1 g, or 0 where that is singular, and where it is not."""
    # damping times the diagonal must have a reciprocal, or a parameter of no effect stops its row
    smallest = torch.finfo(hessian.dtype).tiny / SMALLEST_DAMPING
    scale = hessian.diagonal(dim1=1, dim2=2).clamp(min=smallest)
    system = hessian + torch.diag_embed(damping[:, None] * scale)
    step, info = torch.linalg.solve_ex(system, -gradient[:, :, None])
    solved = (info == 0) & torch.isfinite(step[:, :, 0]).all(dim=1)
    return torch.where(solved[:, None], step[:, :, 0], 0.0), solved


class CurveFit(BaseEstimator):  # type: ignore[misc]
    """Fit a model's curves directly, starting from the nearest of a set of scattered curves.

    Raises
    ------
    TypeError, ValueError
        If a parameter is out of range.
    """

    settings: ClassVar[Mapping[str, Setting]] = {
        "n_starts": Setting(
            "Number of points scattered over the parameter range; the one with the nearest curves "
            "is "
            "the start of the fit",
            low=1,
        ),
        "max_iter": Setting("Largest number of Levenberg-Marquardt iterations", low=1),
        "tol": Setting("Change of every log-parameter below which the fit has converged", above=0),
    }
    """What each argument means and which values it takes."""

    works_on_curves: ClassVar[bool] = True
    distributable: ClassVar[bool] = False
    gives_deviations: ClassVar[bool] = False

    def __init__(self, n_starts: int = 512, max_iter: int = 100, tol: float = 1e-8) -> None:
        check_values(CurveFit, n_starts=n_starts, max_iter=max_iter, tol=tol)
        self.n_starts = n_starts
        self.max_iter = max_iter
        self.tol = tol

    def state(self) -> dict[str, FloatArray]:
        """Return no arrays: the method has parameters only."""
        return {}

    def fit_curves(
        self, forward: Forward, observed: Tensor, known: Tensor, lower: float, upper: float, n: int
    ) -> LeastSquaresSolution:
        """Return the positive parameters whose curves lie nearest to those observed.

        The residual of each curve is divided by its rms, to which the noise is proportional.

        Parameters
        ----------
        forward : callable
            ``forward(parameters, known)`` gives curves (n_rows, n_curves, n_points).
        observed : tensor of shape (n_rows, n_curves, n_points)
        known : tensor of shape (n_rows, n_known)
            What is known of each row.
        lower, upper : float
            Range of the starts.
        n : int
            Number of parameters.
        """
        scale = observed.square().mean(dim=2, keepdim=True).sqrt()

        def residual(log_parameters: Tensor, rows: Tensor) -> Tensor:
            curves = forward(log_parameters.exp(), known[rows])
            return ((observed[rows] - curves) / scale[rows]).flatten(1)

        start = self._nearest_start(forward, observed, known, scale, (lower, upper), n)
        solution = levenberg_marquardt(residual, start.log(), max_iter=self.max_iter, tol=self.tol)
        return LeastSquaresSolution(
            solution.parameters.exp(),
            solution.cost,
            solution.information,
            solution.converged,
            solution.n_iter,
        )

    def _nearest_start(
        self,
        forward: Forward,
        observed: Tensor,
        known: Tensor,
        scale: Tensor,
        start_range: tuple[float, float],
        n: int,
    ) -> Tensor:
        """Return for each row the Sobol point whose curves lie nearest to the row's."""
        lower, upper = start_range
        points = torch.quasirandom.SobolEngine(n).draw(self.n_starts, dtype=torch.float64)
        starts = torch.exp(math.log(lower) + points.to(observed) * math.log(upper / lower))
        mean_known = known.mean(dim=0, keepdim=True).expand(len(starts), -1)
        curves = forward(starts, mean_known).flatten(1)
        shape = observed.shape
        weights = (1 / scale.square()).expand(shape).flatten(1)
        flat = observed.flatten(1)
        misfit = weights @ curves.square().T - 2 * (weights * flat) @ curves.T
        return starts[misfit.argmin(dim=1)]


def _derivatives(
    residual: Callable[[Tensor, Tensor], Tensor],
    theta: Tensor,
    rows: Tensor,
    values: Tensor,
    one_sided: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return derivatives of the residuals r by differences, with `values` those at `theta`.

    On a CPU differences take a fifth of the time of dual numbers. One-sided ones are right to about
    1e-5, central ones to 1e-8.

    Returns
    -------
    jacobian : tensor of shape (n, n_parameters, n_points)
        d r / d theta_i.
    second : tensor of shape (n, n_parameters)
        r^T d^2 r / d theta_i^2; 0 of one-sided differences.
    """
    n_rows = len(theta)
    size = ONE_SIDED_DIFFERENCE if one_sided else DIFFERENCE
    every = size * torch.eye(theta.shape[1], dtype=theta.dtype, device=theta.device)
    columns, second = [], []
    for steps in every.split(max(1, AT_ONCE // n_rows)):
        which = rows.repeat(len(steps))
        above = residual((theta + steps[:, None]).flatten(0, 1), which).unflatten(0, (-1, n_rows))
        below = values
        if not one_sided:
            moved = (theta - steps[:, None]).flatten(0, 1)
            below = residual(moved, which).unflatten(0, (-1, n_rows))
        columns.append(above - below)
        bent = torch.zeros_like(columns[-1]) if one_sided else above + below - 2 * values
        second.append((bent * values).sum(dim=2))
    jacobian = torch.cat(columns).transpose(0, 1) / (size if one_sided else 2 * size)
    return jacobian, torch.cat(second).T / size**2
