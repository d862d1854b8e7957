"""Training data: protocols, degraded vehicles, noisy curves and their features."""

from suspnet.data.curves import TEST, TRAIN, CurveSettings, CurveSource, FeatureData
from suspnet.data.protocols import Protocol, Task

__all__ = ["TEST", "TRAIN", "CurveSettings", "CurveSource", "FeatureData", "Protocol", "Task"]
