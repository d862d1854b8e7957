"""Trained models as two files, model.safetensors and model.json, without pickle."""

import hashlib
import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from suspnet._version import __version__
from suspnet.curves.components import FEATURE_SETS
from suspnet.curves.estimates import OBSERVATIONS
from suspnet.curves.problem import Problem
from suspnet.curves.protocols import Task
from suspnet.estimation.bogie_model import BOGIE, BogieModel
from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter
from suspnet.estimation.fitted import Model, ModelFileError
from suspnet.estimation.flags import OODDetector
from suspnet.estimation.intervals import Intervals
from suspnet.estimation.suspension_law import SuspensionLaw
from suspnet.estimation.trained import TrainedModel
from suspnet.estimation.validity import check_arrays, check_model, check_numbers, check_same
from suspnet.ground import storage
from suspnet.ground.tensors import check_device
from suspnet.ground.types import FloatArray
from suspnet.learning import METHODS, Scaling
from suspnet.vehicle import GENERATORS, SpatialVehicle, Vehicle

SCHEMA_VERSION = 16
FEATURES = "features."  # name prefix of the feature set's arrays
CALIBRATED: dict[str, tuple[str, Any]] = {
    "intervals.": ("intervals", Intervals),
    "ood.": ("ood", OODDetector),
}
"""Calibrated parts of a model by the name prefix of their arrays: attribute and class."""
NOT_OF_THE_MODEL = ("arrays_sha256", "suspnet_version", "units")
"""Entries of model.json that do not describe the model itself."""
OWN = "if it is your own, register it first: suspnet.{} in a script"
"""Advice where a file names a method or a feature set that is not known."""
NOT_A_MODEL = (
    *(ValueError, TypeError, KeyError, AttributeError, IndexError, ArithmeticError),
    *(AssertionError, RuntimeError, MemoryError, Warning),
)
"""Exceptions that building a model from foreign files may raise."""
N_TRIED, SAME_PREDICTION = 8, 1e-6
"""Rows on which a user's method is tried before it is saved, and the largest difference there of
scaled outputs, which are of order 1: arrays may be stored in single precision."""
UNITS = {
    "inputs": "features (and car-body mass) relative to the healthy vehicle's, dimensionless",
    "outputs": "stiffness and damping relative to healthy, dimensionless; 1 is healthy",
    "healthy_features": "position and width in Hz, height dimensionless",
    "vehicle": "kg, N/m, N s/m",
}


def save_model(folder: Path | str, model: Model) -> None:
    """Write model.safetensors, then model.json, each atomically, with the folder locked.

    Raises
    ------
    TypeError
        If `model` is not a model from `load_model` or `train`, such as an estimator.
    ValueError
        If the method is a user's and does not estimate the same after it is loaded.
    OSError
        If the folder cannot be written.
    """
    if not isinstance(model, TrainedModel | BogieModel):
        raise TypeError(
            "`model`, the second argument, must be a TrainedModel or BogieModel, got "
            f"{type(model).__name__}; an estimator such as MSVR is saved by joblib.dump"
        )
    if isinstance(model, TrainedModel):
        check_restores(model)
    write_model(Path(folder), model)


def write_model(folder: Path, model: Model) -> None:
    """Write a model as `save_model` does, one that is known to be restored."""
    content, description = _files(model)
    with storage.locked(folder):
        storage.write_atomically(folder / "model.safetensors", content)
        storage.write_json(folder / "model.json", description)


def check_saveable(estimator: Any, problem: Problem) -> None:
    """Raise TypeError if a setting of a method or a part of its problem has no place in a file."""
    for name, value in parameters(estimator).items():
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            raise TypeError(
                f"`{name}`={value!r} of {type(estimator).__name__} cannot be saved: give a number, "
                "a text, a list or None"
            ) from None
    for part, kinds in (
        (problem.task.extractor, FEATURE_SETS),
        (problem.generator, GENERATORS),
        (problem.settings, OBSERVATIONS),
    ):
        if type(part) not in kinds.values():
            raise TypeError(
                f"a model with {type(part).__name__} cannot be saved; known: {', '.join(kinds)} "
                "(feature sets are added by suspnet.register_features)"
            )


def check_restores(model: TrainedModel) -> None:
    """Raise ValueError unless a user's method predicts the same after it is stored and loaded."""
    method, name = model.estimator, model.name
    if type(method).__module__.startswith("suspnet.") or model.input_scaling is None:
        return
    rows = np.random.default_rng(0).standard_normal((N_TRIED, len(model.task.inputs)))
    expected = model.regressed(rows)
    try:
        check_arrays({key: np.asarray(array) for key, array in method.state().items()})
        content, description = _files(model)
        del description["description_sha256"]
        loaded = _checked(description, storage.load_arrays(content, "its state"), "cpu")
        assert isinstance(loaded, TrainedModel)
        difference = np.abs(loaded.regressed(rows) - expected).max()
    except NOT_A_MODEL as error:
        raise ValueError(
            f"the method {name!r} cannot be saved and restored: {error}; state() must return all "
            "that predict needs, as finite arrays of floats, and restore() set it"
        ) from error
    if not difference <= SAME_PREDICTION:
        raise ValueError(
            f"the method {name!r} cannot be saved: restored from its state() it predicts numbers "
            f"that differ by {difference:.2g} scaled outputs"
        )


def fingerprint(model: Model) -> str:
    """Return a hash of the full content of a model's files."""
    return str(_files(model)[1]["description_sha256"])


def _files(model: Model) -> tuple[bytes, dict[str, Any]]:
    content = storage.dump_arrays(_arrays(model) if isinstance(model, TrainedModel) else {})
    description = _described(model) | {"arrays_sha256": hashlib.sha256(content).hexdigest()}
    description["description_sha256"] = storage.content_hash(description)
    return content, description


def _arrays(model: TrainedModel) -> dict[str, Any]:
    arrays = dict(model.estimator.state())
    parts = {FEATURES: model.task.extractor}
    parts |= {prefix: getattr(model, name) for prefix, (name, _) in CALIBRATED.items()}
    for prefix, part in parts.items():
        if part is not None:
            arrays |= {prefix + name: array for name, array in part.state().items()}
    return arrays


def _described(model: Model) -> dict[str, Any]:
    """Return a model's description as JSON-able values, without the hashes of its files."""
    description = {
        "schema_version": SCHEMA_VERSION,
        "suspnet_version": __version__,
        "model": model.name,
        "generator": _tagged(model.generator, GENERATORS),
        "settings": _tagged(model.settings, OBSERVATIONS),
        "training": model.training,
    }
    if isinstance(model, BogieModel):
        description |= {"bogie": asdict(model.bogie)}
    else:
        assert isinstance(model, TrainedModel)
        description |= _method_json(model)
    plain: dict[str, Any] = json.loads(json.dumps(description, default=lambda a: a.tolist()))
    if model.vehicle.limits is None:
        del plain["generator"]["vehicle"]["limits"]  # earlier models have no such entry
    return plain


def _method_json(model: TrainedModel) -> dict[str, Any]:
    return {
        "parameters": parameters(model.estimator),
        "inputs": _scaling_json(model.task.inputs, model.input_scaling),
        "outputs": _scaling_json(model.task.outputs, model.output_scaling),
        "units": UNITS,
        "healthy_features": model.healthy_features,
        "task": model.task.describe(),
        "corrected": model.corrected,
        "refined": model.refined,
    }


def load_model(folder: Path | str, device: str = "cpu") -> TrainedModel | BogieModel:
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
    check_device(device)
    try:
        with foreign_file(path):
            content = storage.read_json(path)
            _refuse_regression(path, content)
            check_description(path, content, SCHEMA_VERSION)
            _check_known(path, content)
            arrays = storage.read_arrays(folder / "model.safetensors", content["arrays_sha256"])
            return _checked(content, {} if content["model"] == BOGIE else arrays, device)
    except FileNotFoundError as error:
        raise ModelFileError(f"{folder} holds model.json but no model.safetensors") from error


@contextmanager
def foreign_file(path: Path) -> Iterator[None]:
    """Raise ModelFileError for whatever a damaged or foreign file of a model makes of its reader.

    A file that is not there is left to the caller.
    """
    try:
        yield
    except ModelFileError:
        raise
    except storage.DamagedFileError as error:
        raise ModelFileError(f"{error}; train again or copy the run again") from error
    except RecursionError as error:
        raise ModelFileError(f"{path} is not a suspnet model: it is nested too deeply") from error
    except NOT_A_MODEL as error:
        raise ModelFileError(f"{path} is not a suspnet model: {error!r}") from error


def _checked(
    content: dict[str, Any], arrays: dict[str, FloatArray], device: str
) -> TrainedModel | BogieModel:
    check_numbers(content)
    check_arrays(arrays)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # only a forged model causes numerical warnings
        model = _build(content, dict(arrays), device)
        check_model(model)
        built = _described(model)
    # the device is that of the machine, not of the model
    for part in ("parameters", "generator"):
        if part in built:
            built[part]["device"] = content[part].get("device")
    if isinstance(model, BogieModel):
        built["bogie"]["generator"]["device"] = content["bogie"]["generator"].get("device")
    described = {key: value for key, value in content.items() if key not in NOT_OF_THE_MODEL}
    check_same(described, built)
    return model


def parameters(estimator: Any) -> dict[str, Any]:
    """Return the constructor arguments of a method, except its callback."""
    return {k: v for k, v in estimator.get_params().items() if k != "callback"}


def _refuse_regression(path: Path, content: Any) -> None:
    """Raise ModelFileError for a regression that was trained on a commissioned vehicle."""
    training = content.get("training") if isinstance(content, dict) else None
    is_noted = isinstance(training, dict) and "commissioned" in training
    if is_noted and content.get("model") != BOGIE:
        raise ModelFileError(
            f"{path} is a regression for the vehicle that healthy trips showed, which suspnet no "
            "longer reads: commission again"
        )


def check_description(path: Path, content: Any, schema_version: int) -> None:
    """Raise ModelFileError unless a description has that version and the hash, which is removed."""
    if not isinstance(content, dict) or "schema_version" not in content:
        raise ModelFileError(f"{path} is not a suspnet model: it has no schema_version")
    if content["schema_version"] != schema_version:
        raise ModelFileError(
            f"{path} has schema version {content['schema_version']}, this suspnet reads "
            f"{schema_version}; train again"
        )
    claimed = content.pop("description_sha256", None)
    if claimed != storage.content_hash(content):
        raise ModelFileError(f"{path} is damaged or was altered: its hash does not match")


def _check_known(path: Path, content: dict[str, Any]) -> None:
    if content["model"] not in (*METHODS, BOGIE):
        raise ModelFileError(
            f"{path}: unknown model {content['model']!r}; {OWN.format('register_method')}"
        )
    task = content.get("task")
    kind = task["extractor"]["kind"] if isinstance(task, dict) else None
    if kind is not None and kind not in FEATURE_SETS:
        raise ModelFileError(
            f"{path}: unknown feature set {kind!r}; {OWN.format('register_features')}"
        )


def _build(
    content: dict[str, Any], arrays: dict[str, FloatArray], device: str
) -> TrainedModel | BogieModel:
    generator = dict(content["generator"])
    generator |= {"vehicle": Vehicle(**generator["vehicle"]), "device": device}
    of_any: dict[str, Any] = {
        "generator": _untagged(generator, GENERATORS),
        "settings": _untagged(content["settings"], OBSERVATIONS),
        "training": content["training"],
    }
    if content["model"] == BOGIE:
        return BogieModel(_bogie(content["bogie"], device), **of_any)
    estimator_type = METHODS[content["model"]]
    arguments = dict(content["parameters"])
    if "device" in arguments:
        arguments["device"] = device
    estimator = estimator_type(**arguments)
    # what has a name prefix is taken out; the rest is the method's own
    learnt = _taken(arrays, FEATURES)
    stored = {prefix: _taken(arrays, prefix) for prefix in CALIBRATED}
    # JSON has lists where the descriptions, which are compared later, have tuples
    task = _with_tuples(content["task"])
    task["varied_sets"] = tuple(map(tuple, task["varied_sets"]))
    extractor = _with_tuples(task["extractor"])
    feature_set = FEATURE_SETS[extractor.pop("kind")](**extractor)
    try:
        if arrays:
            estimator.restore(arrays)
            if not hasattr(estimator, "n_features_in_"):  # a user's method need not restore it
                estimator.n_features_in_ = len(content["inputs"]["names"])
        if learnt:
            feature_set = feature_set.restored(learnt)
        calibrated: dict[str, Any] = {
            name: kind.restored(stored[prefix]) if stored[prefix] else None
            for prefix, (name, kind) in CALIBRATED.items()
        }
    except ValueError as error:
        raise ModelFileError(f"the model's arrays do not fit together: {error}") from error
    return TrainedModel(
        name=content["model"],
        estimator=estimator,
        task=Task(**task | {"extractor": feature_set}),
        healthy_features=np.array(content["healthy_features"]),
        input_scaling=_scaling(content["inputs"]),
        output_scaling=_scaling(content["outputs"]),
        corrected=content["corrected"],
        refined=content["refined"],
        **of_any,
        **calibrated,
    )


def _taken(arrays: dict[str, FloatArray], prefix: str) -> dict[str, FloatArray]:
    """Remove the arrays with a name prefix; return them without it."""
    names = [name for name in arrays if name.startswith(prefix)]
    return {name.removeprefix(prefix): arrays.pop(name) for name in names}


def _tagged(value: Any, kinds: Mapping[str, type]) -> dict[str, Any]:
    kind = next(name for name, settings_class in kinds.items() if type(value) is settings_class)
    return {"kind": kind, **asdict(value)}


def _untagged(content: Mapping[str, Any], kinds: Mapping[str, type]) -> Any:
    arguments = _with_tuples(content)
    return kinds[arguments.pop("kind")](**arguments)


def _with_tuples(content: Mapping[str, Any]) -> dict[str, Any]:
    return {key: _as_tuple(value) for key, value in content.items()}


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value


def _bogie(content: dict[str, Any], device: str) -> CommissionedBogie:
    law, errors, loads_m = content["law"], content["errors"], content["loads_m"]
    generator = _with_tuples(content["generator"])
    generator |= {"vehicle": Vehicle(**generator["vehicle"]), "device": device}
    return CommissionedBogie(
        SpatialVehicle(**generator),
        torch.tensor(content["noise"], dtype=torch.float64),
        np.array(content["masses"], dtype=np.float64),
        content["misfit"],
        content["converged"],
        HealthyScatter(**_with_tuples(content["scatter"])),
        None if law is None else SuspensionLaw(**_with_tuples(law)),
        None if errors is None else torch.tensor(errors, dtype=torch.float64),
        None if loads_m is None else np.array(loads_m, dtype=np.float64),
    )


def _scaling_json(names: tuple[str, ...], scaling: Scaling | None) -> dict[str, Any]:
    return {"names": names} | ({} if scaling is None else vars(scaling))


def _scaling(content: dict[str, Any]) -> Scaling | None:
    if "mean" not in content:
        return None
    return Scaling(np.array(content["mean"]), np.array(content["scale"]), content["log"])
