"""The methods MSVR is compared with: an SVR for each output, linear regression, and a direct fit.

`CurveFit` fits the model's curves directly, the usual approach in structural dynamics.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import torch
from joblib import Parallel, delayed
from numpy.typing import ArrayLike
from sklearn import kernel_ridge, linear_model, svm
from sklearn.base import BaseEstimator
from sklearn.metrics.pairwise import rbf_kernel
from sklearn.utils import gen_batches
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from suspnet.ground.settings import Checked, setting
from suspnet.ground.types import FloatArray
from suspnet.learning.least_squares import (
    BEYOND,
    LeastSquaresSolution,
    LevenbergMarquardt,
    Residual,
    RowStatus,
)
from suspnet.learning.regressor import MethodFlags, Regressor, arrays_of

Forward = Callable[[Tensor, Tensor], Tensor]
"""``forward(parameters, known_parameters)`` returns curves (n_rows, n_curves, n_points)."""
COMPRESSED, ROUGH_TOL, ROUGH_ITER = 0.05, 1e-3, 20
"""A curve, in units of its rms, above which it counts by its logarithm in the first search of
`CurveFit`, and the tolerance and number of iterations of that search."""
RULED_OUT = 10.0
"""A model whose cost after the first search exceeds the least one by this factor is ruled out."""
PREDICT_ROWS = 1024  # rows predicted at once, so that their kernel fits into memory


@dataclass(repr=False, eq=False)
class SVR(Regressor):
    """One epsilon-insensitive support vector regression for each output (scikit-learn's libsvm).

    Kernel ``exp(-|x - z|^2 / sigma^2)`` as in `MSVR`. The loss is linear outside the tube. Each
    output needs one to some hundred times as many iterations as there are samples; a `tol` below
    rounding never ends by itself. `callback` gets the number of outputs fitted so far.

    A fit sets, for each output, `support_vectors_` (n_support, n_inputs) and `dual_coef_`
    (n_support,), `intercept_` and `n_iter_` (n_outputs,), the mean `support_fraction_`, and
    `converged_`; it warns with ConvergenceWarning if `tol` was not reached.
    """

    C: float = setting(
        10.0, "Penalty of residuals outside the tube, as tuned for the group", above=0
    )
    sigma: float = setting(
        3.0, "Width of the kernel exp(-|x - z|²/sigma²)", "scaled inputs", above=0
    )
    epsilon: float = setting(
        1e-3, "Half width of the tube within which residuals cost nothing", "scaled outputs", low=0
    )
    tol: float = setting(1e-3, "Stopping tolerance of libsvm", above=0)
    max_iter: int = setting(
        10_000_000, "Number of libsvm's iterations for each output after which it gives up", low=1
    )
    cache_size_mb: float = setting(
        400.0, "Size of libsvm's kernel cache for each output", "MB", above=0
    )
    n_jobs: int | None = setting(
        2,
        "Number of outputs that are fitted at the same time, in threads; -1 is one for each core",
        rule="whole number; not 0",
    )
    callback: Callable[[int], None] | None = setting(
        None, "Function called after each output, which train.py sets itself", rule="null"
    )

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit one machine for each column of `y`, (n_samples,) or (n_samples, n_outputs)."""
        samples, targets = self._training_data(X, y)
        machines = Parallel(self.n_jobs, prefer="threads", return_as="generator")(
            delayed(self._fit_output)(samples, column) for column in targets.T
        )
        fitted = []
        for machine in machines:
            fitted.append(machine)
            if self.callback is not None:
                self.callback(len(fitted))
        self.support_vectors_ = [np.ascontiguousarray(m.support_vectors_) for m in fitted]
        self.dual_coef_ = [np.ascontiguousarray(machine.dual_coef_[0]) for machine in fitted]
        self.intercept_ = np.array([float(machine.intercept_[0]) for machine in fitted])
        self.support_fraction_ = float(np.mean([len(c) for c in self.dual_coef_]) / len(samples))
        self.n_iter_ = np.array([int(machine.n_iter_) for machine in fitted])
        self.converged_ = all(machine.fit_status_ == 0 for machine in fitted)
        return self

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return predictions, shape (n_samples,) or (n_samples, n_outputs)."""
        samples = self._inputs(X)
        predicted = np.zeros((len(samples), len(self.intercept_)))
        machines = zip(self.support_vectors_, self.dual_coef_, strict=True)
        for j, (vectors, dual) in enumerate(machines):
            if len(dual):  # a constant output has no support vector
                predicted[:, j] = _kernel_expansion(samples, vectors, dual, self.sigma)
        return self._as_trained(predicted + self.intercept_)

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays that define the fitted model together with the parameters."""
        intercept = self._stored("intercept_")
        arrays = {f"support_vectors.{j}": v for j, v in enumerate(self.support_vectors_)}
        arrays |= {f"dual_coef.{j}": v for j, v in enumerate(self.dual_coef_)}
        return arrays | {"intercept": intercept}

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Load the arrays of `state`; ValueError if they are missing or inconsistent."""
        with arrays_of("an SVR"):
            self.intercept_ = self._restored(state["intercept"])
            outputs = range(len(self.intercept_))
            self.support_vectors_ = [state[f"support_vectors.{j}"] for j in outputs]
            self.dual_coef_ = [state[f"dual_coef.{j}"] for j in outputs]
        pairs = zip(self.support_vectors_, self.dual_coef_, strict=True)
        if any(len(vectors) != len(dual) for vectors, dual in pairs):
            raise ValueError("support vectors and dual coefficients differ in number")
        self.n_features_in_ = self.support_vectors_[0].shape[1]
        return self

    def _fit_output(self, X: FloatArray, y: FloatArray) -> Any:
        machine = svm.SVR(
            kernel="rbf",
            gamma=1 / self.sigma**2,
            C=self.C,
            epsilon=self.epsilon,
            tol=self.tol,
            max_iter=self.max_iter,
            cache_size=self.cache_size_mb,
        )
        return machine.fit(X, y)


def _kernel_expansion(
    X: FloatArray, vectors: FloatArray, dual: FloatArray, sigma: float
) -> FloatArray:
    """Return sum_j exp(-|x_i - v_j|^2 / sigma^2) dual_j, a block of rows at a time."""
    expansion = np.empty((len(X), *dual.shape[1:]))
    for rows in gen_batches(len(X), PREDICT_ROWS):
        expansion[rows] = rbf_kernel(X[rows], vectors, gamma=1 / sigma**2) @ dual
    return expansion


@dataclass(repr=False, eq=False)
class KernelRidge(Regressor):
    """Kernel ridge regression (scikit-learn's), which MSVR is without a tube.

    Minimises ``1/2 |W|^2 + C sum_i |y_i - W^T phi(x_i) - b|^2`` with b the mean of the outputs, so
    with the letters of `MSVR`: alpha = 1 / (2 C), gamma = 1 / sigma^2. A fit sets ``dual_coef_``
    (n_samples, n_outputs), ``X_fit_`` (n_samples, n_inputs) and ``intercept_`` (n_outputs,).
    """

    C: float = setting(100.0, "Penalty of residuals, as tuned for the group", above=0)
    sigma: float = setting(
        3.0, "Width of the kernel exp(-|x - z|²/sigma²)", "scaled inputs", above=0
    )

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to samples (n_samples, n_inputs) and outputs (n_samples,) or (.., n_outputs)."""
        samples, targets = self._training_data(X, y)
        self.intercept_ = targets.mean(axis=0)
        alpha, gamma = 1 / (2 * self.C), 1 / self.sigma**2
        machine = kernel_ridge.KernelRidge(alpha=alpha, kernel="rbf", gamma=gamma)
        machine.fit(samples, targets - self.intercept_)
        self.dual_coef_, self.X_fit_ = machine.dual_coef_, np.ascontiguousarray(samples)
        return self

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return predictions, shape (n_samples,) or (n_samples, n_outputs) as `y` was."""
        predicted = _kernel_expansion(self._inputs(X), self.X_fit_, self.dual_coef_, self.sigma)
        return self._as_trained(predicted + self.intercept_)

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays of the fitted model."""
        intercept = self._stored("intercept_")
        return {"dual_coef": self.dual_coef_, "X_fit": self.X_fit_, "intercept": intercept}

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Load the arrays of `state`; ValueError if they are missing or inconsistent."""
        with arrays_of("a ridge"):
            self.dual_coef_, self.X_fit_ = state["dual_coef"], state["X_fit"]
            self.intercept_ = self._restored(state["intercept"])
        if self.dual_coef_.shape != (len(self.X_fit_), len(self.intercept_)):
            raise ValueError(
                f"dual_coef has shape {self.dual_coef_.shape}, X_fit {self.X_fit_.shape}"
            )
        self.n_features_in_ = self.X_fit_.shape[1]
        return self


class LinearRegression(MethodFlags, linear_model.LinearRegression):  # type: ignore[misc]
    """Ordinary least squares with an intercept (scikit-learn's), the paper's MV-LR."""

    coef_: FloatArray

    def __init__(self) -> None:
        super().__init__()

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to samples (n_samples, n_inputs) and outputs (n_samples,) or (.., n_outputs)."""
        super().fit(X, y)
        # A restored model must see the same memory layout to predict bit for bit.
        self.coef_ = np.ascontiguousarray(self.coef_)
        return self

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays of the fitted model."""
        check_is_fitted(self)
        return {"coef": self.coef_, "intercept": np.asarray(self.intercept_)}

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Load the arrays of `state`; ValueError if they are missing or inconsistent."""
        with arrays_of("a linear"):
            self.coef_, self.intercept_ = state["coef"], state["intercept"]
        if not self.coef_.ndim or self.coef_.shape[:-1] != self.intercept_.shape:
            raise ValueError(
                f"coef has shape {self.coef_.shape}, intercept {self.intercept_.shape}"
            )
        self.n_features_in_ = self.coef_.shape[-1]
        return self


@dataclass(repr=False, eq=False)
class CurveFit(Checked, MethodFlags, BaseEstimator):  # type: ignore[misc]
    """Least-squares fit of a model's curves, started from the nearest of a set of Sobol points."""

    n_starts: int = setting(
        512,
        "Number of points scattered over the parameter range; the one with the nearest curves "
        "is the start of the fit",
        low=1,
    )
    max_iter: int = setting(100, "Largest number of Levenberg-Marquardt iterations", low=1)
    tol: float = setting(
        1e-8, "Change of every log-parameter below which the fit has converged", above=0
    )

    works_on_curves: ClassVar[bool] = True

    def state(self) -> dict[str, FloatArray]:
        """Return no arrays: the method has parameters only."""
        return {}

    def fit_curves(
        self,
        forwards: Sequence[tuple[Forward, int]],
        observed: Tensor,
        known_parameters: Tensor,
        lower: float,
        upper: float,
    ) -> list[LeastSquaresSolution]:
        """Return, for each of several models, the parameters whose curves are nearest to a row's.

        The residual of each curve is divided by its rms, to which the noise is proportional. A
        model is a ``Forward``, whose curves have the shape of `observed` (n_rows, n_curves,
        n_points), and its number of parameters; `known_parameters` is (n_rows, n_known), `lower`
        and `upper` are the range of the starts. Parameters stay within ``BEYOND`` times this range:
        one without effect on the curves would go to 0 or infinity. Models that a rough fit rules
        out for a row have an infinite cost there.
        """
        scale = observed.square().mean(dim=2, keepdim=True).sqrt()
        floor = COMPRESSED * scale
        limits = math.log(lower / BEYOND), math.log(upper * BEYOND)
        bounds = observed.new_tensor(limits[:1]), observed.new_tensor(limits[1:])

        def residuals(forward: Forward) -> tuple[Residual, Residual]:
            def plain(log_parameters: Tensor, rows: Tensor) -> Tensor:
                curves = forward(log_parameters.exp(), known_parameters[rows])
                return ((observed[rows] - curves) / scale[rows]).flatten(1)

            def compressed(log_parameters: Tensor, rows: Tensor) -> Tensor:
                curves = forward(log_parameters.exp(), known_parameters[rows])
                levels = torch.asinh(observed[rows] / floor[rows])
                return (levels - torch.asinh(curves / floor[rows])).flatten(1)

            return plain, compressed

        # Compressed curves first: narrow peaks overlap at their feet only.
        n_rough = min(self.max_iter, ROUGH_ITER)
        rough = LevenbergMarquardt(max_iter=n_rough, tol=ROUGH_TOL, bounds=bounds)
        pairs = [residuals(forward) for forward, _ in forwards]
        all_rows = torch.arange(len(observed), device=observed.device)
        starts, costs = [], []
        for (forward, n), (plain, compressed) in zip(forwards, pairs, strict=True):
            curves = observed, scale, known_parameters
            start = self._nearest_start(forward, n, *curves, lower, upper).log()
            starts.append(rough.minimise(compressed, start).parameters)
            costs.append(plain(starts[-1], all_rows).square().sum(dim=1))
        # Then the curves themselves, of the models that are not far behind the nearest one.
        least = torch.stack(costs).amin(dim=0)
        solver = LevenbergMarquardt(max_iter=self.max_iter, tol=self.tol, bounds=bounds)
        solutions = []
        for (plain, _), start, cost in zip(pairs, starts, costs, strict=True):
            rows = (cost <= RULED_OUT * least).nonzero()[:, 0]
            solutions.append(_fit_of_rows(solver, plain, start, rows))
        return solutions

    def _nearest_start(
        self,
        forward: Forward,
        n_parameters: int,
        observed: Tensor,
        scale: Tensor,
        known_parameters: Tensor,
        lower: float,
        upper: float,
    ) -> Tensor:
        """Return for each row the Sobol point whose curves are nearest to the row's."""
        sobol = torch.quasirandom.SobolEngine(n_parameters)
        points = sobol.draw(self.n_starts, dtype=torch.float64)
        starts = torch.exp(math.log(lower) + points.to(observed) * math.log(upper / lower))
        mean_known = known_parameters.mean(dim=0, keepdim=True).expand(len(starts), -1)
        curves = forward(starts, mean_known).flatten(1)
        weights = (1 / scale.square()).expand(observed.shape).flatten(1)
        # |observed - curves|^2 without the square of the observed ones, the same for all points
        misfit = weights @ curves.square().T - 2 * (weights * observed.flatten(1)) @ curves.T
        return starts[misfit.argmin(dim=1)]


def _fit_of_rows(
    solver: LevenbergMarquardt, residual: Residual, start: Tensor, rows: Tensor
) -> LeastSquaresSolution:
    """Return the fit of some rows in parameters, and an infinite cost of the others."""
    solution = solver.minimise(lambda theta, chosen: residual(theta, rows[chosen]), start[rows])
    parameters = start.clone()
    parameters[rows] = solution.parameters
    cost = start.new_full((len(start),), math.inf)
    cost[rows] = solution.cost
    information = start.new_zeros(*start.shape, start.shape[1])
    information[rows] = solution.information
    status = torch.full((len(start),), int(RowStatus.NO_DECREASE), device=start.device)
    status[rows] = solution.status
    return LeastSquaresSolution(parameters.exp(), cost, information, status, solution.n_iter)
