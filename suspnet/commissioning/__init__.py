"""Commissioning: the vehicle as its healthy trips show it."""

from suspnet.commissioning.fit import Commissioned, commission
from suspnet.commissioning.healthy import HealthySpectra, read_healthy

__all__ = ["Commissioned", "HealthySpectra", "commission", "read_healthy"]
