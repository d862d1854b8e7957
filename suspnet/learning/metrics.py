"""Scores of estimates: MAPE and RMSE, Eqs. (14) and (15), on ratios to healthy; coverage."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.metrics import mean_absolute_percentage_error, root_mean_squared_error

from suspnet.ground.types import BoolArray, FloatArray

METRICS = ("mape_percent", "rmse")
SUBSETS: Mapping[str, Callable[[FloatArray], BoolArray]] = {
    "varied": lambda ratios: ratios != 1,
    "degraded": lambda ratios: ratios < 1,
}
"""Name of each choice of test curves by the actual ratio of an output."""
Ends = tuple[FloatArray, FloatArray]  # lower and upper ends of intervals


def check_estimates(rule: str, estimates: ArrayLike, shape: tuple[int, int]) -> FloatArray:
    """Return estimates (n_samples, n_outputs) as numbers; ValueError unless they are finite.

    `rule` starts the message, such as "`predicted` must hold finite estimates". The shape must be
    `shape`; of a single output (n_samples,) will do, as some of scikit-learn's regressors give it.
    """
    values = np.asarray(estimates, dtype=np.float64)
    if values.shape == shape[:1] and shape[1] == 1:
        values = values[:, None]
    if values.shape != shape or not np.isfinite(values).all():
        got = "numbers that are not finite" if values.shape == shape else f"shape {values.shape}"
        raise ValueError(f"{rule}, shape {shape}, got {got}")
    return values


def score(
    actual: FloatArray, predicted: FloatArray, outputs: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return {output: {"mape_percent": ..., "rmse": ...}} of ratios (n_samples, n_outputs).

    MAPE = 100/n sum |A - F| / A (Eq. 14), RMSE = sqrt(1/n sum (A - F)^2) (Eq. 15), A actual and F
    predicted. Relative *changes* would divide by 0 at healthy.
    """
    mape = 100 * mean_absolute_percentage_error(actual, predicted, multioutput="raw_values")
    rmse = root_mean_squared_error(actual, predicted, multioutput="raw_values")
    return {
        name: {"mape_percent": float(mape[j]), "rmse": float(rmse[j])}
        for j, name in enumerate(outputs)
    }


def score_where(
    actual: FloatArray, predicted: FloatArray, outputs: Sequence[str]
) -> dict[str, dict[str, dict[str, float | None]]]:
    """Return `score` of each output on the curves of each of ``SUBSETS``; None without curves."""
    scores_of: dict[str, dict[str, dict[str, float | None]]] = {name: {} for name in SUBSETS}
    for subset, chosen in SUBSETS.items():
        for j, output in enumerate(outputs):
            rows = chosen(actual[:, j])
            scores_of[subset][output] = dict.fromkeys(METRICS)
            if rows.any():
                scores = score(actual[rows][:, [j]], predicted[rows][:, [j]], [output])
                scores_of[subset][output].update(scores[output])
    return scores_of


def interval_scores(
    actual: FloatArray, intervals: Ends, joint: Ends, outputs: Sequence[str]
) -> dict[str, Any]:
    """Return coverage and width of intervals for each output, and of joint ones for all outputs.

    `actual` and the lower and upper ends of intervals: (n_samples, n_outputs). Half widths are
    relative to the actual value.
    """
    within = covers(actual, intervals)
    half = 50 * (intervals[1] - intervals[0]) / actual
    return {
        "outputs": {
            name: {
                "coverage_percent": 100 * float(within[:, j].mean()),
                "half_width_percent": float(half[:, j].mean()),
            }
            for j, name in enumerate(outputs)
        },
        "joint_coverage_percent": 100 * float(covers(actual, joint).all(axis=1).mean()),
    }


def covers(actual: FloatArray, intervals: Ends) -> BoolArray:
    """Return whether each value lies within its interval, (n_samples, n_outputs)."""
    return np.asarray((intervals[0] <= actual) & (actual <= intervals[1]))
