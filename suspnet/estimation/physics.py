"""Physics that a model lacks: what healthy trips leave unexplained, and what that could cost.

With d_gf the logarithm of what group g of the healthy trips shows in bin f over what the
commissioned vehicle gives there, and s_gf the standard deviation of its real and imaginary part::

    d_f = sum_g d_gf / s_gf^2 / sum_g 1 / s_gf^2,     v_f = 1 / sum_g 1 / s_gf^2
    e = max(0, 1 - 1 / mean_f |d_f|^2 / (2 v_f))

e is the share of |d|^2 that noise does not make, for each of both responses, and sqrt(e) d the
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
"""Misfit of the healthy trips above which the physics is called incomplete.

Three trips of vehicles that the family holds gave 0.94 to 1.06, read without their axle guidance
1.2, those of one with a second bending mode 5.8 and more (tests/rich_train.py); five trips of one
whose dampers blow off 1.095 (17 of its 30 worn trips held c_s in 71 % when they went unflagged), of
one with sensors on one side 1.083.
"""
COSTLY = 0.05
"""Cost of an output above which the physics is called incomplete, unless all is noise.

Trains that the family holds cost 0.1 % with sensor pairs and 3 % with sensors on one side; dampers
that blow off leave a misfit of only 1.1 and cost more than this (tests/benchmarks/mismatch.py)."""
ALL_NOISE = 1.0
"""Misfit up to which noise alone is left, whatever the cost.

Short trips of sensors on one side are so noisy that their mean residual, which noise makes too, can
cost more than ``COSTLY``; the intervals hold it (five of 5 minutes left 0.95 and cost c_p 8 %)."""
WORN = 2.0
"""Error on worn vehicles over that on healthy ones, where the fit has made it least: with it 90 %
intervals of worn trains with a second bending mode hold 82 to 100 %, with 1 only 53 to 95 %."""


@dataclass(frozen=True)
class Residual:
    """Mean difference of healthy trips from the vehicle that was commissioned on them.

    Attributes
    ----------
    misfit : float, [-]
        Rms of what the vehicle leaves unexplained over that of the noise; 1 if it explains all.
    logs : complex array of shape (2, n_freq), [-]
        sqrt(e) d, of G_p and G_s.
    """

    misfit: float
    logs: ComplexArray

    @classmethod
    def of(
        cls, misfit: float, observed: ComplexArray, fitted: ComplexArray, deviations: FloatArray
    ) -> Self:
        """Return the residual of some groups of healthy trips.

        Parameters
        ----------
        misfit : float, [-]
        observed, fitted : complex arrays of shape (n_groups, 2, n_freq), [-]
        deviations : array of shape (n_groups, 2, n_freq), [-]
            Of the observed log-magnitudes; infinite where a bin is not to be used.
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
    """What a model's healthy trips leave unexplained, and its cost.

    Attributes
    ----------
    misfit : float, [-]
        See ``Residual``.
    costs : array of shape (n_outputs,), [-]
        Standard deviation that it adds to the logarithm of each output.
    """

    misfit: float
    costs: FloatArray

    @property
    def is_incomplete(self) -> bool:
        """Whether the misfit or its cost says that the model lacks physics."""
        costly = self.misfit > ALL_NOISE and bool((self.costs > COSTLY).any())
        return costly or self.misfit > INCOMPLETE

    @property
    def words(self) -> str:
        """The finding as a sentence; empty if the physics is complete."""
        if not self.is_incomplete:
            return ""
        return (
            f"the commissioned vehicle leaves {self.misfit:.3g} times the noise of its healthy "
            f"trips unexplained, which can cost {100 * float(self.costs.max()):.2g} %"
        )

    def flagged(self, flags: Flags) -> Flags:
        """Return flags with that of incomplete physics, where it is."""
        if not self.is_incomplete:
            return flags
        return flags.with_kind("physics", self.words)

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays that make it up, for storage."""
        return {"misfit": np.array([self.misfit]), "costs": self.costs}

    @classmethod
    def restored(cls, arrays: Mapping[str, FloatArray]) -> Self:
        """Return what has this `state`; KeyError, ValueError if it is not one."""
        misfit, costs = arrays["misfit"], arrays["costs"]
        if misfit.shape != (1,) or not misfit[0] >= 0:
            raise ValueError("`misfit` must be one number >= 0")
        if costs.ndim != 1 or not (np.isfinite(costs) & (costs >= 0)).all():
            raise ValueError("`costs` must be a list of numbers >= 0")
        return cls(float(misfit[0]), costs)
