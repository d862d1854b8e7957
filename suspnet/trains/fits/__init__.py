"""Fits of a vehicle to spectra: commissioning on healthy trips, the parts of a bogie."""
