"""Stiffness and damping of train suspensions from three vertical accelerometers.

The public names are imported when they are first used, so that ``import suspnet`` is quick.
"""

import importlib
from typing import Any

from suspnet._version import __version__ as __version__

_NAMES = {
    "cli.kinds": "read_protocol read_rigs read_vehicles",
    "cli.own_methods": "register_features register_method",
    "vehicle.quarter_car": "QuarterCar",
    "vehicle.rig": "Rig",
    "vehicle.spatial_vehicle": "SpatialVehicle",
    "vehicle.vehicle": "Vehicle",
    "vehicle.vertical_vehicle": "VerticalVehicle",
    "trains.fits.bogie_fit": "PartsEstimate commission_bogie fit_parts",
    "trains.identification.bogie_trips": "bogie_trip",
    "trains.identification.rig_records": "RigRecord commission_rig load_record read_rig",
    "estimation.checkpoint": "load_model save_model",
    "estimation.commissioned_bogie": "CommissionedBogie",
    "estimation.commissioned_rig": "CommissionedRig RigEstimate",
    "estimation.rig_files": "load_rig save_rig",
    "estimation.estimate": "Estimate",
    "estimation.fitted": "ModelFileError",
    "trains.identification.healthy_trips": "read_healthy",
    "bounds.information": "cramer_rao fisher_information",
    "trains.identification.layouts": "LayoutBounds layout_bounds",
    "curves.problem": "CALIBRATE TEST TRAIN Problem",
    "curves.protocols": "Protocol Task",
    "estimation.trained": "TrainedModel",
    "estimation.trip_settings": "TripSettings",
    "trains.fits.worn_parts": "WornPart expected_losses false_verdicts least_losses worn_parts",
    "ground.parameters": "COMPONENTS PARAMETERS",
    "learning.baselines": "SVR CurveFit KernelRidge LinearRegression",
    "learning.msvr": "MSVR",
    "learning.mvgpr": "MVGPR",
    "trains.recordings.errors": "TripError",
    "trains.recordings.manifest_files": "read_manifest",
    "trains.recordings.recording": "Recording load_recording",
    "trains.pages.maintenance_figures": "plan_calendar",
    "runs.dataset": "DataSet make_dataset read_dataset write_dataset",
    "runs.train": "train",
    "trains.spectra.bogie_trip": "BogieTrip",
    "curves.components": "CurveFeatures",
    "curves.curves": "CurveSettings",
    "curves.estimates": "EstimateSettings",
    "curves.extraction": "FeatureSet FeatureTable PeakFeatures",
    "curves.peaks": "PeakFit findpeaks",
    "curves.speeds": "NoEstimateError",
    "curves.welch": "Welch tfestimate",
}
"""The public names of each module; `__init__.pyi` has them for type checkers."""
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'suspnet' has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(f"suspnet.{_HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return [*_HOMES, "__version__"]
