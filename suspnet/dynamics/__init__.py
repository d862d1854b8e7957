"""Module 1 of the paper: vehicle dynamics and frequency responses."""

from suspnet.dynamics.generator import ResponseGenerator
from suspnet.dynamics.quarter_car import QuarterCar
from suspnet.dynamics.vehicle import PARAMETERS, Vehicle
from suspnet.dynamics.vertical_vehicle import VerticalVehicle, best_generator

__all__ = [
    "PARAMETERS",
    "QuarterCar",
    "ResponseGenerator",
    "Vehicle",
    "VerticalVehicle",
    "best_generator",
]
