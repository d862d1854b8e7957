"""Recorded trips: single trips, fleets, trends along the mileage, figures and reports."""
