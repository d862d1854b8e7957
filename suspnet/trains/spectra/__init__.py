"""Spectra of recordings: segments at steady speed, sides, lines of wheels, spectral matrices."""
