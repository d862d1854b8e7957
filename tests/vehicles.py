"""The AM96 as shipped, for tests that need it at import; test_vehicle.py pins its numbers."""

from suspnet.cli.kinds import read_vehicles
from suspnet.vehicle.quantities import QUANTITIES

AM96 = read_vehicles()["am96"]
MEDIANS = {quantity.name: quantity.median for quantity in QUANTITIES}
"""Ratio of each uncertain number to nominal where nothing else is known."""
