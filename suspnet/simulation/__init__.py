"""Simulated fleets with known true parameters."""

from suspnet.simulation.fleet import Fleet, Scenario
from suspnet.simulation.writing import Simulation, write_fleet

__all__ = ["Fleet", "Scenario", "Simulation", "write_fleet"]
