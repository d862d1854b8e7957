"""All trips of many suspensions as arrays, for a view of the whole fleet."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import sqlalchemy as sql
from numpy.typing import NDArray
from sqlalchemy.engine import Connection

from suspnet.dynamics import PARAMETERS
from suspnet.history.events import Event
from suspnet.history.kept import read_kept
from suspnet.history.schema import VALUES, trips
from suspnet.history.suspensions import Key, is_one_of, known_suspensions
from suspnet.recordings.manifest import Place
from suspnet.types import BoolArray, FloatArray

ROWS = 20_000
"""Rows that are held as Python's objects at once."""
NUMBERS = ("mileage_km", "healthy_since_km", "speed_m_per_s", "temperature_c")
TEXTS = ("trip", "start")


@dataclass(frozen=True, eq=False)
class Series:
    """Trips of one suspension, by mileage, as arrays of shape (n_trips,).

    Attributes
    ----------
    vehicle : str
    place : Place
    trip : array of str
        Names.
    start : array of datetime64[s]
        UTC where the manifest names a zone, else as it stands there; NaT where there is none.
    flagged : bool array
    mileage_km, healthy_since_km : arrays, [km]
    speed_m_per_s : array, [m/s]
    temperature_c : array, [°C]
        Of the air outside.
    estimates, half_widths : dict of arrays, [-]
        Of each parameter, as in a trip's result; NaN where there is none.
    events : tuple of Event
        Maintenance, by mileage.
    """

    vehicle: str
    place: Place
    trip: NDArray[np.str_]
    start: NDArray[np.datetime64]
    flagged: BoolArray
    mileage_km: FloatArray
    healthy_since_km: FloatArray
    speed_m_per_s: FloatArray
    temperature_c: FloatArray
    estimates: dict[str, FloatArray]
    half_widths: dict[str, FloatArray]
    events: tuple[Event, ...] = ()

    @property
    def done(self) -> BoolArray:
        """Which trips have an estimate, bool array of shape (n_trips,)."""
        known: BoolArray = np.array([np.isfinite(one) for one in self.estimates.values()])
        return np.asarray(known.any(axis=0))

    @property
    def one_healthy(self) -> BoolArray:
        """Which trips are relative to the healthy vehicle of the newest, array of (n_trips,)."""
        newest = self.healthy_since_km[np.flatnonzero(self.done)[-1:]]
        known = np.isin(self.healthy_since_km, newest)
        return np.asarray(known | (np.isnan(self.healthy_since_km) & np.isnan(newest).any()))

    @property
    def recent(self) -> BoolArray:
        """Which of these are since the last maintenance, array of shape (n_trips,)."""
        since = max((event.mileage_km for event in self.events), default=-np.inf)
        return np.asarray(self.one_healthy & ~(self.mileage_km < since))

    def equals(self, other: Series) -> bool:
        """Return whether all of it is the same, NaN to NaN."""
        if (self.vehicle, self.place, self.events) != (other.vehicle, other.place, other.events):
            return False
        for name in ("start", "flagged", *NUMBERS):
            if not np.array_equal(getattr(self, name), getattr(other, name), equal_nan=True):
                return False
        for mine, its in (
            (self.estimates, other.estimates),
            (self.half_widths, other.half_widths),
        ):
            if mine.keys() != its.keys() or not all(
                np.array_equal(mine[name], its[name], equal_nan=True) for name in mine
            ):
                return False
        return np.array_equal(self.trip, other.trip)


def read_series(connection: Connection, keys: Collection[Key] | None = None) -> list[Series]:
    """Return all trips of each suspension, or of those named, sorted by vehicle and place."""
    names = known_suspensions(connection)
    chosen = None if keys is None else [one for one, key in names.items() if key in keys]
    events = read_kept(connection, Event)
    numbers, texts = _columns(connection, chosen)
    owner, km = numbers[:, 0].astype(np.int64), numbers[:, 2]
    order = np.lexsort((texts[0], km, owner))  # NaN last
    numbers, texts = numbers[order], [one[order] for one in texts]
    ids, begins = np.unique(owner[order], return_index=True)
    parts = np.split(np.arange(len(order)), begins[1:]) if len(ids) else []
    found = []
    for one, part in zip(ids.tolist(), parts, strict=True):
        vehicle, place = names[one]
        columns = iter(numbers[part].T[1:].copy())
        flagged = next(columns) > 0
        scalars = {name: next(columns) for name in NUMBERS}
        values = [{name: next(columns) for name in PARAMETERS} for _ in range(2)]
        found.append(
            Series(
                vehicle,
                place,
                texts[0][part],
                np.array([utc(text) for text in texts[1][part]], dtype="datetime64[s]"),
                flagged,
                estimates=values[0],
                half_widths=values[1],
                events=tuple(events.get((vehicle, place), ())),
                **scalars,
            )
        )
    return sorted(found, key=lambda s: (s.vehicle, str(s.place)))


def _columns(
    connection: Connection, chosen: list[int] | None
) -> tuple[FloatArray, list[NDArray[np.str_]]]:
    """Return the numbers of all trips, or of some suspensions', a row a trip, and their texts.

    The numbers are: that of the suspension, whether the trip is flagged, ``NUMBERS``, estimates,
    half widths.
    """
    values = [
        VALUES[key].format(name) for key in ("estimates", "half_widths") for name in PARAMETERS
    ]
    flagged = sql.case((trips.c.flags == "", 0), else_=1)
    numbers = [trips.c.suspension_id, flagged, *(trips.c[name] for name in (*NUMBERS, *values))]
    query = sql.select(*numbers, *(trips.c[name] for name in TEXTS))
    if chosen is not None:
        query = query.where(is_one_of(trips.c.suspension_id, chosen))
    blocks = [np.zeros((0, len(numbers)))]
    texts = [[np.zeros(0, dtype=str)] for _ in TEXTS]
    for rows in connection.execute(query, execution_options={"yield_per": ROWS}).partitions():
        columns = list(zip(*rows, strict=True))
        blocks.append(np.array(columns[: len(numbers)], dtype=float).T)
        for kept, column in zip(texts, columns[len(numbers) :], strict=True):
            kept.append(np.array(column, dtype=str))
    return np.concatenate(blocks), [np.concatenate(one) for one in texts]


def utc(text: str) -> datetime | None:
    """Return a start without its zone: in UTC, if it has one."""
    if not text:
        return None
    time = datetime.fromisoformat(text)
    return time.astimezone(UTC).replace(tzinfo=None) if time.tzinfo else time
