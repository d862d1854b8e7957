"""MAPE and RMSE of Eqs. (14) and (15), on parameters relative to healthy; coverage, width."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from sklearn.metrics import mean_absolute_percentage_error, root_mean_squared_error

from suspnet.ground.types import BoolArray, FloatArray

METRICS = ("mape_percent", "rmse")
Ends = tuple[FloatArray, FloatArray]


def score(
    actual: FloatArray, predicted: FloatArray, outputs: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return {output: {"mape_percent": ..., "rmse": ...}}.

    MAPE = 100/n sum |A - F| / A (Eq. 14) and RMSE = sqrt(1/n sum (A - F)^2) (Eq. 15) with A the
    actual and F the predicted ratio to healthy: relative *changes* would divide by 0 at healthy.

    Parameters
    ----------
    actual, predicted : arrays of shape (n_samples, n_outputs), [-]
    outputs : sequence of str
    """
    mape = 100 * mean_absolute_percentage_error(actual, predicted, multioutput="raw_values")
    rmse = root_mean_squared_error(actual, predicted, multioutput="raw_values")
    return {
        name: {"mape_percent": float(mape[j]), "rmse": float(rmse[j])}
        for j, name in enumerate(outputs)
    }


def interval_scores(
    actual: FloatArray, intervals: Ends, joint: Ends, outputs: Sequence[str]
) -> dict[str, Any]:
    """Return how often intervals hold the actual value, and how wide they are.

    Parameters
    ----------
    actual : array of shape (n_samples, n_outputs), [-]
    intervals, joint : pairs of such arrays
        Lower and upper ends of the intervals for each output, and for all outputs at once.
    outputs : sequence of str

    Returns
    -------
    dict
        outputs: {output: {"coverage_percent": ..., "half_width_percent": ...}} with the half
        width relative to the actual value; joint_coverage_percent: all outputs at once.
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
