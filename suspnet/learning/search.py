"""Hyperparameters of least RMSE by cross-validation over a grid (Table V).

The optimum is on the edge of the grid in a hyperparameter if its value is the smallest or largest
tried and the edge is not flat. An edge is flat if the next value inwards, all else equal, raises
the RMSE by at most `FLAT`, or by less than the standard error of this rise over folds.
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.metrics import root_mean_squared_error
from sklearn.model_selection import KFold, ParameterGrid

from suspnet.ground.settings import Checked, Setting, setting
from suspnet.ground.types import FloatArray
from suspnet.learning.metrics import check_estimates
from suspnet.learning.scaling import Scaling

FLAT = 0.005  # relative rise of the RMSE up to which the edge of a grid counts as flat


@dataclass(frozen=True)
class SearchResult:
    """Result of a search: the hyperparameters tried, in order, and their cross-validated `rmse`.

    It is averaged over outputs and folds, inf where a fit failed, for which `failures` has the
    reason. `edges` maps each hyperparameter in which the optimum is on the edge to a sentence that
    says so; `fold_rmse` has the RMSE of each fold, for each setting.
    """

    settings: list[dict[str, Any]]
    rmse: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    edges: dict[str, str] = field(default_factory=dict)
    fold_rmse: list[list[float]] = field(default_factory=list)

    @property
    def best(self) -> dict[str, Any]:
        """The hyperparameters with the least RMSE."""
        return self.settings[int(np.argmin(self.rmse))]

    def is_flat(self, other: dict[str, Any]) -> bool:
        """Return whether the edge is flat from the best setting to `other`, the next inwards."""
        best, inner = (np.array(self.fold_rmse[self.settings.index(s)]) for s in (self.best, other))
        rise = inner - best
        if not np.isfinite(rise).all():
            return False
        scatter = float(rise.std(ddof=1)) / math.sqrt(len(rise))
        return float(rise.mean()) <= max(FLAT * float(best.mean()), scatter)


@dataclass(frozen=True)
class GridSearch(Checked):
    """Cross-validation over every combination of a grid."""

    grids: Annotated[
        Mapping[str, Mapping[str, Sequence[Any]]],
        Setting(
            "Values of each setting of each method that are tried; a method with one value of each "
            "is not tuned",
            rule="mapping to lists",
        ),
    ]
    n_folds: int = setting(5, "Number of folds of the cross-validation", low=2)
    seed: int = setting(0, "Seed of the folds", low=0, high=4294967295)
    n_curves: int | None = setting(
        None, "Number of training curves that methods are tuned on; null is all", low=2
    )

    def settings_of(self, name: str) -> list[dict[str, Any]]:
        """Return every setting in a method's grid."""
        if name not in self.grids:
            raise ValueError(f"the search has no grid for {name!r}, only for {sorted(self.grids)}")
        return list(ParameterGrid(dict(self.grids[name])))

    def run(
        self,
        name: str,
        estimator: Any,
        X: FloatArray,
        Y: FloatArray,
        output_scaling: Scaling,
        on_setting: Callable[[dict[str, Any], float], None] | None = None,
    ) -> SearchResult:
        """Return the RMSE of every setting of the grid called `name`, on unscaled outputs.

        `X`, `Y`: scaled inputs (n_samples, n_inputs) and outputs (n_samples, n_outputs);
        `on_setting` is called with each setting and its RMSE.
        """
        folds = list(KFold(self.n_folds, shuffle=True, random_state=self.seed).split(X))
        result = SearchResult(self.settings_of(name))
        rule = f"predict of {type(estimator).__name__} must return finite numbers"
        for chosen in result.settings:
            errors = []
            try:
                for others, rows in folds:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore", ConvergenceWarning)
                        model = clone(estimator).set_params(**chosen).fit(X[others], Y[others])
                    predicted = check_estimates(rule, model.predict(X[rows]), Y[rows].shape)
                    actual, predicted = map(output_scaling.undo, (Y[rows], predicted))
                    errors.append(float(root_mean_squared_error(actual, predicted)))
            except ValueError as error:  # a setting that cannot be fitted leaves the others
                result.failures.append(f"{chosen}: {error}")
                errors = [math.inf] * len(folds)
            result.fold_rmse.append(errors)
            result.rmse.append(float(np.mean(errors)))
            if on_setting is not None:
                on_setting(chosen, result.rmse[-1])
        if not np.isfinite(result.rmse).any():
            first = result.failures[0]
            raise ValueError(f"no setting of the search could be fitted; first: {first}")
        for key, values in _levels(self.grids[name]).items():
            value = result.best[key]
            inner = {values[0]: values[1], values[-1]: values[-2]}.get(value)
            if inner is not None and not result.is_flat({**result.best, key: inner}):
                result.edges[key] = f"the best {key}, {value:g}, is on the edge of the values tried"
        return result


def _levels(grid: Mapping[str, Sequence[Any]]) -> dict[str, list[float]]:
    """Return the values in order of each hyperparameter that has several, all positive numbers."""
    return {
        key: sorted(set(values))
        for key, values in grid.items()
        if len(set(values)) > 1
        and all(isinstance(v, int | float) and not isinstance(v, bool) and v > 0 for v in values)
    }
