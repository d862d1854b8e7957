"""Reasons not to trust an estimate: input out of distribution (OOD), a doubtful healthy vehicle.

There are five kinds of flags. `OODDetector` sets four: a peak is missing; the features lie outside
the cloud of the training curves; a parameter lies outside the training range; the generator does
not explain the curve with any parameters. That of physics is on every trip that is read with a
bogie whose commissioning did not converge.
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
from suspnet.ground.types import BoolArray, FloatArray

N_REFERENCE, N_NEIGHBOURS = 4096, 4
"""Number of training features that the detector stores, and of the nearest neighbours over which
the distance is averaged."""
FALSE_ALARMS = 1e-4  # false-alarm rate of the feature distance on curves like the training curves
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
        of_curves = zip(missing, distances, refined.misfit, strict=True)
        for i, (words, distance, misfit) in enumerate(of_curves):
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
                numbers = {"misfit": misfit, "misfit_threshold": self.misfit_threshold}
                reasons.append(("misfit", Finding("unexplained-curve", **numbers)))
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
