"""Trained models as two files, model.safetensors and model.json; no pickle, checked when loaded."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

import suspnet
from suspnet.data.curves import CurveSettings
from suspnet.data.estimates import EstimateSettings
from suspnet.data.protocols import Task
from suspnet.data.source import describe_task
from suspnet.dynamics import QuarterCar, Vehicle, VerticalVehicle
from suspnet.features import CurveFeatures, PeakFeatures
from suspnet.learning import MSVR, MVGPR, SVR, CurveFit, LinearRegression, Scaling
from suspnet.storage import (
    DamagedFileError,
    content_hash,
    dump_arrays,
    read_arrays,
    read_json,
    write_atomically,
    write_json,
)
from suspnet.uncertainty.intervals import Intervals
from suspnet.uncertainty.ood import Scope

SCHEMA_VERSION = 4
ESTIMATORS: dict[str, Any] = {
    "msvr": MSVR,
    "svr": SVR,
    "mvgpr": MVGPR,
    "linear": LinearRegression,
    "curve_fit": CurveFit,
}
"""Every method by the name of its file in configs/model/."""
GENERATORS: dict[str, type] = {"quarter_car": QuarterCar, "vertical_vehicle": VerticalVehicle}
SETTINGS: dict[str, type] = {"curves": CurveSettings, "trips": EstimateSettings}
FEATURE_SETS: dict[str, Any] = {kind.kind: kind for kind in (PeakFeatures, CurveFeatures)}
FEATURES, INTERVALS, SCOPE = "features.", "intervals.", "scope."
"""Begin the names of the arrays that belong to the feature set, the intervals and the scope."""
UNITS = {
    "inputs": "features (and car-body mass) relative to the healthy vehicle's, dimensionless",
    "outputs": "stiffness and damping relative to healthy, dimensionless; 1 is healthy",
    "healthy_features": "position and width in Hz, height dimensionless",
    "vehicle": "kg, N/m, N s/m",
}
FloatArray = NDArray[np.float64]


class ModelFileError(ValueError):
    """A model file is damaged, foreign or of another kind than needed."""


@dataclass(frozen=True)
class TrainedModel:
    """A fitted method with all that is needed to use it.

    Attributes
    ----------
    name : str
        A key of ``ESTIMATORS``.
    estimator : object
        The fitted method; works on scaled inputs and outputs.
    task : Task
        Its feature set with what that has learnt.
    generator : ResponseGenerator
        What the training curves were made with.
    settings : CurveSettings or EstimateSettings
        How the training curves were observed.
    healthy_features : array of shape (n_features,)
        Features of the healthy vehicle, which the inputs are relative to.
    input_scaling, output_scaling : Scaling or None
        None for methods that fit curves directly.
    refined : bool
        Whether its estimates are taken further by `refine`.
    intervals : Intervals or None
    scope : Scope or None
        None, both, where the model was not calibrated.
    training : dict
        How the training went.
    """

    name: str
    estimator: Any
    task: Task
    generator: QuarterCar | VerticalVehicle
    settings: CurveSettings | EstimateSettings
    healthy_features: FloatArray
    input_scaling: Scaling | None = None
    output_scaling: Scaling | None = None
    refined: bool = False
    intervals: Intervals | None = None
    scope: Scope | None = None
    training: dict[str, Any] = field(default_factory=dict)

    @property
    def vehicle(self) -> Vehicle:
        """The healthy vehicle."""
        return self.generator.vehicle

    def relative_features(self, curves: ArrayLike, frequencies_hz: ArrayLike) -> FloatArray:
        """Return the features of measured curves, relative to the healthy vehicle's.

        Parameters
        ----------
        curves : array of shape (n_curves, 2, n_freq), [-]
            G_p and G_s, complex; for the feature set `peaks` their magnitudes suffice.
        frequencies_hz : array of shape (n_freq,), [Hz]
            Evenly spaced; the spacing of `settings` is what the model was trained on.

        Returns
        -------
        array of shape (n_curves, n_features), [-]
            NaN where a peak is missing.
        """
        values = np.asarray(curves)
        values = values.astype(np.complex128 if np.iscomplexobj(values) else np.float64)
        bins = torch.as_tensor(np.asarray(frequencies_hz, dtype=np.float64))
        table = self.task.extractor.extract(torch.as_tensor(values), bins)
        return self.task.extractor.relative(table.values.numpy(), self.healthy_features)

    def predict(self, inputs: ArrayLike) -> FloatArray:
        """Return parameters relative to healthy, shape (n_curves, n_outputs), [-].

        Parameters
        ----------
        inputs : array of shape (n_curves, n_inputs), [-]
            Features relative to the healthy vehicle's, named as ``task.inputs``.

        Raises
        ------
        ValueError
            If the inputs do not fit the model, or it fits curves and has no inputs.
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
        scaled = self.estimator.predict(self.input_scaling.apply(inputs))
        return self.output_scaling.undo(np.asarray(scaled).reshape(len(inputs), -1))

    def scaled(self, inputs: FloatArray) -> FloatArray:
        """Return scaled inputs (n_curves, n_inputs); what is missing stays NaN."""
        if self.input_scaling is None:
            return np.full_like(inputs, np.nan)
        unusable = ~np.isfinite(inputs) | (self.input_scaling.log & ~(inputs > 0))
        return self.input_scaling.apply(np.where(unusable, np.nan, inputs))

    def with_estimates(self, inputs: FloatArray, estimates: FloatArray) -> FloatArray:
        """Return scaled inputs and estimates side by side: the inputs of a residual scale."""
        if self.output_scaling is None:
            return np.log(estimates)
        return np.column_stack([self.scaled(inputs), self.output_scaling.apply(estimates)])


def save_model(folder: Path, model: TrainedModel) -> None:
    """Write model.safetensors, then model.json, each atomically.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    arrays = dict(model.estimator.state())
    for prefix, part in ((FEATURES, model.task.extractor), *_calibration(model)):
        arrays |= {prefix + name: array for name, array in part.state().items()}
    content = dump_arrays(arrays)
    description = {
        "schema_version": SCHEMA_VERSION,
        "suspnet_version": suspnet.__version__,
        "model": model.name,
        "parameters": parameters(model.estimator),
        "inputs": _scaling_json(model.task.inputs, model.input_scaling),
        "outputs": _scaling_json(model.task.outputs, model.output_scaling),
        "units": UNITS,
        "healthy_features": model.healthy_features.tolist(),
        "generator": _tagged(model.generator, GENERATORS),
        "task": describe_task(model.task),
        "settings": _tagged(model.settings, SETTINGS),
        "refined": model.refined,
        "training": model.training,
        "arrays_sha256": hashlib.sha256(content).hexdigest(),
    }
    description = _plain(description)
    description["description_sha256"] = content_hash(description)
    write_atomically(folder / "model.safetensors", content)
    write_json(folder / "model.json", description)


def _calibration(model: TrainedModel) -> list[tuple[str, Intervals | Scope]]:
    pairs = ((INTERVALS, model.intervals), (SCOPE, model.scope))
    return [(prefix, part) for prefix, part in pairs if part is not None]


def load_model(folder: Path | str, device: str = "cpu") -> TrainedModel:
    """Return the model that `save_model` wrote to a folder.

    Raises
    ------
    FileNotFoundError
        If there is no model in the folder.
    ModelFileError
        If a file is damaged, foreign or of another schema version.
    """
    folder = Path(folder)
    path = folder / "model.json"
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no model.json; is it the folder of a run?")
    try:
        content = read_json(path)
        _check_description(path, content)
        arrays = read_arrays(folder / "model.safetensors", content["arrays_sha256"])
        return _build(content, arrays, device)
    except DamagedFileError as error:
        raise ModelFileError(f"{error}; train again or copy the run again") from error
    except FileNotFoundError as error:
        raise ModelFileError(f"{folder} holds model.json but no model.safetensors") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise ModelFileError(f"{path} is not a suspnet model: {error!r}") from error


def parameters(estimator: Any) -> dict[str, Any]:
    """Return the constructor's arguments that make a method what it is: all but its callback."""
    return {k: v for k, v in estimator.get_params().items() if k != "callback"}


def _check_description(path: Path, content: Any) -> None:
    if not isinstance(content, dict) or "schema_version" not in content:
        raise ModelFileError(f"{path} is not a suspnet model: it has no schema_version")
    if content["schema_version"] != SCHEMA_VERSION:
        raise ModelFileError(
            f"{path} has schema version {content['schema_version']}, this suspnet reads "
            f"{SCHEMA_VERSION}; train again"
        )
    claimed = content.pop("description_sha256", None)
    if claimed != content_hash(content):
        raise ModelFileError(f"{path} is damaged or was altered: its hash does not match")
    if content["model"] not in ESTIMATORS:
        raise ModelFileError(f"{path}: unknown model {content['model']!r}")


def _build(content: dict[str, Any], arrays: dict[str, FloatArray], device: str) -> TrainedModel:
    estimator_type = ESTIMATORS[content["model"]]
    arguments = dict(content["parameters"])
    if "device" in arguments:
        arguments["device"] = device
    estimator = estimator_type(**arguments)
    parts = {prefix: _taken(arrays, prefix) for prefix in (FEATURES, INTERVALS, SCOPE)}
    learnt = parts[FEATURES]
    task = _with_tuples(content["task"])
    extractor = _with_tuples(task["extractor"])
    feature_set = FEATURE_SETS[extractor.pop("kind")](**extractor)
    try:
        if arrays:
            estimator.restore(arrays)
        if learnt:
            feature_set = feature_set.restored(learnt)
        intervals = Intervals.restored(parts[INTERVALS]) if parts[INTERVALS] else None
        scope = Scope.restored(parts[SCOPE]) if parts[SCOPE] else None
    except ValueError as error:
        raise ModelFileError(f"the model's arrays do not fit together: {error}") from error
    generator = dict(content["generator"])
    generator |= {"vehicle": Vehicle(**generator["vehicle"]), "device": device}
    return TrainedModel(
        name=content["model"],
        estimator=estimator,
        task=Task(**task | {"extractor": feature_set}),
        generator=_untagged(generator, GENERATORS),
        settings=_untagged(content["settings"], SETTINGS),
        healthy_features=np.array(content["healthy_features"]),
        input_scaling=_scaling(content["inputs"]),
        output_scaling=_scaling(content["outputs"]),
        refined=content["refined"],
        intervals=intervals,
        scope=scope,
        training=content["training"],
    )


def _taken(arrays: dict[str, FloatArray], prefix: str) -> dict[str, FloatArray]:
    """Remove the arrays whose name begins with a prefix; return them without it."""
    names = [name for name in arrays if name.startswith(prefix)]
    return {name.removeprefix(prefix): arrays.pop(name) for name in names}


def _tagged(value: Any, kinds: Mapping[str, type]) -> dict[str, Any]:
    """Return a dataclass as JSON-able values with the name of its kind."""
    kind = next(name for name, one in kinds.items() if type(value) is one)
    return {"kind": kind, **asdict(value)}


def _untagged(content: Mapping[str, Any], kinds: Mapping[str, type]) -> Any:
    arguments = _with_tuples(content)
    return kinds[arguments.pop("kind")](**arguments)


def _with_tuples(content: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(v) if isinstance(v, list) else v for key, v in content.items()}


def _scaling_json(names: tuple[str, ...], scaling: Scaling | None) -> dict[str, Any]:
    if scaling is None:
        return {"names": list(names)}
    arrays = {f.name: getattr(scaling, f.name) for f in fields(scaling)}
    return {"names": list(names), **_plain(arrays)}


def _scaling(content: dict[str, Any]) -> Scaling | None:
    if "mean" not in content:
        return None
    return Scaling(np.array(content["mean"]), np.array(content["scale"]), content["log"])


def _plain(value: Any) -> Any:
    """Return a JSON-able copy; floats survive the round trip exactly."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else value
