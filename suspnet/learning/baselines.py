"""The methods MSVR is compared with: an SVR for each output, linear regression, and a direct fit.

`CurveFit` fits the model's curves directly, the usual approach in structural dynamics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch
from joblib import Parallel, delayed
from numpy.typing import ArrayLike
from sklearn import kernel_ridge, linear_model, svm
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.metrics.pairwise import rbf_kernel
from sklearn.utils.validation import check_is_fitted, validate_data
from torch import Tensor

from suspnet.ground.settings import Setting, check_settings, check_values
from suspnet.ground.types import FloatArray
from suspnet.learning.least_squares import (
    BEYOND,
    LeastSquaresSolution,
    LevenbergMarquardt,
    Residual,
    RowStatus,
)

Forward = Callable[[Tensor, Tensor], Tensor]
"""``forward(parameters, known)`` returns curves (n_rows, n_curves, n_points)."""
COMPRESSED, ROUGH_TOL, ROUGH_ITER = 0.05, 1e-3, 20
"""A curve, in units of its rms, above which it counts by its logarithm in the first search of
`CurveFit`, and the tolerance and number of iterations of that search."""
RULED_OUT = 10.0
"""A model whose cost after the first search exceeds the least one by this factor is ruled out."""
PREDICT_ROWS = 1024
"""Rows predicted at once, so that their kernel fits into memory."""


class SVR(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """One epsilon-insensitive support vector regression for each output (scikit-learn's libsvm).

    Kernel ``exp(-|x - z|^2 / sigma^2)`` as in `MSVR`. The loss is linear outside the tube.

    Parameters
    ----------
    C : float, default=10.0
        Penalty, > 0.
    sigma : float, default=3.0
        Kernel width, > 0.
    epsilon : float, default=1e-3
        Half width of the tube, >= 0.
    tol : float, default=1e-3
        libsvm's stopping tolerance.
    max_iter : int, default=10_000_000
        Largest number of libsvm's iterations for each output. It needs one to some hundred times
        the number of samples, and does not end by itself if `tol` is below rounding.
    cache_size_mb : float, default=400.0
        libsvm's kernel cache for each output.
    n_jobs : int or None, default=2
        Outputs fitted at the same time, in threads.
    callback : callable, optional
        Called with the number of outputs fitted so far.

    Attributes
    ----------
    support_vectors_, dual_coef_ : list of arrays
        For each output, shapes (n_support, n_inputs) and (n_support,).
    intercept_ : array of shape (n_outputs,)
    n_iter_ : array of shape (n_outputs,)
    support_fraction_ : float
        Mean fraction of the samples that are support vectors.
    converged_ : bool

    Raises
    ------
    TypeError, ValueError
        From `fit`, if a parameter or the data is out of range.

    Warns
    -----
    ConvergenceWarning
        If `tol` was not reached.
    """

    settings: ClassVar[Mapping[str, Setting]] = {
        "C": Setting("Penalty of residuals outside the tube, as tuned for the group", above=0),
        "sigma": Setting("Width of the kernel exp(-|x - z|²/sigma²)", "scaled inputs", above=0),
        "epsilon": Setting(
            "Half width of the tube within which residuals cost nothing", "scaled outputs", low=0
        ),
        "tol": Setting("Stopping tolerance of libsvm", above=0),
        "max_iter": Setting(
            "Number of libsvm's iterations for each output after which it gives up", low=1
        ),
        "cache_size_mb": Setting("Size of libsvm's kernel cache for each output", "MB", above=0),
        "n_jobs": Setting(
            "Number of outputs that are fitted at the same time, in threads; -1 is one for each "
            "core",
            rule="whole number; not 0",
        ),
        "callback": Setting(
            "Function called after each output, which train.py sets itself", rule="null"
        ),
    }
    """What each argument means and which values it takes."""

    works_on_curves: ClassVar[bool] = False
    distributable: ClassVar[bool] = False
    gives_deviations: ClassVar[bool] = False

    def __init__(
        self,
        C: float = 10.0,
        sigma: float = 3.0,
        epsilon: float = 1e-3,
        tol: float = 1e-3,
        max_iter: int = 10_000_000,
        cache_size_mb: float = 400.0,
        n_jobs: int | None = 2,
        callback: Callable[[int], None] | None = None,
    ) -> None:
        self.C = C
        self.sigma = sigma
        self.epsilon = epsilon
        self.tol = tol
        self.max_iter = max_iter
        self.cache_size_mb = cache_size_mb
        self.n_jobs = n_jobs
        self.callback = callback

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit one machine for each column of `y`, (n_samples,) or (n_samples, n_outputs)."""
        check_settings(self)
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        samples, targets = np.asarray(X), np.asarray(y, dtype=np.float64)
        self._single_output = targets.ndim == 1
        targets = targets.reshape(len(samples), -1)
        machines = Parallel(self.n_jobs, prefer="threads", return_as="generator")(
            delayed(self._fit_output)(samples, column) for column in targets.T
        )
        fitted = []
        for machine in machines:
            fitted.append(machine)
            if self.callback is not None:
                self.callback(len(fitted))
        self.support_vectors_ = [
            np.ascontiguousarray(machine.support_vectors_) for machine in fitted
        ]
        self.dual_coef_ = [np.ascontiguousarray(machine.dual_coef_[0]) for machine in fitted]
        self.intercept_ = np.array([float(machine.intercept_[0]) for machine in fitted])
        self.support_fraction_ = float(np.mean([len(c) for c in self.dual_coef_]) / len(samples))
        self.n_iter_ = np.array([int(machine.n_iter_) for machine in fitted])
        self.converged_ = all(machine.fit_status_ == 0 for machine in fitted)
        return self

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return predictions, shape (n_samples,) or (n_samples, n_outputs)."""
        check_is_fitted(self)
        samples = np.asarray(validate_data(self, X, reset=False, dtype=np.float64))
        predicted = np.zeros((len(samples), len(self.intercept_)))
        for j, (vectors, dual) in enumerate(
            zip(self.support_vectors_, self.dual_coef_, strict=True)
        ):
            if len(dual):  # a constant output has no support vector
                predicted[:, j] = kernel_expansion(samples, vectors, dual, self.sigma)
        predicted += self.intercept_
        return predicted[:, 0] if self._single_output else predicted

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays that define the fitted model together with the parameters.

        The intercept has the shape () if `y` had one dimension.
        """
        check_is_fitted(self)
        arrays = {f"support_vectors.{j}": v for j, v in enumerate(self.support_vectors_)}
        arrays |= {f"dual_coef.{j}": v for j, v in enumerate(self.dual_coef_)}
        return arrays | {"intercept": self.intercept_.reshape(() if self._single_output else -1)}

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Load the arrays of `state`; ValueError if they are missing or inconsistent."""
        try:
            self.intercept_ = np.atleast_1d(state["intercept"])
            self._single_output = state["intercept"].ndim == 0
            outputs = range(len(self.intercept_))
            self.support_vectors_ = [state[f"support_vectors.{j}"] for j in outputs]
            self.dual_coef_ = [state[f"dual_coef.{j}"] for j in outputs]
        except KeyError as error:
            raise ValueError(f"the arrays are not those of an SVR model ({error})") from error
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


def kernel_expansion(
    X: FloatArray, vectors: FloatArray, dual: FloatArray, sigma: float
) -> FloatArray:
    """Return sum_j k(x_i, v_j) dual_j, (n_samples,) or (n_samples, n_outputs) as `dual` is.

    k is the kernel exp(-|x - v|^2 / sigma^2), of a block of rows at a time.
    """
    expansion = np.empty((len(X), *dual.shape[1:]))
    for start in range(0, len(X), PREDICT_ROWS):
        rows = slice(start, start + PREDICT_ROWS)
        expansion[rows] = rbf_kernel(X[rows], vectors, gamma=1 / sigma**2) @ dual
    return expansion


class KernelRidge(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Kernel ridge regression (scikit-learn's), which MSVR is without a tube.

    Minimises ``1/2 |W|^2 + C sum_i |y_i - W^T phi(x_i) - b|^2`` with b the mean of the outputs, so
    with the letters of `MSVR`: alpha = 1 / (2 C), gamma = 1 / sigma^2.

    Parameters
    ----------
    C : float, default=100.0
        Penalty, > 0.
    sigma : float, default=3.0
        Kernel width, > 0.

    Attributes
    ----------
    dual_coef_ : array of shape (n_samples, n_outputs)
    X_fit_ : array of shape (n_samples, n_inputs)
    intercept_ : array of shape (n_outputs,)

    Raises
    ------
    TypeError, ValueError
        From `fit`, if a parameter or the data is out of range.
    """

    settings: ClassVar[Mapping[str, Setting]] = {
        "C": Setting("Penalty of residuals, as tuned for the group", above=0),
        "sigma": Setting("Width of the kernel exp(-|x - z|²/sigma²)", "scaled inputs", above=0),
    }
    """What each argument means and which values it takes."""

    works_on_curves: ClassVar[bool] = False
    distributable: ClassVar[bool] = False
    gives_deviations: ClassVar[bool] = False

    def __init__(self, C: float = 100.0, sigma: float = 3.0) -> None:
        self.C = C
        self.sigma = sigma

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to samples (n_samples, n_inputs) and outputs (n_samples,) or (.., n_outputs)."""
        check_settings(self)
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        targets = np.asarray(y, dtype=np.float64)
        self._single_output = targets.ndim == 1
        targets = targets.reshape(len(targets), -1)
        self.intercept_ = targets.mean(axis=0)
        machine = kernel_ridge.KernelRidge(
            alpha=1 / (2 * self.C), kernel="rbf", gamma=1 / self.sigma**2
        )
        machine.fit(X, targets - self.intercept_)
        self.dual_coef_, self.X_fit_ = machine.dual_coef_, np.ascontiguousarray(X)
        return self

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return predictions, shape (n_samples,) or (n_samples, n_outputs) as `y` was."""
        check_is_fitted(self)
        samples = np.asarray(validate_data(self, X, reset=False, dtype=np.float64))
        predicted = kernel_expansion(samples, self.X_fit_, self.dual_coef_, self.sigma)
        predicted += self.intercept_
        return predicted[:, 0] if self._single_output else predicted

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays of the fitted model."""
        check_is_fitted(self)
        intercept = self.intercept_.reshape(() if self._single_output else -1)
        return {"dual_coef": self.dual_coef_, "X_fit": self.X_fit_, "intercept": intercept}

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Load the arrays of `state`; ValueError if they are missing or inconsistent."""
        try:
            self.dual_coef_, self.X_fit_ = state["dual_coef"], state["X_fit"]
            self.intercept_ = np.atleast_1d(state["intercept"])
            self._single_output = state["intercept"].ndim == 0
        except KeyError as error:
            raise ValueError(f"the arrays are not those of a ridge model ({error})") from error
        if self.dual_coef_.shape != (len(self.X_fit_), len(self.intercept_)):
            raise ValueError(
                f"dual_coef has shape {self.dual_coef_.shape}, X_fit {self.X_fit_.shape}"
            )
        self.n_features_in_ = self.X_fit_.shape[1]
        return self


class LinearRegression(linear_model.LinearRegression):  # type: ignore[misc]
    """Ordinary least squares with an intercept (scikit-learn's), the paper's MV-LR."""

    coef_: FloatArray

    works_on_curves: ClassVar[bool] = False
    distributable: ClassVar[bool] = False
    gives_deviations: ClassVar[bool] = False

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
        try:
            self.coef_, self.intercept_ = state["coef"], state["intercept"]
        except KeyError as error:
            raise ValueError(f"the arrays are not those of a linear model ({error})") from error
        if not self.coef_.ndim or self.coef_.shape[:-1] != self.intercept_.shape:
            raise ValueError(
                f"coef has shape {self.coef_.shape}, intercept {self.intercept_.shape}"
            )
        self.n_features_in_ = self.coef_.shape[-1]
        return self


class CurveFit(BaseEstimator):  # type: ignore[misc]
    """Least-squares fit of a model's curves, started from the nearest of a set of Sobol points.

    Raises
    ------
    TypeError, ValueError
        If a parameter is out of range.
    """

    settings: ClassVar[Mapping[str, Setting]] = {
        "n_starts": Setting(
            "Number of points scattered over the parameter range; the one with the nearest curves "
            "is the start of the fit",
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
        self,
        forwards: Sequence[tuple[Forward, int]],
        observed: Tensor,
        known: Tensor,
        lower: float,
        upper: float,
    ) -> list[LeastSquaresSolution]:
        """Return, for each of several models, the parameters whose curves are nearest to a row's.

        The residual of each curve is divided by its rms, to which the noise is proportional. A
        model is ``forward(parameters, known)``, which returns curves (n_rows, n_curves, n_points)
        in the shape of `observed`, and its number of parameters; `known` (n_rows, n_known) are
        known parameters of each row, `lower` and `upper` the range of the starts. Parameters stay
        within ``BEYOND`` times this range: one without effect on the curves would go to 0 or
        infinity. Models that a rough fit rules out for a row have an infinite cost there.
        """
        scale = observed.square().mean(dim=2, keepdim=True).sqrt()
        limits = math.log(lower / BEYOND), math.log(upper * BEYOND)
        bounds = observed.new_tensor(limits[:1]), observed.new_tensor(limits[1:])

        floor = COMPRESSED * scale

        def residuals(forward: Forward) -> tuple[Residual, Residual]:
            def plain(log_parameters: Tensor, rows: Tensor) -> Tensor:
                curves = forward(log_parameters.exp(), known[rows])
                return ((observed[rows] - curves) / scale[rows]).flatten(1)

            def compressed(log_parameters: Tensor, rows: Tensor) -> Tensor:
                curves = forward(log_parameters.exp(), known[rows])
                levels = torch.asinh(observed[rows] / floor[rows])
                return (levels - torch.asinh(curves / floor[rows])).flatten(1)

            return plain, compressed

        # Compressed curves first: narrow peaks overlap at their feet only.
        rough = LevenbergMarquardt(
            max_iter=min(self.max_iter, ROUGH_ITER), tol=ROUGH_TOL, bounds=bounds
        )
        pairs = [residuals(forward) for forward, _ in forwards]
        every = torch.arange(len(observed), device=observed.device)
        starts, costs = [], []
        for (forward, n), (plain, compressed) in zip(forwards, pairs, strict=True):
            start = self._nearest_start(forward, observed, known, scale, (lower, upper), n).log()
            starts.append(rough.minimise(compressed, start).parameters)
            costs.append(plain(starts[-1], every).square().sum(dim=1))
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
        observed: Tensor,
        known: Tensor,
        scale: Tensor,
        start_range: tuple[float, float],
        n: int,
    ) -> Tensor:
        """Return for each row the Sobol point whose curves are nearest to the row's."""
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


def _fit_of_rows(
    solver: LevenbergMarquardt, residual: Residual, start: Tensor, rows: Tensor
) -> LeastSquaresSolution:
    """Return the fit of some rows in parameters, and an infinite cost of the others."""
    part = solver.minimise(lambda theta, chosen: residual(theta, rows[chosen]), start[rows])
    parameters = start.clone()
    parameters[rows] = part.parameters
    cost = start.new_full((len(start),), math.inf)
    cost[rows] = part.cost
    information = start.new_zeros(*start.shape, start.shape[1])
    information[rows] = part.information
    status = torch.full((len(start),), int(RowStatus.NO_DECREASE), device=start.device)
    status[rows] = part.status
    return LeastSquaresSolution(parameters.exp(), cost, information, status, part.n_iter)
