"""Stiffness and damping of train suspensions from three vertical accelerometers.

The public names are imported when they are first used, so that ``import suspnet`` is quick.
"""

import importlib
from typing import Any

from suspnet._version import __version__ as __version__

_NAMES = {
    "cli.kinds": "read_protocol read_vehicles",
    "cli.plugins": "register_features register_method",
    "dynamics.quarter_car": "QuarterCar",
    "dynamics.spatial_vehicle": "SpatialVehicle",
    "dynamics.vehicle": "Vehicle",
    "dynamics.vertical_vehicle": "VerticalVehicle",
    "estimation.bogie_fit": "PartsEstimate commission_bogie fit_parts",
    "estimation.bogie_trips": "bogie_trip",
    "estimation.checkpoint": "load_model save_model",
    "estimation.commissioned_bogie": "CommissionedBogie",
    "estimation.commissioning": "Commissioned commission",
    "estimation.estimate": "Estimate",
    "estimation.feature_information": "feature_information",
    "estimation.fitted": "ModelFileError",
    "estimation.healthy_trips": "read_healthy",
    "estimation.information": "cramer_rao fisher_information",
    "estimation.layouts": "LayoutBounds layout_bounds",
    "estimation.problem": "CALIBRATE TEST TRAIN Problem",
    "estimation.protocols": "Protocol Task",
    "estimation.sensor_information": "recording_information sensor_places",
    "estimation.trained": "TrainedModel",
    "estimation.trip_settings": "TripSettings",
    "estimation.worn_parts": "WornPart worn_parts",
    "ground.parameters": "COMPONENTS PARAMETERS",
    "learning.baselines": "SVR CurveFit KernelRidge LinearRegression",
    "learning.msvr": "MSVR",
    "learning.mvgpr": "MVGPR",
    "recordings.errors": "TripError",
    "recordings.manifest_files": "read_manifest",
    "recordings.recording": "Recording load_recording",
    "report.maintenance_figures": "plan_calendar",
    "runs.dataset": "DataSet make_dataset read_dataset write_dataset",
    "runs.train": "train",
    "spectra.bogie_trip": "BogieTrip",
    "spectra.components": "CurveFeatures",
    "spectra.curves": "CurveSettings",
    "spectra.estimates": "EstimateSettings",
    "spectra.extraction": "FeatureSet FeatureTable PeakFeatures",
    "spectra.peaks": "PeakFit findpeaks",
    "spectra.speeds": "NoEstimateError",
    "spectra.welch": "Welch tfestimate",
}
"""The public names of each module; `__init__.pyi` has them for type checkers."""
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}
_REMOVED = {
    "train_parts": "the fit of a bogie's parts starts from the healthy vehicle",
    "PartsRegression": "the fit of a bogie's parts starts from the healthy vehicle",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        reason = f": it was removed, as {_REMOVED[name]}" if name in _REMOVED else ""
        raise AttributeError(f"module 'suspnet' has no attribute {name!r}{reason}")
    value = globals()[name] = getattr(importlib.import_module(f"suspnet.{_HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return [*_HOMES, "__version__"]
