"""Recorded trips: checks and evaluation of folders of trips."""
