"""Manifests, file formats, cleaning and one clock for all channels of a trip."""
