"""Hyperparameters of least RMSE by cross-validation over a grid (Table V).

The grid is a box that can be widened until the optimum is not on its edge. The optimum is on the
edge in a hyperparameter if its value is the smallest or largest tried and the edge is not flat. An
edge is flat if the next value inwards, all else equal, raises the RMSE by at most `FLAT`, or by
less than the standard error of this rise over folds.
"""

from __future__ import annotations

import itertools
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

from suspnet.ground.settings import Setting, check_settings, setting
from suspnet.ground.types import FloatArray, IntArray
from suspnet.learning.metrics import check_estimates
from suspnet.learning.msvr import MSVR, SAME_GRAM_PARAMETERS
from suspnet.learning.scaling import Scaling

Predictor = Callable[[Mapping[str, Any]], list[FloatArray]]
Levels = dict[str, list[float]]
FLAT = 0.005
"""Relative rise of the RMSE up to which the edge of a grid counts as flat."""


@dataclass(frozen=True)
class SearchResult:
    """Result of a search: the hyperparameters tried, in order, and their cross-validated `rmse`.

    It is averaged over outputs and folds, inf where a fit failed, for which `failures` has the
    reason. `edges` maps each hyperparameter in which the optimum is on the edge to a sentence that
    says why; `fold_rmse` has the RMSE of each fold, for each setting.
    """

    settings: list[dict[str, Any]]
    rmse: list[float]
    failures: list[str] = field(default_factory=list)
    edges: dict[str, str] = field(default_factory=dict)
    fold_rmse: list[list[float]] = field(default_factory=list)

    @property
    def best(self) -> dict[str, Any]:
        """The hyperparameters with the least RMSE."""
        return self.settings[int(np.argmin(self.rmse))]


@dataclass(frozen=True)
class GridSearch:
    """Cross-validation over every combination of a grid, and over a wider box if `widen` > 0.

    A widening adds one value beyond each edge that the optimum is on, by the ratio of the last two
    values, and tries the settings within one step of the optimum.
    """

    grids: Annotated[
        Mapping[str, Mapping[str, Sequence[Any]]],
        Setting(
            "Values of each setting of each method that are tried first; a method with one value "
            "of each is not tuned",
            rule="mapping to lists",
        ),
    ]
    n_folds: int = setting(5, "Number of folds of the cross-validation", low=2)
    seed: int = setting(0, "Seed of the folds", low=0, high=4294967295)
    n_curves: int | None = setting(
        None, "Number of training curves that methods are tuned on; null is all", low=2
    )
    widen: int = setting(
        0, "Largest number of times the grid is widened where the optimum is on its edge", low=0
    )
    caps: Annotated[
        Mapping[str, Mapping[str, Mapping[str, Any]]],
        Setting(
            "Values that no widening exceeds: for each method and setting low or high, and a "
            "reason",
            rule="mapping",
        ),
    ] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_settings(self)
        for name, caps in self.caps.items():
            for key, cap in caps.items():
                if "reason" not in cap or set(cap) - {"low", "high", "reason"}:
                    raise ValueError(
                        f"the cap of {name}.{key} must have a `reason` and `low` or `high`, got "
                        f"{dict(cap)}"
                    )

    def single(self, name: str) -> dict[str, Any] | None:
        """Return the only setting in a method's grid; None if there are several to compare."""
        settings = ParameterGrid(dict(self._grid(name)))
        return dict(settings[0]) if len(settings) == 1 else None

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
        """Return the RMSE of every setting of the grid called `name`, on unscaled outputs.

        `X`, `Y`: scaled inputs (n_samples, n_inputs) and outputs (n_samples, n_outputs);
        `on_setting` is called with each setting and its RMSE.
        """
        folds = [
            rows for _, rows in KFold(self.n_folds, shuffle=True, random_state=self.seed).split(X)
        ]
        # The grid first; then, while the optimum is on an edge, the neighbours of the optimum in a
        # box that is one value wider there.
        trials = _Trials(estimator, X, Y, folds, output_scaling, on_setting)
        result = trials.result
        trials.measure(list(ParameterGrid(dict(self._grid(name)))))
        if not np.isfinite(result.rmse).any():
            raise ValueError(
                f"no setting of the search could be fitted; first: {result.failures[0]}"
            )
        levels = _levels(self._grid(name))
        for _ in range(self.widen):
            wider, _ = self._beyond(name, levels, trials)
            if not wider:
                break
            for key, value in wider.items():
                levels[key] = sorted([*levels[key], value])
            near = _neighbours(levels, result.best)
            trials.measure([setting for setting in near if setting not in result.settings])
        wider, capped = self._beyond(name, levels, trials)
        why = (
            f"the box was widened {self.widen} times" if self.widen else "the box is as configured"
        )
        result.edges.update(capped)
        result.edges.update({key: _edge_message(key, result.best[key], why) for key in wider})
        return result

    def _beyond(
        self, name: str, levels: Levels, trials: _Trials
    ) -> tuple[dict[str, float], dict[str, str]]:
        """Return the next value beyond each edge that the optimum is on, and the reasons of caps.

        A hyperparameter whose next value a cap excludes is only in the second.
        """
        wider, capped = {}, {}
        best = trials.result.best
        for key, values in levels.items():
            value = best[key]
            if value not in (values[0], values[-1]):
                continue
            inner = values[1] if value == values[0] else values[-2]
            if trials.is_flat({**best, key: inner}):
                continue
            beyond = float(f"{value * (value / inner):.6g}")
            cap = self.caps.get(name, {}).get(key, {})
            if cap.get("low", 0.0) <= beyond <= cap.get("high", math.inf):
                wider[key] = beyond
            else:
                capped[key] = _edge_message(key, value, cap["reason"])
        return wider, capped

    def _grid(self, name: str) -> Mapping[str, Sequence[Any]]:
        if name not in self.grids:
            raise ValueError(f"the search has no grid for {name!r}, only for {sorted(self.grids)}")
        return self.grids[name]


@dataclass
class _Trials:
    estimator: Any
    X: FloatArray
    Y: FloatArray
    folds: Sequence[IntArray]
    output_scaling: Scaling
    on_setting: Callable[[dict[str, Any], float], None] | None
    result: SearchResult = field(default_factory=lambda: SearchResult([], []))

    def measure(self, settings: Sequence[dict[str, Any]]) -> None:
        """Add settings and their RMSE to the result; call the listener with each."""
        # Settings are measured group by group, not in order; inf marks those that cannot be fitted.
        result, first = self.result, len(self.result.settings)
        result.settings.extend(settings)
        result.rmse.extend([math.inf] * len(settings))
        result.fold_rmse.extend([[math.inf] * len(self.folds)] * len(settings))
        actual = [self.output_scaling.undo(self.Y[rows]) for rows in self.folds]
        for group in _groups(self.estimator, settings):
            # The settings of a group share one predictor, and so its Gram matrices.
            predict: Predictor | None = None
            for k in group:
                setting = settings[k]
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore", ConvergenceWarning)
                        predict = predict or _predictor(
                            self.estimator, setting, self.X, self.Y, self.folds
                        )
                        predicted = [self.output_scaling.undo(v) for v in predict(setting)]
                    errors = list(map(root_mean_squared_error, actual, predicted))
                    result.fold_rmse[first + k] = errors
                    result.rmse[first + k] = float(np.mean(errors))
                except ValueError as error:
                    result.failures.append(f"{setting}: {error}")
                if self.on_setting is not None:
                    self.on_setting(setting, result.rmse[first + k])

    def is_flat(self, other: dict[str, Any]) -> bool:
        """Return whether the edge is flat from the best setting to `other`, the next inwards."""
        places = [self.result.settings.index(setting) for setting in (self.result.best, other)]
        best, inner = (np.array(self.result.fold_rmse[place]) for place in places)
        rise = inner - best
        if not np.isfinite(rise).all():
            return False
        scatter = float(rise.std(ddof=1)) / math.sqrt(len(rise))
        return float(rise.mean()) <= max(FLAT * float(best.mean()), scatter)


def _edge_message(key: str, value: float, why: str) -> str:
    return f"the best {key}, {value:g}, is on the edge: {why}"


def _levels(grid: Mapping[str, Sequence[Any]]) -> Levels:
    """Return the values in order of each hyperparameter that has several, all positive numbers."""
    return {
        key: sorted(set(values))
        for key, values in grid.items()
        if len(set(values)) > 1
        and all(isinstance(v, int | float) and not isinstance(v, bool) and v > 0 for v in values)
    }


def _neighbours(levels: Levels, best: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the settings within one step of `best` in every hyperparameter."""
    places = {key: values.index(best[key]) for key, values in levels.items()}
    near = [values[max(places[key] - 1, 0) : places[key] + 2] for key, values in levels.items()]
    return [
        {**best, **dict(zip(levels, values, strict=True))} for values in itertools.product(*near)
    ]


def _groups(estimator: Any, settings: Sequence[Mapping[str, Any]]) -> list[list[int]]:
    """Return the indices of the settings, grouped by the Gram matrix or fit they need."""
    groups: dict[str, list[int]] = {}
    for k, chosen in enumerate(settings):
        candidate = clone(estimator).set_params(**chosen)
        shared: Any = chosen
        if isinstance(candidate, MSVR) and candidate.shares_gram:
            shared = {
                key: value for key, value in chosen.items() if key not in SAME_GRAM_PARAMETERS
            }
        groups.setdefault(repr(shared), []).append(k)
    return list(groups.values())


def _predictor(
    estimator: Any,
    first: Mapping[str, Any],
    X: FloatArray,
    Y: FloatArray,
    folds: Sequence[IntArray],
) -> Predictor:
    """Return a function that predicts each fold from all others, for settings like `first`."""
    candidate = clone(estimator).set_params(**first)
    if isinstance(candidate, MSVR) and candidate.shares_gram:
        return candidate.cross_predictor(X, Y, folds)

    def predict(setting: Mapping[str, Any]) -> list[FloatArray]:
        predictions = []
        for rows in folds:
            others = np.setdiff1d(np.arange(len(X)), rows)
            model = clone(estimator).set_params(**setting).fit(X[others], Y[others])
            rule = f"predict of {type(estimator).__name__} must return finite numbers"
            predictions.append(check_estimates(rule, model.predict(X[rows]), Y[rows].shape))
        return predictions

    return predict
