"""A model, and a fitted method with all it needs: task, scaling, generator, calibration."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.curves.estimates import Observation, Observer
from suspnet.curves.protocols import Task
from suspnet.estimation.estimate import Flags, HealthyValues
from suspnet.estimation.flags import OODDetector
from suspnet.estimation.intervals import Intervals
from suspnet.estimation.refine import Refined
from suspnet.ground.types import FloatArray, IntArray
from suspnet.learning import Scaling
from suspnet.learning.metrics import check_estimates
from suspnet.vehicle import ResponseGenerator, Vehicle


class ModelFileError(ValueError):
    """A model file is damaged, foreign or of a different kind than needed."""


class Model:
    """What a run folder holds to estimate with: a `FittedMethod`, or a `BogieModel` of parts.

    Attributes
    ----------
    name : str
        A key of ``suspnet.learning.METHODS``, or "bogie".
    generator : ResponseGenerator
        The vehicle, both sides and axles as equal.
    settings : Observation
        How curves are observed; of models that read trips an ``EstimateSettings``.
    training : dict
        Record of the training or commissioning.
    """

    name: str
    generator: ResponseGenerator
    settings: Observation
    training: dict[str, Any]

    @property
    def vehicle(self) -> Vehicle:
        """The healthy vehicle."""
        return self.generator.vehicle

    @property
    def outputs(self) -> tuple[str, ...]:
        """What is estimated."""
        return self.healthy.names

    @cached_property
    def healthy(self) -> HealthyValues:
        """Values of the healthy vehicle in SI units, which estimates are relative to."""
        raise NotImplementedError


@dataclass(frozen=True)
class FittedMethod(Model):
    """A fitted method with everything needed to use it.

    Attributes
    ----------
    name : str
        A key of ``suspnet.learning.METHODS``.
    estimator : object
        The fitted method; works on scaled inputs and outputs.
    task : Task
        With its fitted feature set.
    generator : ResponseGenerator
        Generator of the training curves.
    settings : Observation
        How the training curves were observed.
    healthy_features : array of shape (n_features,)
        Features of the healthy vehicle, which the inputs are relative to.
    input_scaling, output_scaling : Scaling or None
        None for methods that fit curves directly.
    corrected : bool
        Whether the regression's own error is removed from its estimates: see `from_curves`.
    refined : bool
        Whether its estimates are refined by `refine`.
    intervals : Intervals or None
    ood : OODDetector or None
        Both are None if the model was not calibrated.
    training : dict
        Record of the training.
    """

    name: str
    estimator: Any
    task: Task
    generator: ResponseGenerator
    settings: Observation
    healthy_features: FloatArray
    input_scaling: Scaling | None = None
    output_scaling: Scaling | None = None
    corrected: bool = False
    refined: bool = False
    intervals: Intervals | None = None
    ood: OODDetector | None = None
    training: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def observer(self) -> Observer:
        """Observer that makes curves like those of the training, on the CPU."""
        return self.settings.observer(self.generator.on("cpu"))

    @property
    def log(self) -> bool:
        """Whether residuals are those of logarithms."""
        return self.output_scaling is None or self.output_scaling.log

    @cached_property
    def healthy(self) -> HealthyValues:
        """Values of the healthy vehicle in SI units, which estimates are relative to."""
        return HealthyValues.of(self.generator, self.task.outputs)

    def features(self, curves: Tensor, frequencies_hz: Tensor) -> tuple[FloatArray, IntArray]:
        """Return features of curves relative to the healthy vehicle's, and why some are missing.

        `curves` (n_curves, 2, n_freq) are G_p and G_s, complex; for the feature set `peaks` their
        magnitudes suffice. `frequencies_hz` (n_freq,) are spaced as in `settings`. Features have
        the shape (n_curves, n_features), NaN where a peak is missing, reasons (n_curves, n_peaks).
        """
        extractor = self.task.extractor
        table = extractor.extract(curves, frequencies_hz.to(curves.device))
        features = extractor.relative(table.values.cpu().numpy(), self.healthy_features)
        return features, table.reasons.cpu().numpy()

    def predict(self, inputs: ArrayLike) -> FloatArray:
        """Return parameters relative to healthy, shape (n_curves, n_outputs), [-].

        `inputs` (n_curves, n_inputs) are features relative to the healthy vehicle's, named as
        ``task.inputs``. Estimates are bounded to half the lowest and twice the highest ratio of the
        training: a regression knows nothing farther away. ValueError if the inputs do not fit the
        model, or it fits curves and has no inputs, or the method does not return a finite number
        for each curve and output.
        """
        if self.input_scaling is None or self.output_scaling is None:
            raise ValueError(f"{self.name} works on curves, not on features")
        inputs = np.asarray(inputs, dtype=np.float64)
        if inputs.ndim != 2 or inputs.shape[1] != len(self.task.inputs):
            raise ValueError(
                f"`inputs` must have shape (n_curves, {len(self.task.inputs)}) with columns "
                f"{self.task.inputs}, got {inputs.shape}"
            )
        if not np.isfinite(inputs).all() or (self.input_scaling.log and not (inputs > 0).all()):
            raise ValueError("`inputs` must be positive and finite; leave out missing peaks")
        scaled = self.regressed(self.input_scaling.apply(inputs))
        with np.errstate(over="ignore"):  # beyond the bounds even if it is infinite
            ratios = self.output_scaling.undo(scaled)
        return self.task.bounded(ratios)

    def regressed(self, scaled: FloatArray) -> FloatArray:
        """Return scaled estimates (n_curves, n_outputs) of the method from scaled inputs.

        ValueError unless it returns a finite number for each curve and output.
        """
        return check_estimates(
            f"predict of the method {self.name!r} must return finite numbers",
            self.estimator.predict(scaled),
            (len(scaled), len(self.task.outputs)),
        )

    def scaled(self, inputs: FloatArray) -> FloatArray:
        """Return scaled inputs (n_curves, n_inputs); missing ones are NaN."""
        if self.input_scaling is None:
            return np.full_like(inputs, np.nan)
        unusable = ~np.isfinite(inputs) | (self.input_scaling.log & ~(inputs > 0))
        return self.input_scaling.apply(np.where(unusable, np.nan, inputs))

    def with_estimates(self, inputs: FloatArray, estimates: FloatArray) -> FloatArray:
        """Return scaled inputs and estimates side by side: the inputs of a residual scale."""
        if self.output_scaling is None:
            return np.log(estimates)
        return np.column_stack([self.scaled(inputs), self.output_scaling.apply(estimates)])

    def flags(self, inputs: FloatArray, reasons: IntArray, refined: Refined) -> Flags:
        """Return the flags that the OOD detector sets.

        `inputs` (n_curves, n_inputs) are not scaled; `reasons` are those of `features`.
        """
        assert self.ood is not None
        extractor = self.task.extractor
        missing = [extractor.missing(row) if row.any() else "" for row in reasons]
        return self.ood.flags(self.task, missing, self.scaled(inputs), refined)
