"""Module 2 of the paper: from recordings and frequency-response curves to features."""

from typing import Any

from suspnet.features.components import CurveFeatures
from suspnet.features.extraction import FeatureSet, FeatureTable, PeakFeatures
from suspnet.features.peaks import PeakFit, PeakReason, Peaks, findpeaks
from suspnet.features.transfer_estimate import tfestimate
from suspnet.features.welch import Welch

FEATURE_SETS: dict[str, Any] = {kind.kind: kind for kind in (PeakFeatures, CurveFeatures)}
"""Every feature set by the name that protocols and model files give it."""

__all__ = [
    "FEATURE_SETS",
    "CurveFeatures",
    "FeatureSet",
    "FeatureTable",
    "PeakFeatures",
    "PeakFit",
    "PeakReason",
    "Peaks",
    "Welch",
    "findpeaks",
    "tfestimate",
]
