"""Module 1 of the paper: vehicle dynamics and frequency responses."""

from typing import Any

from suspnet.vehicle.quarter_car import QuarterCar
from suspnet.vehicle.spatial_vehicle import SpatialVehicle
from suspnet.vehicle.vehicle import PARAMETERS, ResponseGenerator, Vehicle
from suspnet.vehicle.vertical_vehicle import VerticalVehicle, best_generator

GENERATORS: dict[str, Any] = {"quarter_car": QuarterCar, "vertical_vehicle": VerticalVehicle}
"""Every response generator by the name of its file in configs/generator/."""

__all__ = [
    "GENERATORS",
    "PARAMETERS",
    "QuarterCar",
    "ResponseGenerator",
    "SpatialVehicle",
    "Vehicle",
    "VerticalVehicle",
    "best_generator",
]
