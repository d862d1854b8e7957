"""Training data: protocols, noisy curves and estimates, their features and cache."""

from suspnet.data.curves import CurveSettings
from suspnet.data.estimates import EstimateSettings
from suspnet.data.protocols import Protocol, Task
from suspnet.data.source import CALIBRATE, TEST, TRAIN, CurveSource, FeatureData

__all__ = [
    "CALIBRATE",
    "TEST",
    "TRAIN",
    "CurveSettings",
    "CurveSource",
    "EstimateSettings",
    "FeatureData",
    "Protocol",
    "Task",
]
