"""Stiffness and damping of train suspensions from three vertical accelerometers.

The public names are imported when they are first used, so that ``import suspnet`` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from suspnet._version import __version__ as __version__

if TYPE_CHECKING:
    from suspnet.cli.configs import read_protocol, read_vehicles
    from suspnet.data import CurveSettings, EstimateSettings, Protocol, Task
    from suspnet.dynamics import PARAMETERS, QuarterCar, Vehicle, VerticalVehicle
    from suspnet.features import (
        CurveFeatures,
        PeakFeatures,
        PeakFit,
        Welch,
        findpeaks,
        tfestimate,
    )
    from suspnet.learning import MSVR, MVGPR, SVR, CurveFit, LinearRegression
    from suspnet.model import Estimate, ModelFileError, TrainedModel, load_model, save_model
    from suspnet.model.from_recording import TripSettings
    from suspnet.problem import Problem
    from suspnet.recordings import Recording, TripError, load_recording, read_manifest
    from suspnet.recordings.segments import NoEstimateError
    from suspnet.runs.train import train

_HOMES = {
    "suspnet.cli.configs": ("read_protocol", "read_vehicles"),
    "suspnet.data": ("CurveSettings", "EstimateSettings", "Protocol", "Task"),
    "suspnet.dynamics": ("PARAMETERS", "QuarterCar", "Vehicle", "VerticalVehicle"),
    "suspnet.features": (
        "CurveFeatures",
        "PeakFeatures",
        "PeakFit",
        "Welch",
        "findpeaks",
        "tfestimate",
    ),
    "suspnet.learning": ("MSVR", "MVGPR", "SVR", "CurveFit", "LinearRegression"),
    "suspnet.model": ("Estimate", "ModelFileError", "TrainedModel", "load_model", "save_model"),
    "suspnet.model.from_recording": ("TripSettings",),
    "suspnet.problem": ("Problem",),
    "suspnet.recordings": ("Recording", "TripError", "load_recording", "read_manifest"),
    "suspnet.recordings.segments": ("NoEstimateError",),
    "suspnet.runs.train": ("train",),
}
"""Every public name by the module that defines it."""
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "MSVR",
    "MVGPR",
    "PARAMETERS",
    "SVR",
    "CurveFeatures",
    "CurveFit",
    "CurveSettings",
    "Estimate",
    "EstimateSettings",
    "LinearRegression",
    "ModelFileError",
    "NoEstimateError",
    "PeakFeatures",
    "PeakFit",
    "Problem",
    "Protocol",
    "QuarterCar",
    "Recording",
    "Task",
    "TrainedModel",
    "TripError",
    "TripSettings",
    "Vehicle",
    "VerticalVehicle",
    "Welch",
    "findpeaks",
    "load_model",
    "load_recording",
    "read_manifest",
    "read_protocol",
    "read_vehicles",
    "save_model",
    "tfestimate",
    "train",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its module."""
    if name not in _HOME:
        raise AttributeError(f"module 'suspnet' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return [*__all__, "__version__"]
