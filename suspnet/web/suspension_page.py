"""What the page of one suspension shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.records import TripResult
from suspnet.history.arrays import TripResponses
from suspnet.maintenance.alarms import Acknowledgement, newest_of
from suspnet.report.overview import FleetView
from suspnet.report.report import NAMES
from suspnet.report.trip_table import trip_table
from suspnet.trips.details import files_read_as
from suspnet.web.response_figure import response_table
from suspnet.web.trend_figure import ranges

N_TRIPS = 20
"""Number of the newest trips in the table."""
LEVEL = 0.9
"""Probability of the intervals of trips, as evaluate.py and the monitor have it by default."""


def suspension_values(
    view: FleetView,
    place: int,
    results: Sequence[TripResult],
    kept: Sequence[TripResponses],
    seen: Sequence[Acknowledgement],
) -> dict[str, Any]:
    """Return what the template of a suspension takes.

    Parameters
    ----------
    view : FleetView
    place : int
        Of the suspension in the view.
    results : sequence of TripResult
        By mileage; empty if the store cannot be read.
    kept : sequence of TripResponses
        By mileage.
    seen : sequence of Acknowledgement
    """
    state = view.states[place]
    over = [one for one in state.watched.alarms if not one.is_open]
    newest = list(reversed(results[-N_TRIPS:]))
    return {
        "state": state,
        "row": view.rows[place],
        "limits": view.limits.get(state.series.vehicle, {}),
        "names": NAMES,
        "alarms": [(one, newest_of(one, seen)) for one in state.alarms],
        "over": [(one, newest_of(one, seen)) for one in reversed(over)],
        "ranges": ranges(state),
        "trips": trip_table(newest, PARAMETERS, LEVEL),
        "read_as": files_read_as(newest),
        "n_trips": len(state.series.trip),
        "first_km": _end(state.series.mileage_km, np.min),
        "newest_km": _end(state.series.mileage_km, np.max),
        "kept": kept,
        "gains": response_table(kept) if kept else [],
    }


def _end(mileage_km: Any, of: Any) -> float:
    """Return the least or largest of the mileages that are known, [km]; NaN if none is."""
    known = mileage_km[np.isfinite(mileage_km)]
    return float(of(known)) if len(known) else np.nan
