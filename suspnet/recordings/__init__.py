"""Recordings of trips: manifests, files, cleaning, one clock for all channels.

The names are imported when they are first used, so that a process that only reads files is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from suspnet.recordings.manifest import TripManifest
    from suspnet.recordings.manifest_files import read_manifest, write_manifest
    from suspnet.recordings.manifest_keys import TripError
    from suspnet.recordings.recording import Recording, load_recording

_HOMES = {
    "Recording": "recording",
    "TripError": "manifest_keys",
    "TripManifest": "manifest",
    "load_recording": "recording",
    "read_manifest": "manifest_files",
    "write_manifest": "manifest_files",
}
"""Every name by the module that defines it."""

__all__ = [
    "Recording",
    "TripError",
    "TripManifest",
    "load_recording",
    "read_manifest",
    "write_manifest",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
