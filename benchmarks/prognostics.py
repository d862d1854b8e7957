"""Measures of predicted lives, as progpy 1.9.0 defines them (progpy.metrics, NASA)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike


def alpha_lambda(
    samples_km: ArrayLike, now_km: float, event_km: float, alpha: float, beta: float
) -> bool:
    """Return whether the share `beta` of the predicted events is within `alpha` of the truth.

    Within means strictly between event -+ alpha * (event - now); ``progpy.metrics.alpha_lambda``.

    Parameters
    ----------
    samples_km : array of shape (n_samples,), [km]
        Mileages of the event, not mileages still to go.
    """
    reach = alpha * (event_km - now_km)
    samples = np.asarray(samples_km, dtype=float)
    return bool(np.mean((samples > event_km - reach) & (samples < event_km + reach)) >= beta)


def cumulative_relative_accuracy(centres_km: Sequence[float], event_km: float) -> float:
    """Return the mean over predictions of 1 - |event - centre| / event.

    ``progpy.metrics.cumulative_relative_accuracy``, where the centre is the mean of the predicted
    mileages of the event.
    """
    return float(np.mean(1 - np.abs(event_km - np.asarray(centres_km, dtype=float)) / event_km))
