"""Folders of trips: manifests of them, checks, and the reading of each trip."""
