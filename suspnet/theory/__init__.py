"""Fisher information and Cramer-Rao bounds of curves, features and sensors."""

from suspnet.theory.information import cramer_rao, fisher_information
from suspnet.theory.sensor_information import places, recording_information

__all__ = ["cramer_rao", "fisher_information", "places", "recording_information"]
