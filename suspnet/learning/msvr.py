"""MSVR: multi-output support vector regression as a scikit-learn estimator on torch."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data

from suspnet.learning.feature_maps import FEATURE_MAPS, MAP_TYPES, FeatureBlocks
from suspnet.learning.irwls import Iteration, Status, irwls

BLOCK_ROWS = 8192
FloatArray = NDArray[np.float64]


class MSVR(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Multi-output support vector regression with a hyperspherical epsilon-insensitive loss.

    Minimises, over W and b (Eq. 7 of the paper; a sum over samples, not a mean)::

        1/2 |W|^2 + C sum_i L(|y_i - W^T phi(x_i) - b|),   L(u) = max(0, u - epsilon)^2

    by IRWLS in the primal. phi approximates the RBF kernel exp(-|x - z|^2 / sigma^2), i.e.
    scikit-learn's gamma = 1 / sigma^2. Scale inputs and outputs before (`Scaling` does).

    Parameters
    ----------
    C : float, default=100.0
        Penalty of residuals outside the tube, > 0.
    sigma : float, default=3.0
        Kernel width, > 0, in units of the inputs.
    epsilon : float, default=1e-3
        Radius of the tube, >= 0, in units of the outputs.
    feature_map : {"rff", "orf", "nystroem", "exact"}, default="rff"
        Random Fourier features, orthogonal ones, Nystroem landmarks by randomly pivoted Cholesky,
        or the exact kernel (memory grows with the square of the number of samples).
    n_components : int, default=1024
        Number of features, >= 1; `rff` and `orf` make cosine and sine pairs, so an odd number is
        rounded up; `nystroem` takes fewer when fewer suffice; not used by `exact`.
    fit_intercept : bool, default=True
        Whether to fit b, unpenalised.
    max_iter : int, default=1000
        Iterations after which to give up with a ``ConvergenceWarning``.
    tol : float, default=1e-8
        Stop when the objective is proven to lie within this fraction of its minimum.
    random_state : int, RandomState or None, default=0
        Seed of the feature map's draws.
    dtype : {"float64", "float32"}, default="float64"
        Precision of the features; the solver's accumulators and solves are float64. With float32
        the gradient is rounded, so `tol` may have to be raised.
    device : str, default="cpu"
        Torch device.
    callback : callable, optional
        Called after each iteration with an ``Iteration`` (n_iter, objective, grad_norm, step,
        support_fraction).

    Attributes
    ----------
    coef_ : array of shape (n_features, n_outputs)
        W.
    intercept_ : array of shape (n_outputs,)
        b.
    n_iter_ : int
    converged_ : bool
    objective_, grad_norm_ : float
        At the solution.
    gap_ : float
        Proven bound on the relative distance of the objective from its minimum.
    objectives_ : list of float
        Before the first and after each iteration.
    support_fraction_ : float
        Fraction of the samples outside the tube.

    Raises
    ------
    TypeError, ValueError
        From `fit`, if a parameter or the data is out of range.

    Warns
    -----
    ConvergenceWarning
        If `tol` was not reached.

    Examples
    --------
    >>> import numpy as np
    >>> X = np.linspace(-2, 2, 200)[:, None]
    >>> Y = np.column_stack([np.sin(X[:, 0]), np.cos(X[:, 0])])
    >>> model = MSVR(sigma=1.0).fit(X, Y)
    >>> model.converged_, bool(np.abs(model.predict(X) - Y).mean() < 0.01)
    (True, True)
    """

    def __init__(
        self,
        C: float = 100.0,
        sigma: float = 3.0,
        epsilon: float = 1e-3,
        feature_map: Literal["rff", "orf", "nystroem", "exact"] = "rff",
        n_components: int = 1024,
        fit_intercept: bool = True,
        max_iter: int = 1000,
        tol: float = 1e-8,
        random_state: Any = 0,
        dtype: Literal["float64", "float32"] = "float64",
        device: str = "cpu",
        callback: Callable[[Iteration], None] | None = None,
    ) -> None:
        self.C = C
        self.sigma = sigma
        self.epsilon = epsilon
        self.feature_map = feature_map
        self.n_components = n_components
        self.fit_intercept = fit_intercept
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state
        self.dtype = dtype
        self.device = device
        self.callback = callback

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to samples.

        Parameters
        ----------
        X : array of shape (n_samples, n_inputs)
        y : array of shape (n_samples,) or (n_samples, n_outputs)
        """
        self._check_parameters()
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        X = np.ascontiguousarray(X)  # a restored model must see the same memory layout
        samples = torch.tensor(X, dtype=self._torch_dtype, device=self.device)
        targets = torch.tensor(np.asarray(y, dtype=np.float64), device=self.device)
        self._single_output = targets.ndim == 1
        targets = targets.reshape(len(targets), -1)
        seed = int(check_random_state(self.random_state).randint(2**31 - 1))
        self._map = FEATURE_MAPS[self.feature_map](samples, self.sigma, self.n_components, seed)
        solution = irwls(
            FeatureBlocks(self._map, samples, BLOCK_ROWS),
            targets,
            self.C,
            self.epsilon,
            fit_intercept=self.fit_intercept,
            max_iter=self.max_iter,
            tol=self.tol,
            on_iteration=self.callback,
        )
        self.coef_ = np.ascontiguousarray(solution.coef.cpu().numpy())
        self.intercept_ = solution.intercept.cpu().numpy()
        self.n_iter_ = solution.n_iter
        self.converged_ = solution.status == Status.CONVERGED
        self.objective_ = solution.objective
        self.objectives_ = solution.objectives
        self.grad_norm_ = solution.grad_norm
        self.gap_ = solution.gap
        self.support_fraction_ = solution.support_fraction
        if not self.converged_:
            warnings.warn(
                f"MSVR stopped after {self.n_iter_} iterations ({solution.status}): relative gap "
                f"{self.gap_:.1e} > tol={self.tol:g}; raise max_iter or tol, or lower C or epsilon",
                ConvergenceWarning,
                stacklevel=2,
            )
        return self

    def predict(self, X: ArrayLike) -> FloatArray:
        """Return predictions, shape (n_samples,) or (n_samples, n_outputs) as `y` was.

        Raises
        ------
        NotFittedError, ValueError
            If the model is not fitted or `X` does not fit it.
        """
        check_is_fitted(self)
        X = validate_data(self, X, reset=False, dtype=np.float64)
        samples = torch.tensor(X, dtype=self._torch_dtype, device=self.device)
        coef = torch.tensor(self.coef_, dtype=self._torch_dtype, device=self.device)
        predicted = np.empty((len(samples), coef.shape[1]))
        for start in range(0, len(samples), BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            predicted[rows] = (self._map(samples[rows]) @ coef).double().cpu().numpy()
        predicted += self.intercept_
        return predicted[:, 0] if self._single_output else predicted

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays that, with the parameters, make up the fitted model."""
        check_is_fitted(self)
        arrays = {f"map.{k}": v.cpu().numpy() for k, v in self._map.tensors().items()}
        return {"coef": self.coef_, "intercept": self.intercept_, **arrays}

    def restore(self, state: Mapping[str, FloatArray]) -> Self:
        """Become the model whose `state` this is; it predicts columns, (n_samples, n_outputs).

        Raises
        ------
        ValueError
            If arrays are missing or their shapes disagree.
        """
        self._check_parameters()
        map_type = MAP_TYPES[self.feature_map]
        names = [name.removeprefix("map.") for name in state if name.startswith("map.")]
        tensors = {
            name: torch.tensor(state[f"map.{name}"], dtype=self._torch_dtype, device=self.device)
            for name in names
        }
        try:
            self._map = map_type(**tensors)
            self.coef_, self.intercept_ = state["coef"], state["intercept"]
        except (TypeError, KeyError) as error:
            raise ValueError(f"the arrays are not those of an MSVR model ({error})") from error
        self.n_features_in_ = self._map.n_inputs
        none = torch.zeros(1, self.n_features_in_, dtype=self._torch_dtype, device=self.device)
        n_features = self._map(none).shape[1]
        if self.coef_.shape != (n_features, len(self.intercept_)):
            raise ValueError(f"coef has shape {self.coef_.shape}, the map {n_features} features")
        self._single_output = False
        return self

    @property
    def _torch_dtype(self) -> torch.dtype:
        return torch.float32 if self.dtype == "float32" else torch.float64

    def _check_parameters(self) -> None:
        check_number("C", self.C, low=0, open_low=True)
        check_number("sigma", self.sigma, low=0, open_low=True)
        check_number("epsilon", self.epsilon, low=0)
        check_number("tol", self.tol, low=0)
        check_number("max_iter", self.max_iter, low=1, whole=True)
        check_number("n_components", self.n_components, low=1, whole=True)
        if not isinstance(self.fit_intercept, bool | np.bool_):
            raise TypeError(f"`fit_intercept` must be True or False, got {self.fit_intercept!r}")
        if not isinstance(self.feature_map, str) or self.feature_map not in FEATURE_MAPS:
            allowed = sorted(FEATURE_MAPS)
            raise ValueError(f"`feature_map` must be one of {allowed}, got {self.feature_map!r}")
        if self.dtype not in ("float64", "float32"):
            raise ValueError(f"`dtype` must be 'float64' or 'float32', got {self.dtype!r}")


def check_number(
    name: str, value: Any, *, low: float, open_low: bool = False, whole: bool = False
) -> None:
    """Raise unless `value` is a finite number >= low (> low if `open_low`).

    Raises
    ------
    TypeError
        If it is not a number, or not a whole one where it must be.
    ValueError
        If it is out of range.
    """
    kind = Integral if whole else Real
    if isinstance(value, bool) or not isinstance(value, kind):
        raise TypeError(f"`{name}` must be a {'whole ' if whole else ''}number, got {value!r}")
    number = float(value)
    if not math.isfinite(number) or number < low or (open_low and number == low):
        bound = f"in ({low}, inf)" if open_low else f">= {low}"
        raise ValueError(f"`{name}` must be finite and {bound}, got {value}")
