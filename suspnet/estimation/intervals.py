"""Prediction intervals of stiffness and damping, calibrated on fresh simulated curves.

Split-conformal, normalised by the residual scale of each sample. With r the residual and d the
residual scale of calibration sample i, output j::

    s_ij = |r_ij| / d_ij,   half width of a new sample = d_j q_j,   q_j = s_(k)j,
    k = ceil((n + 1) level)

where s_(k)j is the k-th smallest score. If new samples are drawn as the calibration samples were,
the interval holds the truth with probability of at least `level` (Papadopoulos et al., Inductive
confidence machines for regression, 2002; Lei et al., Distribution-free predictive inference for
regression, 2018). For all outputs at once the largest score of each sample replaces s_ij.

The residual scale of a refined estimate is its standard deviation from Gauss-Newton. For any other
method it is learnt, by an MSVR from the features to the logarithm of the absolute residual, on
other curves than those that give the scores.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray
from suspnet.learning import MSVR, Scaling

SMALLEST_SHARE = 1e-3
"""Floor of the absolute residuals as a fraction of their median, since their logarithm is taken, or
of their mean where most are zero."""
PENALTY = 0.1  # C of the MSVR; small, as the logarithm of a residual scatters by 1.1 about its mean
N_COMPONENTS = 512
LARGEST_MISFIT = 3.0
"""Misfit of a trip up to which its curve is explained and the misfit widens the interval; above it
the trip has no estimate."""
SCALE = "residual_scale."  # name prefix of the residual scale's arrays


@dataclass(frozen=True)
class Conformal:
    """Scores of the calibration samples, which determine the half widths.

    `scores` (n_calibration, n_outputs) are absolute residuals over residual scales.
    """

    scores: FloatArray

    @classmethod
    def of(cls, residuals: FloatArray, scales: FloatArray) -> Self:
        """Return the scores of residuals and residual scales, each (n_calibration, n_outputs).

        Raises ValueError if there is no sample, a value is not finite or a scale is not positive.
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

        Infinite where there are too few samples for the level; ValueError unless 0 < level < 1.
        """
        return _quantiles(self.scores, level)

    def joint_factor(self, level: float) -> float:
        """Return the factor for a box that contains all outputs with probability `level`."""
        return float(_quantiles(self.scores.max(axis=1, keepdims=True), level)[0])


def _quantiles(scores: FloatArray, level: float) -> FloatArray:
    """Return the k-th smallest score of each column, k = ceil((n + 1) level)."""
    check_number("level", level, above=0, below=1)
    n = len(scores)
    k = max(1, math.ceil((n + 1) * level - 1e-9))
    if k > n:
        return np.full(scores.shape[1], np.inf)
    return np.asarray(np.partition(scores, k - 1, axis=0)[k - 1])


@dataclass(frozen=True)
class ResidualScale:
    """Regression of scaled logarithms of absolute residuals on scaled inputs."""

    regression: MSVR
    scaling: Scaling

    @classmethod
    def learnt(cls, inputs: FloatArray, residuals: FloatArray) -> Self:
        """Return the residual scale learnt from scaled `inputs` (n, n_inputs).

        `residuals` has the shape (n, n_outputs). Raises ValueError if all of an output are equal.
        """
        sizes = np.abs(residuals)
        usual = np.median(sizes, axis=0)
        # a fit of curves that finds which parameters have not changed has no error in these
        usual = np.where(usual > 0, usual, sizes.mean(axis=0))
        sizes = np.maximum(sizes, SMALLEST_SHARE * usual)
        scaling = Scaling.of(sizes)
        regression = _learner(inputs.shape[1]).fit(inputs, scaling.apply(sizes))
        return cls(regression, scaling)

    def predict(self, inputs: FloatArray) -> FloatArray:
        """Return the residual scale (n, n_outputs) of scaled inputs (n, n_inputs)."""
        scaled = self.regression.predict(inputs)
        return self.scaling.undo(np.asarray(scaled).reshape(len(inputs), -1))


@dataclass(frozen=True)
class Intervals:
    """Calibrated intervals of estimates.

    `log` states whether residuals are those of logarithms: intervals are then
    estimate * exp(+-half width), else estimate +- half width. `residual_scale` is None where the
    deviations of the refined estimate are used.
    """

    conformal: Conformal
    log: bool
    residual_scale: ResidualScale | None

    @classmethod
    def learnt(cls, inputs: FloatArray, residuals: FloatArray, log: bool) -> Self:
        """Return intervals whose residual scale is learnt from one half of the samples.

        The other half gives the scores, which would be too small on the samples that train the
        scale. Any fraction from a third to five sixths gives the same width to 1 % (measured), and
        more scores make the coverage scatter less. `inputs` (n, n_inputs) are scaled; `residuals`:
        (n, n_outputs).
        """
        half = len(residuals) // 2
        scale = ResidualScale.learnt(inputs[:half], residuals[:half])
        return cls(Conformal.of(residuals[half:], scale.predict(inputs[half:])), log, scale)

    def ends(
        self, estimates: FloatArray, scales: FloatArray, level: float, joint: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper ends of the intervals, each (n, n_outputs), [-].

        `estimates` and `scales` have the same shape. With `joint`, all outputs are inside at once
        with the probability `level`, instead of each.
        """
        factors = self.conformal.joint_factor(level) if joint else self.conformal.factors(level)
        half = scales * factors
        if self.log:
            return estimates * np.exp(-half), estimates * np.exp(half)
        return estimates - half, estimates + half

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays of the intervals, for storage."""
        arrays = {"scores": self.conformal.scores, "log": np.array([float(self.log)])}
        if self.residual_scale is not None:
            regression, scaling = self.residual_scale.regression, self.residual_scale.scaling
            arrays |= {SCALE + name: array for name, array in regression.state().items()}
            arrays |= {"size_mean": scaling.mean, "size_scale": scaling.scale}
        return arrays

    @classmethod
    def restored(cls, arrays: Mapping[str, FloatArray]) -> Self:
        """Return the intervals from their `state`; KeyError or ValueError if it is invalid."""
        scores, log = arrays["scores"], arrays["log"]
        if scores.ndim != 2 or not len(scores) or not (np.isfinite(scores) & (scores >= 0)).all():
            raise ValueError("`scores` must be a table of numbers >= 0")
        if log.shape != (1,):
            raise ValueError(f"`log` must be one number, got shape {log.shape}")
        learnt = {
            key.removeprefix(SCALE): value for key, value in arrays.items() if key.startswith(SCALE)
        }
        residual_scale = None
        if learnt:
            regression = _learner(1).restore(learnt)
            scaling = Scaling(arrays["size_mean"], arrays["size_scale"])
            shapes = {a.shape for a in (scaling.mean, scaling.scale, regression.intercept_)}
            if shapes != {(scores.shape[1],)}:
                raise ValueError(
                    f"`scores` has {scores.shape[1]} outputs, the residual scale {shapes}"
                )
            residual_scale = ResidualScale(regression, scaling)
        return cls(Conformal(scores), bool(log[0]), residual_scale)


def residuals(estimates: FloatArray, truth: FloatArray, log: bool) -> FloatArray:
    """Return estimates minus truth, of the logarithms if `log`."""
    return np.log(estimates / truth) if log else estimates - truth


def _learner(n_inputs: int) -> MSVR:
    """Return the regression of a residual scale, with a kernel width for standardised inputs."""
    return MSVR(PENALTY, math.sqrt(n_inputs), n_components=N_COMPONENTS, random_state=0)
