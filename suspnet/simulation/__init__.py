"""Simulated fleets, whose truth is known."""

from suspnet.simulation.fleet import Fleet, simulate_trip, write_fleet
from suspnet.simulation.scenarios import Scenario
from suspnet.simulation.sensors import Sensor

__all__ = ["Fleet", "Scenario", "Sensor", "simulate_trip", "write_fleet"]
