"""Frequency responses of trips as plain data for figures and tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspnet.ground.records import TripCurves
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import kilometres
from suspnet.history.arrays import TripResponses

PARTS = ("primary suspension: axle box to bogie frame", "secondary suspension: frame to car body")
BAND = 1.96
"""Standard deviations on each side that hold 95 % of normally distributed values."""
LARGEST_BAND = 3.0
"""Largest half width of a drawn band in log-magnitude; wider ones would flatten the axis."""
N_ROWS = 12
"""Number of frequencies in a table of responses."""


@dataclass(frozen=True, eq=False)
class Response:
    """How the two suspensions amplified vibration on one trip.

    `frequencies_hz`: (n_freq,) [Hz]. `magnitudes`, `coherences`, `low` and `high` are (2, n_freq),
    of primary and secondary suspension; `low` and `high` are the ends of the 95 % band, NaN where
    it is unknown.
    """

    trip: str
    mileage_km: float
    frequencies_hz: FloatArray
    magnitudes: FloatArray
    coherences: FloatArray
    low: FloatArray
    high: FloatArray

    def __str__(self) -> str:
        return f"{self.trip}, {kilometres(self.mileage_km)}"


def response(trip: str, mileage_km: float, curves: TripCurves | TripResponses) -> Response:
    """Return the response that is shown of a trip's curves."""
    magnitudes = np.abs(curves.responses)
    ends = band(magnitudes, curves.deviations)
    shared = curves.frequencies_hz, magnitudes, curves.coherences
    return Response(trip, mileage_km, *shared, *ends)


def band(magnitudes: FloatArray, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the 95 % band around magnitudes; NaN where a deviation is not finite.

    Deviations are standard deviations of the log-magnitude.
    """
    known = np.isfinite(deviations)
    half = np.where(known, np.minimum(BAND * np.where(known, deviations, 0), LARGEST_BAND), np.nan)
    return magnitudes * np.exp(-half), magnitudes * np.exp(half)


def response_table(first: Response, newest: Response) -> list[list[float]]:
    """Return amplifications as rows: frequency, then both suspensions' of first and newest trip."""
    ends = (
        max(first.frequencies_hz[0], newest.frequencies_hz[0]),
        min(first.frequencies_hz[-1], newest.frequencies_hz[-1]),
    )
    if not ends[0] < ends[1]:
        return []
    chosen = np.geomspace(*ends, N_ROWS)
    columns: Sequence[FloatArray] = [
        np.interp(chosen, one.frequencies_hz, one.magnitudes[part])
        for part in range(len(PARTS))
        for one in (first, newest)
    ]
    rows: list[list[float]] = np.column_stack([chosen, *columns]).tolist()
    return rows
