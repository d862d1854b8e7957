"""Training data: protocols, noisy curves and estimates, and their misfit to a generator's."""

from typing import Any

from suspnet.data.curves import CurveSettings
from suspnet.data.estimates import EstimateSettings
from suspnet.data.feature_data import FeatureData
from suspnet.data.observation import Observation, Observer
from suspnet.data.protocols import Protocol, Task

OBSERVATIONS: dict[str, Any] = {kind.kind: kind for kind in (CurveSettings, EstimateSettings)}
"""Settings of every observation by the name of their file in configs/data/."""

__all__ = [
    "OBSERVATIONS",
    "CurveSettings",
    "EstimateSettings",
    "FeatureData",
    "Observation",
    "Observer",
    "Protocol",
    "Task",
]
