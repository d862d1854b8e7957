"""Trips of a suspension as arrays, with its maintenance: what its state is made from."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.records import Key, Place, TripResult
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.ground.wording import kilometres

NUMBERS = ("mileage_km", "healthy_since_km", "speed_m_per_s", "temperature_c")
"""Columns of numbers of a series, besides those of each parameter."""
KINDS = ("exchanged", "reprofiled", "other")
"""Kinds of maintenance: a part exchanged, wheels reprofiled, or what the words say."""


@dataclass(frozen=True)
class Event:
    """Maintenance of a suspension: trips from then on are judged by themselves.

    Attributes
    ----------
    mileage_km : float, [km]
        The first trips of this mileage or more are after it.
    kind : str
        One of ``KINDS``.
    words : str
        What was done.
    """

    mileage_km: float
    kind: str = "other"
    words: str = ""

    def __post_init__(self) -> None:
        if not math.isfinite(self.mileage_km):
            raise ValueError(f"an event needs a mileage in km, got {self.mileage_km}")
        if self.kind not in KINDS:
            raise ValueError(f"an event is one of {', '.join(KINDS)}, got {self.kind!r}")

    def __str__(self) -> str:
        """Return the event in words."""
        return f"{self.words or self.kind} at {kilometres(self.mileage_km)}"


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
        UTC where the manifest names a zone, else as written there; NaT where there is none.
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
    def key(self) -> Key:
        """Vehicle and place."""
        return self.vehicle, self.place

    @property
    def outputs(self) -> tuple[str, ...]:
        """Parameters that any trip has an estimate of; all where no trip has one."""
        known = {name for name, column in self.estimates.items() if np.isfinite(column).any()}
        return tuple(name for name in self.estimates if name in known or not known)

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

    def part(self, chosen: BoolArray | IntArray) -> Series:
        """Return the chosen trips alone, by a mask or their places."""
        columns = {
            name: getattr(self, name)[chosen] for name in ("trip", "start", "flagged", *NUMBERS)
        }
        estimates, half_widths = (
            {name: column[chosen] for name, column in part.items()}
            for part in (self.estimates, self.half_widths)
        )
        return replace(self, estimates=estimates, half_widths=half_widths, **columns)

    def equals(self, other: Series) -> bool:
        """Return whether all of it is the same, NaN to NaN."""
        if (self.vehicle, self.place, self.events) != (other.vehicle, other.place, other.events):
            return False
        mine, its = _columns(self), _columns(other)
        return (
            mine.keys() == its.keys()
            and np.array_equal(self.trip, other.trip)
            and all(np.array_equal(one, its[name], equal_nan=True) for name, one in mine.items())
        )


def _columns(one: Series) -> dict[str, NDArray[Any]]:
    columns = {name: getattr(one, name) for name in ("start", "flagged", *NUMBERS)}
    columns |= one.estimates
    return columns | {f"{name}_half_width": column for name, column in one.half_widths.items()}


def car_of(one: Series) -> tuple[str, ...]:
    """Return what the suspensions of a car have in common.

    Where no car is named, those are of one car that differ in bogie or side alone.
    """
    place = one.place
    return one.vehicle, place.train, place.car, "" if place.car else place.suspension


def of_same_car(series: Sequence[Series]) -> list[list[Series]]:
    """Return the suspensions of each car that has several."""
    cars: dict[tuple[str, ...], list[Series]] = {}
    for one in series:
        cars.setdefault(car_of(one), []).append(one)
    return [sisters for sisters in cars.values() if len(sisters) > 1]


def make_series(
    mileage_km: ArrayLike,
    estimates: Mapping[str, ArrayLike],
    half_widths: Mapping[str, ArrayLike] | None = None,
    flagged: ArrayLike = False,
    events: Iterable[Event] = (),
    **others: Any,
) -> Series:
    """Return trips of one suspension from arrays of shape (n_trips,), in any order.

    Parameters
    ----------
    mileage_km : array, [km]
        NaN: not known.
    estimates, half_widths : mapping from parameter to array, [-]
        Relative to healthy, and half widths of their intervals in logarithms. NaN or missing: none.
    flagged : bool array
    events : iterable of Event
    **others
        Of ``Series``: vehicle, place, and arrays that are NaN or empty by default.

    Examples
    --------
    >>> make_series([20.0, 10.0], {"k_p": [0.9, 1.0]}).estimates["k_p"]
    array([1. , 0.9])
    """
    km = np.asarray(mileage_km, dtype=float)
    n = len(km)
    trip = np.broadcast_to(np.asarray(others.pop("trip", ""), dtype=str), n)
    start = np.broadcast_to(np.asarray(others.pop("start", "NaT"), dtype="datetime64[s]"), n)
    marks = np.broadcast_to(np.asarray(flagged, dtype=bool), n)
    order = np.lexsort((trip, km))  # NaN last

    def columns(given: Mapping[str, ArrayLike], names: Iterable[str]) -> dict[str, FloatArray]:
        whole = {name: np.asarray(given.get(name, np.nan), dtype=float) for name in names}
        return {name: np.broadcast_to(one, n)[order] for name, one in whole.items()}

    return Series(
        others.pop("vehicle", ""),
        others.pop("place", Place()),
        trip[order],
        start[order],
        marks[order],
        estimates=columns(estimates, PARAMETERS),
        half_widths=columns(half_widths or {}, PARAMETERS),
        events=tuple(sorted(events, key=lambda one: one.mileage_km)),
        **columns({"mileage_km": km} | others, NUMBERS),
    )


def series_of(results: Sequence[TripResult], events: Iterable[Event] = ()) -> Series:
    """Return the trips of one suspension, at least one, as arrays by mileage."""

    def values(kind: str) -> dict[str, list[float]]:
        return {
            name: [getattr(one, kind).get(name, np.nan) for one in results] for name in PARAMETERS
        }

    return make_series(
        [one.mileage_km for one in results],
        values("estimates"),
        values("half_widths"),
        [bool(one.flags) for one in results],
        events,
        vehicle=results[0].vehicle,
        place=results[0].place,
        trip=[one.trip for one in results],
        start=np.array([utc(one.start) for one in results], dtype="datetime64[s]"),
        healthy_since_km=[one.healthy_since_km for one in results],
        speed_m_per_s=[one.quality.speed_m_per_s for one in results],
        temperature_c=[one.temperature_c for one in results],
    )


def utc(text: str) -> datetime | None:
    """Return a start without its zone: in UTC, if it has one."""
    if not text:
        return None
    try:
        time = datetime.fromisoformat(text)
        return time.astimezone(UTC).replace(tzinfo=None) if time.tzinfo else time
    except (ValueError, OverflowError):
        raise ValueError(f"`start` must be a time in ISO 8601, not {text[:40]!r}") from None
