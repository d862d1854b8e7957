"""Trips that were read before: by an interrupted evaluation, or by earlier ones, in the store."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from suspnet.estimation.checkpoint import fingerprint
from suspnet.estimation.fitted import Model
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.cache import Cache, code_hash
from suspnet.ground.parameters import Limits
from suspnet.ground.records import (
    ERROR,
    Place,
    TripCurves,
    TripResult,
    from_row,
    to_arrays,
    to_responses,
    to_row,
)
from suspnet.trains.history import History
from suspnet.trains.history.schema import trip_key, undated_key
from suspnet.trains.maintenance.alarms import Alarm, watch
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.recordings.manifest_files import ManifestFile
from suspnet.trains.trips.commissionings import healthy_state

log = logging.getLogger(__name__)
FOLDER = "finished_trips"  # subfolder of an evaluation's output that holds its trips' results
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

    def __init__(self, folder: Path, models: Sequence[Model], settings: TripSettings) -> None:
        self._cache = Cache(folder / FOLDER)
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
        states = {str(path): path.stat() for path in data}
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
    results: Sequence[TripResult], place: Place, models: Sequence[Model], store: History
) -> list[TripResult]:
    """Store a suspension's trips, and return them with those that the store already held.

    A trip that could not be read at all is not stored: the fault may be fixed by the next run.
    Trips relative to a healthy vehicle of none of the models are left out. HistoryError is raised
    if the store cannot be used.
    """
    vehicle = models[0].vehicle.name
    store.write(_storable(results, vehicle))
    series, n_others = store.comparable(vehicle, place, list(map(healthy_state, models)), results)
    if n_others:
        log.warning("%s", LEFT_OUT.format(store, n_others, place))
    if series is None:
        return list(results)
    fitting = set(zip(series.trip.tolist(), map(str, series.mileage_km.tolist()), strict=True))
    now = {key(r) for r in results for key in (trip_key, undated_key)}
    undated = {trip_key(r) for r in results if not r.start}
    earlier = [
        r
        for r in store.read(vehicle, place)
        if (r.trip, str(r.mileage_km)) in fitting
        and trip_key(r) not in now
        and undated_key(r) not in undated
    ]
    return [*results, *earlier]


def keep_trips(
    results: Sequence[TripResult],
    place: Place,
    models: Sequence[Model],
    limits: Mapping[str, Limits],
    settings: ChangeSettings,
    store: History,
) -> list[Alarm]:
    """Store trips of a suspension, and the alarms that its whole history raises; return these.

    The alarms are those of ``with_earlier``, of which only the series of numbers is read.
    HistoryError is raised if the store cannot be used.
    """
    vehicle = models[0].vehicle.name
    store.write(storable := _storable(results, vehicle))
    series, n_others = store.comparable(vehicle, place, list(map(healthy_state, models)), storable)
    if n_others and (words := LEFT_OUT.format(store, n_others, place)) not in _LOGGED:
        _LOGGED.add(words)
        log.warning("%s", words)
    alarms = [] if series is None else watch(series, limits, settings).alarms
    store.keep_alarms(vehicle, place, alarms)
    return alarms


def _storable(results: Sequence[TripResult], vehicle: str) -> list[TripResult]:
    """Return the trips that are stored: one that could not be read may be fixed by the next run."""
    return [result for result in results if result.status != ERROR and result.vehicle == vehicle]
