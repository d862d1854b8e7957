"""Hyperparameters by cross-validation over a grid: the least RMSE wins (Table V)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.metrics import root_mean_squared_error
from sklearn.model_selection import KFold, ParameterGrid

from suspnet.checks import check_number
from suspnet.learning.msvr import MSVR, SAME_GRAM_PARAMETERS
from suspnet.learning.scaling import Scaling

FloatArray = NDArray[np.float64]
Predictor = Callable[[Mapping[str, Any]], list[FloatArray]]


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    Attributes
    ----------
    settings : list of dict
        Hyperparameters tried, in order.
    rmse : list of float
        Cross-validated RMSE of each, averaged over outputs and folds; inf where a fit failed.
    """

    settings: list[dict[str, Any]]
    rmse: list[float]
    failures: list[str] = field(default_factory=list)

    @property
    def best(self) -> dict[str, Any]:
        """The hyperparameters with the least RMSE."""
        return self.settings[int(np.argmin(self.rmse))]


@dataclass(frozen=True)
class GridSearch:
    """Cross-validation over every combination of a grid.

    Parameters
    ----------
    grids : mapping
        From method name to a mapping from hyperparameter to the values to try.
    n_folds : int, default=5
    seed : int, default=0
        Shuffles the samples before they are split.

    Raises
    ------
    TypeError, ValueError
        If there are fewer than 2 folds, or `run` is asked for a method without a grid.
    """

    grids: Mapping[str, Mapping[str, Sequence[Any]]]
    n_folds: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        check_number("n_folds", self.n_folds, low=2, whole=True)

    def n_settings(self, name: str) -> int:
        """Return the number of settings in a method's grid."""
        return len(ParameterGrid(dict(self._grid(name))))

    def run(
        self,
        name: str,
        estimator: Any,
        X: FloatArray,
        Y: FloatArray,
        output_scaling: Scaling,
        on_setting: Callable[[dict[str, Any], float], None] | None = None,
    ) -> SearchResult:
        """Return the RMSE of every setting, measured on unscaled outputs.

        Parameters
        ----------
        name : str
            Key of `grids`.
        estimator : scikit-learn regressor
        X, Y : arrays of shape (n_samples, n_inputs) and (n_samples, n_outputs)
            Scaled inputs and outputs.
        output_scaling : Scaling
            Undone before the error is measured.
        on_setting : callable, optional
            Called with the hyperparameters and their RMSE.
        """
        folds = [
            rows for _, rows in KFold(self.n_folds, shuffle=True, random_state=self.seed).split(X)
        ]
        actual = [output_scaling.undo(Y[rows]) for rows in folds]
        settings = list(ParameterGrid(dict(self._grid(name))))
        result = SearchResult(settings, [math.inf] * len(settings))
        for group in _groups(estimator, settings):
            predict: Predictor | None = None
            for k in group:
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore", ConvergenceWarning)
                        predict = predict or _predictor(estimator, settings[k], X, Y, folds)
                        predicted = [output_scaling.undo(values) for values in predict(settings[k])]
                    errors = map(root_mean_squared_error, actual, predicted)
                    result.rmse[k] = float(np.mean(list(errors)))
                except ValueError as error:
                    result.failures.append(f"{settings[k]}: {error}")
                if on_setting is not None:
                    on_setting(settings[k], result.rmse[k])
        if not np.isfinite(result.rmse).any():
            raise ValueError(
                f"no setting of the search could be fitted; first: {result.failures[0]}"
            )
        return result

    def _grid(self, name: str) -> Mapping[str, Sequence[Any]]:
        if name not in self.grids:
            raise ValueError(f"the search has no grid for {name!r}, only for {sorted(self.grids)}")
        return self.grids[name]


def _groups(estimator: Any, settings: Sequence[Mapping[str, Any]]) -> list[list[int]]:
    """Return the indices of the settings, grouped by the Gram matrix or fit they need."""
    groups: dict[str, list[int]] = {}
    for k, setting in enumerate(settings):
        candidate = clone(estimator).set_params(**setting)
        apart: Any = setting
        if isinstance(candidate, MSVR) and candidate.shares_gram:
            apart = {
                key: value for key, value in setting.items() if key not in SAME_GRAM_PARAMETERS
            }
        groups.setdefault(repr(apart), []).append(k)
    return list(groups.values())


def _predictor(
    estimator: Any,
    first: Mapping[str, Any],
    X: FloatArray,
    Y: FloatArray,
    folds: Sequence[NDArray[np.int64]],
) -> Predictor:
    """Return what predicts each fold by a model of all the others, for settings like `first`."""
    candidate = clone(estimator).set_params(**first)
    if isinstance(candidate, MSVR) and candidate.shares_gram:
        return candidate.cross_predictor(X, Y, folds)

    def predict(setting: Mapping[str, Any]) -> list[FloatArray]:
        found = []
        for rows in folds:
            others = np.setdiff1d(np.arange(len(X)), rows)
            model = clone(estimator).set_params(**setting).fit(X[others], Y[others])
            found.append(model.predict(X[rows]))
        return found

    return predict
