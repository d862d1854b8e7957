"""MAPE and RMSE of Eqs. (14) and (15), on parameters relative to healthy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import mean_absolute_percentage_error, root_mean_squared_error

METRICS = ("mape_percent", "rmse")
FloatArray = NDArray[np.float64]


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
