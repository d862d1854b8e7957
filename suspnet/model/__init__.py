"""A fitted model: its parts, its files, and what it estimates from curves and recordings."""

from suspnet.model.checkpoint import load_model, save_model
from suspnet.model.estimate import Estimate
from suspnet.model.fitted import FittedMethod, ModelFileError
from suspnet.model.trained import TrainedModel

__all__ = [
    "Estimate",
    "FittedMethod",
    "ModelFileError",
    "TrainedModel",
    "load_model",
    "save_model",
]
