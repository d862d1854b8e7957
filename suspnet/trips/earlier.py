"""Trips of earlier evaluations, from the store, beside those that were just read."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np

from suspnet.estimation.trained import TrainedModel
from suspnet.history import Event, History
from suspnet.history.records import ERROR, OK, TripResult
from suspnet.history.rows import trip_key, undated_key
from suspnet.recordings.manifest import Place
from suspnet.trips.commissionings import since_km

log = logging.getLogger(__name__)


def with_earlier(
    results: Sequence[TripResult], place: Place, models: Sequence[TrainedModel], store: History
) -> list[TripResult]:
    """Keep a suspension's trips in the store, and return them with those that it held before.

    A trip that could not be read at all is not kept: its fault may be gone when it is read again.
    A trip that was read relative to another healthy vehicle than that of any model is left out.

    Raises
    ------
    HistoryError
        If the store cannot be used.
    """
    vehicle = models[0].vehicle.name
    kept = [r for r in results if r.status != ERROR and r.vehicle == vehicle]
    store.write(kept)
    now = {key(r) for r in results for key in (trip_key, undated_key)}
    undated = {trip_key(r) for r in results if not r.start}
    earlier = [
        r
        for r in store.read(vehicle, place)
        if trip_key(r) not in now and undated_key(r) not in undated
    ]
    fitting = [r for r in earlier if r.status != OK or any(_is_of(r, m) for m in models)]
    if len(fitting) < len(earlier):
        log.warning(
            "%s: %d earlier trips of %s are relative to another healthy vehicle than these models' "
            "and are left out; name that model's run too: run=[EARLIER,LATER]",
            store,
            len(earlier) - len(fitting),
            place,
        )
    return [*results, *fitting]


def _is_of(result: TripResult, model: TrainedModel) -> bool:
    """Return whether a trip was read relative to the same healthy vehicle as a model's."""
    healthy = [result.healthy_si.get(name, np.nan) for name in model.healthy.names]
    same = np.isclose(healthy, model.healthy.values, rtol=1e-9, atol=0).all()
    since = result.healthy_since_km, since_km(model)
    return bool(same) and (since[0] == since[1] or bool(np.isnan(since).all()))


def between(events: Sequence[Event], results: Sequence[TripResult]) -> list[list[TripResult]]:
    """Return the trips before, between and since maintenance; one without a mileage is since.

    Parameters
    ----------
    events, results : sequence
        In any order.

    Returns
    -------
    list of n_events + 1 lists
        In the order of the mileage; some may be empty.
    """
    ends = sorted(event.mileage_km for event in events)
    found: list[list[TripResult]] = [[] for _ in range(len(ends) + 1)]
    for result in results:
        unknown = np.isnan(result.mileage_km)
        place = len(ends) if unknown else bisect_right(ends, result.mileage_km)
        found[place].append(result)
    return found
