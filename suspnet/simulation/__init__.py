"""Simulated fleets, whose truth is known."""

from suspnet.simulation.fleet import Fleet
from suspnet.simulation.scenarios import Scenario
from suspnet.simulation.sensors import Sensor
from suspnet.simulation.writing import simulate_trip, write_fleet

__all__ = ["Fleet", "Scenario", "Sensor", "simulate_trip", "write_fleet"]
