"""Validation of a model's files: numbers, names, and whether it estimates, before it is used.

The hash in model.json detects damage, not forgery: whoever changes a file can update its hash.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.settings import LARGEST
from suspnet.ground.types import FloatArray

MAY_BE_INFINITE = ("ood.thresholds",)  # arrays in which infinity means that there is no threshold


def check_numbers(content: Any, where: str = "model.json") -> None:
    """Raise ValueError if a number of a description is not finite."""
    if isinstance(content, dict):
        for key, value in content.items():
            check_numbers(value, f"{where}.{key}")
    elif isinstance(content, list):
        for i, value in enumerate(content):
            check_numbers(value, f"{where}[{i}]")
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
    """Raise an error unless a model estimates its own healthy vehicle.

    Parts that do not belong together have shapes that do not fit. The parts of a bogie are tried
    with the first trip only.
    """
    if isinstance(model, BogieModel):
        if model.bogie.generator.vehicle != model.vehicle:
            raise ValueError("`bogie.generator.vehicle` must be the model's vehicle")
        return
    healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
    mass = np.ones(1) if model.task.mass_known else None
    model.estimate(model.observer.noise_free(healthy), mass=mass)


def check_same(stated: Any, built: Any, where: str = "model.json") -> None:
    """Raise ValueError unless a description agrees with that of the model built from it."""
    if isinstance(stated, dict) and isinstance(built, dict):
        for key, value in stated.items():
            check_same(value, built.get(key), f"{where}.{key}")
    elif isinstance(stated, list) and isinstance(built, list) and len(stated) == len(built):
        for i, pair in enumerate(zip(stated, built, strict=True)):
            check_same(*pair, f"{where}[{i}]")
    elif type(stated) is not type(built) or stated != built:
        raise ValueError(f"`{where}` is {stated!r}, expected {built!r}")
