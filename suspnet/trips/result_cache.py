"""Results of trips kept on disk, so that an evaluation goes on where it was interrupted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.estimation.checkpoint import fingerprint
from suspnet.estimation.from_recording import TripSettings
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.cache import Cache, code_hash
from suspnet.ground.storage import read_plain
from suspnet.history.records import ERROR, Quality, TripCurves, TripResult
from suspnet.recordings.manifest import Place, TripManifest

FOLDER = "finished_trips"
"""Name of the folder, in that of an evaluation, that holds its trips' results."""


class FinishedTrips:
    """Results of trips that were read, each for its files, the models and the settings.

    A result is given back if its manifest holds the same bytes, its data files have the same sizes
    and times of change, and models, settings and code are the same.

    Parameters
    ----------
    folder : Path
        Where an evaluation writes.
    models : sequence of TrainedModel
    settings : TripSettings
    """

    def __init__(
        self, folder: Path, models: Sequence[TrainedModel], settings: TripSettings
    ) -> None:
        self._cache = Cache(folder / FOLDER, "trip")
        self._common = {
            "models": [fingerprint(model) for model in models],
            "settings": asdict(settings),
            "code": code_hash(),
        }

    def made_from(self, manifest: TripManifest) -> dict[str, Any]:
        """Return all that a trip's result depends on, as JSON-able values.

        Raises
        ------
        OSError
            If one of its files has just gone.
        """
        sources = [*manifest.sensors().values(), manifest.speed]
        files = {manifest.file_of(s) for s in sources if not isinstance(s, float)}
        states = {str(file): file.stat() for file in files}
        return self._common | {
            "manifest": [str(manifest.path), read_plain(manifest.path).hex()],
            "files": {name: [state.st_size, state.st_mtime_ns] for name, state in states.items()},
        }

    def read(self, made_from: Any) -> TripResult | None:
        """Return the result of a trip, None if it was not read yet."""
        found = self._cache.read(made_from)
        if found is None:
            return None
        arrays, notes = found
        curves = None
        if arrays:
            responses = arrays.pop("real") + 1j * arrays.pop("imaginary")
            curves = TripCurves(responses=responses, **arrays)
        parts = {"quality": Quality(**notes["quality"]), "place": Place(**notes["place"])}
        return TripResult(**notes | parts | {"curves": curves})

    def write(self, made_from: Any, result: TripResult) -> None:
        """Keep a trip's result, unless it is an error: that may be gone when it is read again."""
        if result.status == ERROR:
            return
        notes = {f.name: getattr(result, f.name) for f in fields(result) if f.name != "curves"}
        notes |= {"quality": asdict(result.quality), "place": asdict(result.place)}
        arrays = {}
        if result.curves is not None:
            arrays = {f.name: getattr(result.curves, f.name) for f in fields(result.curves)}
            responses = arrays.pop("responses")
            arrays |= {"real": np.real(responses), "imaginary": np.imag(responses)}
        self._cache.write(made_from, arrays, notes)
