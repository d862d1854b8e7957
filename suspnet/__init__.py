"""Stiffness and damping of train suspensions from three vertical accelerometers.

The public names are imported when they are first used, so that ``import suspnet`` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from suspnet._version import __version__ as __version__

if TYPE_CHECKING:
    from suspnet.cli.kinds import read_protocol, read_vehicles
    from suspnet.dynamics.quarter_car import QuarterCar
    from suspnet.dynamics.vehicle import Vehicle
    from suspnet.dynamics.vertical_vehicle import VerticalVehicle
    from suspnet.estimation.checkpoint import load_model, save_model
    from suspnet.estimation.estimate import Estimate
    from suspnet.estimation.fitted import ModelFileError
    from suspnet.estimation.from_recording import TripSettings
    from suspnet.estimation.problem import Problem
    from suspnet.estimation.protocols import Protocol, Task
    from suspnet.estimation.trained import TrainedModel
    from suspnet.ground.parameters import PARAMETERS
    from suspnet.learning.baselines import SVR, CurveFit, LinearRegression
    from suspnet.learning.msvr import MSVR
    from suspnet.learning.mvgpr import MVGPR
    from suspnet.recordings.checked_mapping import TripError
    from suspnet.recordings.manifest_files import read_manifest
    from suspnet.recordings.recording import Recording, load_recording
    from suspnet.runs.train import train
    from suspnet.spectra.components import CurveFeatures
    from suspnet.spectra.curves import CurveSettings
    from suspnet.spectra.estimates import EstimateSettings
    from suspnet.spectra.extraction import PeakFeatures
    from suspnet.spectra.peaks import PeakFit, findpeaks
    from suspnet.spectra.segments import NoEstimateError
    from suspnet.spectra.welch import Welch, tfestimate

_HOMES = {
    "suspnet.cli.kinds": (
        "read_protocol",
        "read_vehicles",
    ),
    "suspnet.dynamics.quarter_car": ("QuarterCar",),
    "suspnet.dynamics.vehicle": ("Vehicle",),
    "suspnet.dynamics.vertical_vehicle": ("VerticalVehicle",),
    "suspnet.estimation.checkpoint": (
        "load_model",
        "save_model",
    ),
    "suspnet.estimation.estimate": ("Estimate",),
    "suspnet.estimation.fitted": ("ModelFileError",),
    "suspnet.estimation.from_recording": ("TripSettings",),
    "suspnet.estimation.problem": ("Problem",),
    "suspnet.estimation.protocols": (
        "Protocol",
        "Task",
    ),
    "suspnet.estimation.trained": ("TrainedModel",),
    "suspnet.ground.parameters": ("PARAMETERS",),
    "suspnet.learning.baselines": ("SVR", "CurveFit", "LinearRegression"),
    "suspnet.learning.msvr": ("MSVR",),
    "suspnet.learning.mvgpr": ("MVGPR",),
    "suspnet.recordings.checked_mapping": ("TripError",),
    "suspnet.recordings.manifest_files": ("read_manifest",),
    "suspnet.recordings.recording": (
        "Recording",
        "load_recording",
    ),
    "suspnet.runs.train": ("train",),
    "suspnet.spectra.components": ("CurveFeatures",),
    "suspnet.spectra.curves": ("CurveSettings",),
    "suspnet.spectra.estimates": ("EstimateSettings",),
    "suspnet.spectra.extraction": ("PeakFeatures",),
    "suspnet.spectra.peaks": (
        "PeakFit",
        "findpeaks",
    ),
    "suspnet.spectra.segments": ("NoEstimateError",),
    "suspnet.spectra.welch": ("Welch", "tfestimate"),
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
