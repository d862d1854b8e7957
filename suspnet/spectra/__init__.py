"""Frequency responses: their estimates, their noise and their features."""
