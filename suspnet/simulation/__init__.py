"""Simulated fleets, whose truth is known."""

from suspnet.simulation.fleet import Fleet
from suspnet.simulation.fleet_writing import write_trains
from suspnet.simulation.scenarios import Scenario
from suspnet.simulation.sensors import Sensor
from suspnet.simulation.signals import simulate_trip
from suspnet.simulation.trains import Trains
from suspnet.simulation.writing import write_fleet

__all__ = ["Fleet", "Scenario", "Sensor", "Trains", "simulate_trip", "write_fleet", "write_trains"]
