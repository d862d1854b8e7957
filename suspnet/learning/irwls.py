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
        Half the gradient's squared norm in the inverse of the reweighted Hessian, relative to F:
        the solver's estimate of (F - F*) / F, and its stopping rule.
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
