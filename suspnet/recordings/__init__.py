"""Recordings of trips: manifests, files, cleaning, one clock for all channels."""
