"""Module 2 of the paper: from recordings and frequency-response curves to features."""

from suspnet.features.components import CurveFeatures
from suspnet.features.extraction import FeatureSet, FeatureTable, PeakFeatures
from suspnet.features.peaks import PeakFit, PeakReason, Peaks, findpeaks
from suspnet.features.transfer_estimate import tfestimate
from suspnet.features.welch import Welch

__all__ = [
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
