"""Recordings of trips: manifests, files, cleaning, one clock for all channels."""

from suspnet.recordings.manifest import TripError, TripManifest
from suspnet.recordings.manifest_files import read_manifest, write_manifest
from suspnet.recordings.recording import Recording, load_recording

__all__ = [
    "Recording",
    "TripError",
    "TripManifest",
    "load_recording",
    "read_manifest",
    "write_manifest",
]
