"""Validation of a model's files: each number, shape and name, before the model is used.

The hash in model.json detects damage, not forgery: whoever changes a file can update its hash.
"""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.problem import Problem
from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.commissioned_bogie import HealthyScatter
from suspnet.estimation.trained import TrainedModel
from suspnet.estimation.trip_settings import LEAST_TRIPS
from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.records import Place
from suspnet.ground.settings import LARGEST, check_flag, check_number
from suspnet.ground.types import FloatArray
from suspnet.learning import Scaling
from suspnet.vehicle import VerticalVehicle

MAY_BE_INFINITE = ("ood.thresholds",)  # arrays in which infinity means that there is no threshold
LARGEST_RATIO = 1000.0
"""Largest plausible ratio to healthy, or its inverse, in a model's estimate for the middle of its
training data."""
SAME_FEATURES = 1e-6  # largest relative difference of features between processors
FAR = 1000.0
"""Largest distance of the mean of the training data from the healthy vehicle, in deviations."""
DEPTH = 20  # largest nesting depth of a description; real ones have 5 levels


def check_numbers(content: Any, where: str = "model.json", depth: int = 0) -> None:
    """Raise ValueError if a number of a description is not finite, or the nesting is too deep."""
    if depth > DEPTH:
        raise ValueError(f"{where[:60]}... is nested too deeply")
    if isinstance(content, dict):
        for key, value in content.items():
            check_numbers(value, f"{where}.{key}", depth + 1)
    elif isinstance(content, list):
        for i, value in enumerate(content):
            check_numbers(value, f"{where}[{i}]", depth + 1)
    elif isinstance(content, int | float) and not abs(content) <= LARGEST:  # NaN too
        raise ValueError(f"`{where}` must be a finite number of at most {LARGEST:g}")


def check_arrays(arrays: Mapping[str, FloatArray]) -> None:
    """Raise ValueError unless all arrays are finite floats of up to 3 dimensions."""
    for name, array in arrays.items():
        if array.dtype not in (np.float32, np.float64) or array.ndim > 3:
            raise ValueError(f"array {name!r} is of {array.dtype}, {array.ndim}-dimensional")
        allowed = (np.abs(array) <= LARGEST) | (np.isinf(array) & (name in MAY_BE_INFINITE))
        if not allowed.all():
            raise ValueError(f"array {name!r} holds numbers that are not finite, or too large")


def check_model(model: TrainedModel | BogieModel) -> None:
    """Raise TypeError or ValueError unless the parts of a model are consistent and it estimates."""
    _check_training(model.training)
    if isinstance(model, BogieModel):
        _check_bogie(model)
    else:
        _check_method(model)


def _check_method(model: TrainedModel) -> None:
    check_number("training.seed", model.training["seed"], low=0, whole=True)
    task = model.task
    n_inputs, n_outputs = len(task.inputs), len(task.outputs)
    _check_healthy(model)
    for name in ("corrected", "refined"):
        check_flag(name, getattr(model, name))
    on_curves = model.estimator.works_on_curves
    if not on_curves or model.input_scaling or model.output_scaling:
        log_inputs = (task.log_ratios and task.extractor.positive) or on_curves
        _check_scaling("inputs", model.input_scaling, n_inputs, log_inputs)
        _check_scaling("outputs", model.output_scaling, n_outputs, task.log_ratios or on_curves)
    if not on_curves:
        _check_estimator(model, n_inputs, n_outputs)
    _check_calibration(model, n_inputs, n_outputs)


def _check_vector(name: str, values: FloatArray, size: int) -> None:
    if values.shape != (size,) or values.dtype.kind not in "fi":
        raise ValueError(f"`{name}` must be {size} numbers, got shape {values.shape}")


def _check_healthy(model: TrainedModel) -> None:
    generator = model.generator.on("cpu")
    expected = Problem(generator, model.task, model.settings).healthy_features()
    _check_vector("healthy_features", model.healthy_features, len(expected))
    atol = SAME_FEATURES * float(np.abs(expected).max())
    if not np.allclose(model.healthy_features, expected, rtol=SAME_FEATURES, atol=atol):
        raise ValueError("`healthy_features` are not those of the vehicle, settings and task")


def _check_scaling(name: str, scaling: Scaling | None, size: int, log: bool) -> None:
    if scaling is None:
        raise ValueError(f"the scaling of {name} is missing")
    check_flag(f"{name}.log", scaling.log)
    if scaling.log != log:
        raise ValueError(f"`{name}.log` must be {log}, as the task says")
    _check_vector(f"{name}.mean", scaling.mean, size)
    _check_vector(f"{name}.scale", scaling.scale, size)
    if not (scaling.scale > 0).all() or not (np.abs(scaling.mean) <= FAR * scaling.scale).all():
        raise ValueError(f"`{name}.scale` must be positive, and the mean at most {FAR:g} times it")


def _check_estimator(model: TrainedModel, n_inputs: int, n_outputs: int) -> None:
    """Raise ValueError unless a method estimates the middle of its training data."""
    assert model.output_scaling is not None
    if model.estimator.n_features_in_ != n_inputs:
        raise ValueError(
            f"the arrays are of {model.estimator.n_features_in_} inputs, not {n_inputs}"
        )
    middle = np.asarray(model.estimator.predict(np.zeros((1, n_inputs))), dtype=np.float64)
    if middle.size != n_outputs:
        raise ValueError(f"the arrays are of {middle.size} outputs, not {n_outputs}")
    with np.errstate(over="ignore"):
        estimate = model.output_scaling.undo(middle.reshape(1, n_outputs))
    size = np.abs(estimate)
    if not (size < LARGEST_RATIO).all() or (model.log and not (size > 1 / LARGEST_RATIO).all()):
        raise ValueError(f"the middle of the training data is estimated as {estimate[0].tolist()}")


def _check_calibration(model: TrainedModel, n_inputs: int, n_outputs: int) -> None:
    intervals, ood = model.intervals, model.ood
    if intervals is not None:
        if intervals.conformal.scores.shape[1] != n_outputs or intervals.log != model.log:
            raise ValueError(f"the intervals are not those of {n_outputs} outputs")
        residual_scale = intervals.residual_scale
        if residual_scale is not None:
            n_columns = n_outputs if model.estimator.works_on_curves else n_inputs + n_outputs
            scales = residual_scale.predict(np.zeros((1, n_columns)))
            if not (scales < LARGEST_RATIO).all():
                raise ValueError(f"the residual scale predicts {scales[0].tolist()}")
    if ood is not None:
        is_used = len(ood.reference) > 0
        if is_used and ood.reference.shape[1] != n_inputs:
            raise ValueError(f"the reference of the OOD detector is not of {n_inputs} inputs")
        if not math.isfinite(ood.misfit_threshold) or (
            is_used and not math.isfinite(ood.distance_threshold)
        ):
            raise ValueError("the thresholds of the OOD detector must be finite")


def _check_bogie(model: BogieModel) -> None:
    bogie = model.bogie
    if not isinstance(model.generator, VerticalVehicle):
        raise ValueError("`generator` of a bogie must be a vertical vehicle")
    if not isinstance(model.settings, EstimateSettings):
        raise ValueError("`settings` of a bogie must be those of trips")
    if bogie.generator.vehicle != model.vehicle:
        raise ValueError("`bogie.generator.vehicle` must be the model's vehicle")
    if bogie.generator.distribution is None:
        raise ValueError("`bogie.generator.distribution` is missing")
    _check_vector("bogie.noise", bogie.noise.numpy(), len(bogie.generator.places))
    _check_vector("bogie.masses", bogie.masses, len(bogie.masses))
    for name, values in (("noise", bogie.noise.numpy()), ("masses", bogie.masses)):
        if not (values > 0).all():
            raise ValueError(f"`bogie.{name}` must be positive")
    check_number("bogie.misfit", bogie.misfit, low=0)
    if bogie.loads_m is not None:
        if bogie.loads_m.shape != (len(bogie.masses), 2) or not np.isfinite(bogie.loads_m).all():
            raise ValueError("`bogie.loads_m` must be two finite numbers for each trip")
    check_flag("bogie.converged", bogie.converged)
    if bogie.errors is not None and (
        bogie.errors.ndim != 2
        or bogie.errors.shape[1] != len(bogie.noise)
        or not bool((bogie.errors >= 0).all())
    ):
        raise ValueError("`bogie.errors` must be numbers >= 0, a row of all sensors for each bin")
    _check_scatter(bogie.scatter, len(bogie.outputs) - 1)


def _check_scatter(scatter: HealthyScatter, n: int) -> None:
    for name in ("own", "alike"):
        values = np.array(getattr(scatter, name), dtype=float)
        _check_vector(f"bogie.scatter.{name}", values, len(PARAMETERS) - 1)
        if not (values >= 0).all():
            raise ValueError(f"`bogie.scatter.{name}` must not be negative")
    noise = np.array(scatter.noise, dtype=float)
    if noise.shape != (n, n) or not np.isfinite(noise).all():
        raise ValueError(f"`bogie.scatter.noise` must be {n} x {n} finite numbers")
    check_number("bogie.scatter.n_trips", scatter.n_trips, low=LEAST_TRIPS, whole=True)


def _check_training(training: Any) -> None:
    check_number("training.n_train", training.get("n_train", 0), low=0, whole=True)
    if not isinstance(training.get("parameters", {}), dict):
        raise TypeError("`training.parameters` must be a mapping")
    for name, value in training.get("test_rms_percent", {}).items():
        check_number(f"training.test_rms_percent.{name}", value, low=0, optional=True)
    if "commissioned" not in training:
        return
    healthy = training["commissioned"]
    check_number("training.commissioned.n_trips", healthy["n_trips"], low=0, whole=True)
    check_flag("training.commissioned.converged", healthy.get("converged", True))
    first, last = healthy["mileage_km"]
    for value in (first, last):
        check_number("training.commissioned.mileage_km", value)
    if not all(isinstance(name, str) for name in healthy.get("trips", [])):
        raise TypeError("`training.commissioned.trips` must be names")
    _check_place(healthy.get("place"))


def _check_place(place: Any) -> None:
    if place is None:
        return
    names = {field.name for field in fields(Place)}
    if not isinstance(place, dict) or set(place) != names:
        raise TypeError(f"`training.commissioned.place` must be a mapping of {sorted(names)}")
    if not all(isinstance(text, str) for text in place.values()):
        raise TypeError("`training.commissioned.place` must hold text")


def check_same(stated: Any, built: Any, where: str = "model.json") -> None:
    """Raise ValueError unless a description agrees with that of the model built from it."""
    if isinstance(stated, dict) and isinstance(built, dict):
        for key, value in stated.items():
            if key not in built:
                raise ValueError(f"`{where}.{key}` is unknown")
            check_same(value, built[key], f"{where}.{key}")
    elif isinstance(stated, list) and isinstance(built, list) and len(stated) == len(built):
        for i, pair in enumerate(zip(stated, built, strict=True)):
            check_same(*pair, f"{where}[{i}]")
    elif type(stated) is not type(built) or stated != built:
        raise ValueError(f"`{where}` is {stated!r}, expected {built!r}")
