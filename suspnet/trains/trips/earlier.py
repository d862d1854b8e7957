"""Trips that were read before: by an interrupted evaluation, or by earlier ones, in the store."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.estimation.checkpoint import fingerprint
from suspnet.estimation.trained import TrainedModel
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.cache import Cache, code_hash
from suspnet.ground.parameters import Limits
from suspnet.ground.records import (
    ERROR,
    OK,
    Place,
    TripCurves,
    TripResult,
    from_row,
    to_arrays,
    to_responses,
    to_row,
)
from suspnet.trains.history import History
from suspnet.trains.history.arrays import Reference
from suspnet.trains.history.schema import trip_key, undated_key
from suspnet.trains.maintenance.alarms import OWN_CAUSES, Alarm, watch
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.recordings.manifest_files import ManifestFile
from suspnet.trains.trips.commissionings import since_km

log = logging.getLogger(__name__)
FOLDER = "finished_trips"
"""Subfolder of an evaluation's output that holds its trips' results."""
LEFT_OUT = (
    "{}: {} earlier trips of {} are relative to another healthy vehicle than these models' and are "
    "left out; name that model's run too: run=[EARLIER,LATER]"
)
_LOGGED: set[str] = set()
"""Such warnings that a monitor has logged: it stores many trips of each suspension."""


class FinishedTrips:
    """Results of finished trips, by their files, the models and the settings.

    A result in `folder` is reused if the manifest holds the same bytes, its data files have the
    same sizes and modification times, and models, settings and code are the same.
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

    def made_from(self, file: ManifestFile) -> dict[str, Any]:
        """Return all that a trip's result depends on, as JSON-able values.

        TripError is raised if the manifest is faulty, OSError if one of its files has disappeared.
        """
        manifest = file.trip
        data = {manifest.file_of(source) for source in manifest.sources().values()}
        states = {str(one): one.stat() for one in data}
        files = {name: [state.st_size, state.st_mtime_ns] for name, state in states.items()}
        return self._common | {"manifest": [str(manifest.path), file.data.hex()], "files": files}

    def read(self, made_from: Any) -> TripResult | None:
        """Return the result of a trip, None if it is not finished."""
        stored = self._cache.read(made_from)
        if stored is None:
            return None
        arrays, row = stored
        curves = None
        if arrays:
            responses = to_responses(arrays.pop("real"), arrays.pop("imaginary"))
            curves = TripCurves(responses=responses, **arrays)
        return replace(from_row(row), curves=curves)

    def write(self, made_from: Any, result: TripResult) -> None:
        """Store a trip's result, unless it is an error, which may be fixed by the next run."""
        if result.status != ERROR:
            arrays = to_arrays(result.curves) if result.curves is not None else {}
            self._cache.write(made_from, arrays, to_row(result))


def with_earlier(
    results: Sequence[TripResult], place: Place, models: Sequence[TrainedModel], store: History
) -> list[TripResult]:
    """Store a suspension's trips, and return them with those that the store already held.

    A trip that could not be read at all is not stored: the fault may be fixed by the next run.
    Trips relative to a healthy vehicle of none of the models are left out. HistoryError is raised
    if the store cannot be used.
    """
    vehicle = models[0].vehicle.name
    store.write(_kept(results, vehicle))
    now = {key(r) for r in results for key in (trip_key, undated_key)}
    undated = {trip_key(r) for r in results if not r.start}
    earlier = [
        r
        for r in store.read(vehicle, place)
        if trip_key(r) not in now and undated_key(r) not in undated
    ]
    fitting = [r for r in earlier if r.status != OK or any(_is_of(r, m) for m in models)]
    if len(fitting) < len(earlier):
        log.warning("%s", LEFT_OUT.format(store, len(earlier) - len(fitting), place))
    return [*results, *fitting]


def _is_of(result: TripResult, model: TrainedModel) -> bool:
    if not np.isclose(result.healthy_since_km, since_km(model), rtol=0, atol=0, equal_nan=True):
        return False
    return any(
        np.allclose(
            [result.healthy_si.get(name, np.nan) for name in healthy.names],
            healthy.values,
            rtol=1e-9,
            atol=0,
        )
        for healthy in model.references
    )


def keep_trips(
    results: Sequence[TripResult],
    place: Place,
    models: Sequence[TrainedModel],
    limits: Mapping[str, Limits],
    settings: ChangeSettings,
    store: History,
) -> list[Alarm]:
    """Store trips of a suspension, and the alarms that its whole history raises; return these.

    The alarms are those of ``with_earlier``, of which only the series of numbers is read.
    HistoryError is raised if the store cannot be used.
    """
    vehicle = models[0].vehicle.name
    store.write(kept := _kept(results, vehicle))
    references = [
        Reference(since_km(model), dict(zip(one.names, one.values.tolist(), strict=True)))
        for model in models
        for one in model.references
    ]
    series, n_others = store.comparable(vehicle, place, references, kept)
    if n_others and (words := LEFT_OUT.format(store, n_others, place)) not in _LOGGED:
        _LOGGED.add(words)
        log.warning("%s", words)
    alarms = [] if series is None else watch(series, limits, settings).alarms
    store.keep_alarms(vehicle, place, alarms, OWN_CAUSES)
    return alarms


def _kept(results: Sequence[TripResult], vehicle: str) -> list[TripResult]:
    """Return the trips that are stored: one that could not be read may be fixed by the next run."""
    return [one for one in results if one.status != ERROR and one.vehicle == vehicle]
