"""Split-conformal prediction intervals, normalised by the residual scale of each sample.

With r the residual and d the residual scale of calibration sample i, output j::

    s_ij = |r_ij| / d_ij,   half width of a new sample = d_j q_j,   q_j = s_(k)j,
    k = ceil((n + 1) level)

where s_(k)j is the k-th smallest score. If new samples are drawn as the calibration samples were,
the interval holds the truth with probability of at least `level` (Papadopoulos et al., Inductive
confidence machines for regression, 2002; Lei et al., Distribution-free predictive inference for
regression, 2018). For all outputs at once the largest score of each sample takes the place of s_ij.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from suspnet.ground.checks import check_number
from suspnet.ground.types import FloatArray


@dataclass(frozen=True)
class Conformal:
    """Scores of the calibration samples, from which the half widths follow.

    Attributes
    ----------
    scores : array of shape (n_calibration, n_outputs), [-]
        Residuals over residual scales, >= 0.
    """

    scores: FloatArray

    @classmethod
    def of(cls, residuals: FloatArray, scales: FloatArray) -> Self:
        """Return the calibration by residuals and residual scales, each (n_calibration, n_outputs).

        Raises
        ------
        ValueError
            If there is no sample, a value is not finite or a residual scale is not positive.
        """
        if residuals.ndim != 2 or residuals.shape != scales.shape or not len(residuals):
            raise ValueError(
                "residuals and scales must be of one shape (n_calibration, n_outputs), got "
                f"{residuals.shape} and {scales.shape}"
            )
        if not (np.isfinite(residuals).all() and np.isfinite(scales).all()):
            raise ValueError("residuals and scales must be finite")
        if not (scales > 0).all():
            raise ValueError("scales must be positive")
        return cls(np.abs(residuals) / scales)

    def factors(self, level: float) -> FloatArray:
        """Return q, half widths over residual scales, shape (n_outputs,).

        Infinite where so few samples cannot give so high a level.

        Raises
        ------
        ValueError
            Unless 0 < level < 1.
        """
        return _quantiles(self.scores, level)

    def joint_factor(self, level: float) -> float:
        """Return the factor of a box that holds all outputs at once with probability `level`."""
        return float(_quantiles(self.scores.max(axis=1, keepdims=True), level)[0])


def _quantiles(scores: FloatArray, level: float) -> FloatArray:
    """Return the k-th smallest score of each column, k = ceil((n + 1) level)."""
    check_number("level", level, above=0, below=1)
    n = len(scores)
    k = max(1, math.ceil((n + 1) * level - 1e-9))
    if k > n:
        return np.full(scores.shape[1], np.inf)
    return np.asarray(np.partition(scores, k - 1, axis=0)[k - 1])
