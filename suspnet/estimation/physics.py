"""Physics that a model lacks: the unexplained residual of healthy trips, and its possible cost.

With d_gf the logarithm of the response of group g of the healthy trips in bin f over that of the
commissioned vehicle, and s_gf the standard deviation of its real and imaginary part::

    d_f = sum_g d_gf / s_gf^2 / sum_g 1 / s_gf^2,     v_f = 1 / sum_g 1 / s_gf^2
    e = max(0, 1 - 1 / mean_f |d_f|^2 / (2 v_f))

e is the fraction of |d|^2 that is not due to noise, for each of both responses, and sqrt(e) d the
systematic error of the model's curves, with either sign. The cost of an output is ``WORN`` times
the rms change of its logarithm when curves like the training curves are multiplied by
exp(+-sqrt(e) d). It counts as one more standard deviation of the estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from suspnet.estimation.estimate import Flags
from suspnet.ground.types import ComplexArray, FloatArray

INCOMPLETE = 1.09
"""Misfit of the healthy trips above which the physics is considered incomplete.

Three trips of vehicles within the model family gave 0.94 to 1.06, fitted without their axle
guidance 1.2, those of one with a second bending mode 5.8 and more (tests/rich_train.py). Five trips
of a vehicle whose dampers blow off gave 1.095 (unflagged, the intervals of c_s held in 71 % of 17
of its 30 worn trips), of one with sensors on one side 1.083.
"""
COSTLY = 0.05
"""Cost of an output above which the physics is considered incomplete, unless all is noise.

Trains within the model family cost 0.1 % with sensor pairs and 3 % with sensors on one side;
dampers that blow off leave a misfit of only 1.1 and cost more than this
(tests/benchmarks/mismatch.py).
"""
ALL_NOISE = 1.0
"""Misfit up to which the residual is noise alone, whatever the cost.

Short trips with sensors on one side are so noisy that their mean residual, to which noise
contributes, can cost more than ``COSTLY``; the intervals include it (five trips of 5 minutes had a
misfit of 0.95 and a cost of c_p of 8 %).
"""
WORN = 2.0
"""Model error on worn vehicles over that on healthy ones, which the fit minimises: with this factor
90 % intervals of worn trains with a second bending mode hold in 82 to 100 %, with 1 only in
53 to 95 %."""


@dataclass(frozen=True)
class Residual:
    """Mean unexplained difference of healthy trips from the vehicle commissioned on them.

    `misfit` is the rms of the residual over that of the noise, 1 if the vehicle explains all;
    `logs` (2, n_freq) is sqrt(e) d of G_p and G_s.
    """

    misfit: float
    logs: ComplexArray

    @classmethod
    def of(
        cls, misfit: float, observed: ComplexArray, fitted: ComplexArray, deviations: FloatArray
    ) -> Self:
        """Return the residual of some groups of healthy trips.

        `observed`, `fitted`: (n_groups, 2, n_freq); `deviations`, of the same shape, are those of
        the observed log-magnitudes, infinite where a bin is not used.
        """
        weights = 1 / deviations**2
        total = weights.sum(axis=0)
        used = total > 0
        sums = (weights * np.log(observed / fitted)).sum(axis=0)
        mean = np.divide(sums, total, out=np.zeros_like(sums), where=used)
        over_noise = (np.abs(mean) ** 2 * total / 2).sum(axis=1) / np.maximum(used.sum(axis=1), 1)
        share = 1 - 1 / np.maximum(over_noise, 1)
        return cls(misfit, np.sqrt(share)[:, None] * mean)


@dataclass(frozen=True)
class Unexplained:
    """Misfit of a model's healthy trips (see ``Residual``) and the cost of their residual.

    `costs` (n_outputs,) are standard deviations to add to the logarithm of each output.
    """

    misfit: float
    costs: FloatArray

    @property
    def is_incomplete(self) -> bool:
        """Whether the misfit or its cost shows that the model lacks physics."""
        costly = self.misfit > ALL_NOISE and bool((self.costs > COSTLY).any())
        return costly or self.misfit > INCOMPLETE

    @property
    def words(self) -> str:
        """The reason as a sentence; empty if the physics is complete."""
        if not self.is_incomplete:
            return ""
        return (
            f"the commissioned vehicle leaves {self.misfit:.3g} times the noise of its healthy "
            f"trips unexplained, which can cost {100 * float(self.costs.max()):.2g} %"
        )

    def flagged(self, flags: Flags) -> Flags:
        """Return the flags with that of incomplete physics set if applicable."""
        if not self.is_incomplete:
            return flags
        return flags.with_kind("physics", self.words)

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays of misfit and costs, for storage."""
        return {"misfit": np.array([self.misfit]), "costs": self.costs}

    @classmethod
    def restored(cls, arrays: Mapping[str, FloatArray]) -> Self:
        """Return misfit and costs from their `state`; KeyError or ValueError if it is invalid."""
        misfit, costs = arrays["misfit"], arrays["costs"]
        if misfit.shape != (1,) or not misfit[0] >= 0:
            raise ValueError("`misfit` must be one number >= 0")
        if costs.ndim != 1 or not (np.isfinite(costs) & (costs >= 0)).all():
            raise ValueError("`costs` must be a list of numbers >= 0")
        return cls(float(misfit[0]), costs)
