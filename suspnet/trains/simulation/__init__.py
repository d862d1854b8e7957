"""Simulated fleets with known true parameters."""

from suspnet.trains.simulation.fleet import Fleet, Scenario
from suspnet.trains.simulation.writing import Simulation, write_fleet

__all__ = ["Fleet", "Scenario", "Simulation", "write_fleet"]
