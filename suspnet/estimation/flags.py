"""Reasons not to trust an estimate: input out of distribution (OOD), and physics a model lacks.

There are five kinds of flags. `OODDetector` sets four: a peak is missing; the features lie outside
the cloud of the training curves; a parameter lies outside the training range; the generator does
not explain the curve with any parameters. `Unexplained` sets that of physics if the generator did
not explain the healthy trips of its commissioning, `with_doubt` on every trip read with a vehicle,
or a bogie, whose commissioning did not converge.

Unexplained residual: with d_gf the logarithm of the response of group g of the healthy trips in bin
f over that of the commissioned vehicle, and s_gf the standard deviation of its real and imaginary
part::

    d_f = sum_g d_gf / s_gf^2 / sum_g 1 / s_gf^2,     v_f = 1 / sum_g 1 / s_gf^2
    e = max(0, 1 - 1 / mean_f |d_f|^2 / (2 v_f))

e is the fraction of |d|^2 that is not due to noise, for each of both responses, and sqrt(e) d the
systematic error of the model's curves, with either sign. The cost of an output is ``WORN`` times
the rms change of its logarithm when curves like the training curves are multiplied by
exp(+-sqrt(e) d). It counts as one more standard deviation of the estimate.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from sklearn.neighbors import NearestNeighbors

from suspnet.curves.protocols import Task
from suspnet.estimation.estimate import Flags
from suspnet.estimation.refine import Refined
from suspnet.ground.findings import Finding
from suspnet.ground.parameters import BODY_MASS
from suspnet.ground.types import BoolArray, ComplexArray, FloatArray

INCOMPLETE = 1.09
"""Misfit of the healthy trips above which the physics is considered incomplete.

Vehicles within the model family stay below it, missing physics exceeds it (docs/methods.md).
"""
COSTLY = 0.05
"""Cost of an output above which the physics is considered incomplete, unless all is noise.

Dampers that blow off hardly raise the misfit, but cost more than this (docs/methods.md).
"""
ALL_NOISE = 1.0
"""Misfit up to which the residual is noise alone, whatever the cost.

Short trips with sensors on one side are so noisy that their mean residual, to which noise
contributes, can cost more than ``COSTLY``; the intervals include it.
"""
UNTRUSTED = 5.0
"""Misfit of the healthy trips above which intervals do not hold in spite of the residual's cost:
every estimate is flagged."""
WORN = 2.0
"""Model error on worn vehicles over that on healthy ones, which the fit minimises. With 1 the
intervals of worn vehicles with incomplete physics would be too narrow (docs/methods.md)."""


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
        cost_percent = float(f"{100 * self.costs.max():.2g}")
        return Finding("vehicle-incomplete", misfit=self.misfit, cost_percent=cost_percent)

    def flagged(self, flags: Flags) -> Flags:
        """Return the flags with that of incomplete physics set if intervals do not hold."""
        return flags.with_kind("physics", self.words) if self.misfit > UNTRUSTED else flags

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


NOT_CONVERGED = (
    "the search for the healthy vehicle did not converge when it was commissioned, so the interval "
    "is too narrow: commission again, on more or longer trips"
)
"""Flag of every trip that is read with such a vehicle."""
BOGIE_NOT_CONVERGED = (
    "the search for the healthy bogie did not end within its steps when it was commissioned, so "
    "that a wrong part may be named and intervals are too narrow: commission again with more "
    "healthy trips of several payloads and speeds, and with sensors at the axle boxes where there "
    "are none"
)
"""Flag of every trip of which each part is compared with such a bogie."""


def with_doubt(flags: Flags, *, has_converged: bool, words: str = NOT_CONVERGED) -> Flags:
    """Return the flags of a trip, with the doubt about the healthy vehicle it is compared with."""
    return flags if has_converged else flags.with_kind("physics", words)


N_REFERENCE, N_NEIGHBOURS = 4096, 4
"""Number of training features that the detector stores, and of the nearest neighbours over which
the distance is averaged."""
FALSE_ALARMS = 1e-4
"""False-alarm rate of the feature distance on curves like the training curves."""
MISFIT_DEVIATIONS = 4.5
"""Threshold of the misfit above its mean over curves like the training curves, in standard
deviations."""
EDGE_DEVIATIONS = 2.33
"""Standard deviations by which a parameter must lie outside its range to be flagged; it flags 1 %
of the vehicles on the edge of the range."""


@dataclass(frozen=True)
class OODDetector:
    """An out-of-distribution detector: training features, thresholds of distance and misfit.

    `reference` (n_reference, n_inputs) are scaled features of training curves, without rows for a
    method that works on curves. `distance_threshold` applies to the mean distance from the nearest
    neighbours.
    """

    reference: FloatArray
    distance_threshold: float
    misfit_threshold: float

    @classmethod
    def learnt(cls, training: FloatArray, fresh: FloatArray, misfits: FloatArray) -> Self:
        """Return the detector from scaled inputs (n, n_inputs) of training and of fresh curves.

        `misfits` (n_fits,) are those of refined estimates of fresh curves.
        """
        misfit_threshold = float(misfits.mean()) + MISFIT_DEVIATIONS * float(misfits.std())
        detector = cls(training[:N_REFERENCE], math.inf, misfit_threshold)
        if not len(training):
            return detector
        distances = np.sort(detector.distances(fresh))
        rank = min(math.ceil((len(distances) + 1) * (1 - FALSE_ALARMS)), len(distances))
        return replace(detector, distance_threshold=float(distances[rank - 1]))

    @cached_property
    def _neighbours(self) -> NearestNeighbors:
        return NearestNeighbors(n_neighbors=min(N_NEIGHBOURS, len(self.reference))).fit(
            self.reference
        )

    def distances(self, inputs: FloatArray) -> FloatArray:
        """Return the distance of scaled inputs (n, n_inputs) from the cloud, shape (n,), [-]."""
        return np.asarray(self._neighbours.kneighbors(inputs)[0].mean(axis=1))

    def flags(
        self, task: Task, missing: Sequence[str], inputs: FloatArray, refined: Refined
    ) -> Flags:
        """Return the flags of the estimates of some curves.

        `missing` states what is missing of each curve's features (empty: nothing); `inputs`
        (n_curves, n_inputs) are scaled, NaN where a peak is missing.
        """
        complete = np.isfinite(inputs).all(axis=1)
        distances = np.zeros(len(inputs))
        if complete.any():
            distances[complete] = self.distances(inputs[complete])
        # (n_curves, n_unknown)
        outside = np.stack([_outside(task, name, refined) for name in refined.names], axis=1)
        rows = []
        for i, (words, distance, misfit) in enumerate(
            zip(missing, distances, refined.misfit, strict=True)
        ):
            reasons: list[tuple[str, str]] = (
                [("missing", Finding("missing", words=words))] if words else []
            )
            if distance > self.distance_threshold:
                reasons.append(("cloud", self._far(task, inputs[i], distance)))
            reasons += [
                ("range", _out_of_range(task, name, refined.ratios[i, j]))
                for j, name in enumerate(refined.names)
                if outside[i, j]
            ]
            if not misfit <= self.misfit_threshold:
                reasons.append(
                    (
                        "misfit",
                        Finding(
                            "unexplained-curve",
                            misfit=misfit,
                            misfit_threshold=self.misfit_threshold,
                        ),
                    )
                )
            rows.append(tuple(reasons))
        return Flags(tuple(rows))

    def _far(self, task: Task, inputs: FloatArray, distance: float) -> str:
        low, high = self.reference.min(axis=0), self.reference.max(axis=0)
        beyond = np.maximum(low - inputs, inputs - high) / (high - low)
        worst = task.inputs[int(np.argmax(beyond))]
        return Finding(
            "far-from-training", distance_threshold=distance / self.distance_threshold, worst=worst
        )

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays of the detector, for storage."""
        thresholds = np.array([self.distance_threshold, self.misfit_threshold])
        return {"reference": self.reference, "thresholds": thresholds}

    @classmethod
    def restored(cls, arrays: Mapping[str, FloatArray]) -> Self:
        """Return the detector from its `state`; KeyError or ValueError if it is invalid."""
        reference, thresholds = arrays["reference"], arrays["thresholds"]
        if thresholds.shape != (2,) or np.isnan(thresholds).any():
            raise ValueError("`thresholds` must be two numbers")
        unused = np.isinf(thresholds[0])
        if (
            reference.ndim != 2
            or not (len(reference) or unused)
            or not np.isfinite(reference).all()
        ):
            raise ValueError("`reference` must be a table of finite numbers")
        return cls(reference, float(thresholds[0]), float(thresholds[1]))


def _outside(task: Task, name: str, refined: Refined) -> BoolArray:
    """Return which curves have a parameter clearly outside the training range."""
    low, high = np.log(_range(task, name))
    ratios, deviations = refined.of((name,))
    margin = EDGE_DEVIATIONS * deviations[:, 0]
    position = np.log(ratios[:, 0])
    return np.asarray((position < low - margin) | (position > high + margin))


def _range(task: Task, name: str) -> tuple[float, float]:
    """Return the training range; a grid covers half a step beyond its ends."""
    low, high = task.range(name)
    if task.sampling == "sobol":
        return low, high
    step = task.mass_step if name == BODY_MASS else task.step
    return low - step / 2, high + step / 2


def _out_of_range(task: Task, name: str, ratio: float) -> str:
    low, high = task.range(name)
    return Finding("outside-range", name=name, ratio=100 * ratio, low=100 * low, high=100 * high)
