"""Frequency responses: how they are measured, their noise, and their features."""
