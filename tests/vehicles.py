"""The AM96 as shipped, for tests that need it at import; test_vehicle.py pins its numbers."""

from suspnet.cli.kinds import read_vehicles

AM96 = read_vehicles()["am96"]
