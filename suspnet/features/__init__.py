"""Module 2 of the paper: from frequency-response curves to features."""

from suspnet.features.extraction import FeatureTable, PeakFeatures
from suspnet.features.peaks import PeakFit, PeakReason, Peaks, findpeaks

__all__ = ["FeatureTable", "PeakFeatures", "PeakFit", "PeakReason", "Peaks", "findpeaks"]
