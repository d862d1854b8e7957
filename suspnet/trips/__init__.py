"""Recorded trips: one trip, a fleet, its trend along the mileage, figures and report."""
