"""Simulated fleets with known true parameters."""

from suspnet.simulation.fleet import Fleet, Scenario, Trains
from suspnet.simulation.signals import Sensor, simulate_trip
from suspnet.simulation.writing import Simulation, write_fleet, write_trains

__all__ = [
    "Fleet",
    "Scenario",
    "Sensor",
    "Simulation",
    "Trains",
    "simulate_trip",
    "write_fleet",
    "write_trains",
]
