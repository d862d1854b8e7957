"""Trips of a suspension as arrays, with its maintenance events."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from suspnet.ground.findings import Finding, stored
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, ESTIMATED, PARAMETERS
from suspnet.ground.records import (
    EVENT_KINDS,
    SENSOR,
    Key,
    Place,
    TripResult,
    sensors_from_text,
    utc,
)
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.maintenance.directions import SIGNS, widened
from suspnet.maintenance.sensors import LEAST, SensorTrend, sensor_trends

NUMBERS = ("mileage_km", "healthy_since_km", "speed_m_per_s", "temperature_c", "direction")
"""Numeric columns of a series, in addition to those of each parameter."""
NEWEST = 5
"""Number of the newest trips with an estimate that verdicts are made of."""


@dataclass(frozen=True)
class Event:
    """Maintenance of a suspension: later trips are judged without earlier ones.

    After that of the kind ``SENSOR`` only the sensors are, those that `words` names.
    Trips of at least `mileage_km` are after it. `kind` is one of ``EVENT_KINDS``; `words` say what.
    """

    mileage_km: float
    kind: str = "other"
    words: str = ""

    def __post_init__(self) -> None:
        if not math.isfinite(self.mileage_km):
            raise ValueError(f"an event needs a mileage in km, got {self.mileage_km}")
        if self.kind not in EVENT_KINDS:
            raise ValueError(f"an event is one of {', '.join(EVENT_KINDS)}, got {self.kind!r}")

    def __str__(self) -> str:
        return Finding("event", words=self.words or self.kind, km=self.mileage_km)


@dataclass(frozen=True, eq=False)
class Series:
    """Trips of one suspension, by mileage, as arrays of shape (n_trips,).

    Attributes
    ----------
    vehicle : str
    place : Place
    trip : array of str
        Names of the trips.
    start : array of datetime64[s]
        UTC if the manifest gives a zone, else as given there; NaT: unknown.
    flagged : bool array
    mileage_km, healthy_since_km : arrays, [km]
    speed_m_per_s : array, [m/s]
    temperature_c : array, [°C]
        Temperature of the outside air.
    direction : array
        Of travel, one of ``SIGNS``; NaN: unknown.
    estimates, half_widths : dict of arrays, [-]
        Of each parameter, as in ``TripResult``, and of each part that any trip has; NaN: none.
    events : tuple of Event
        Sorted by mileage.
    n_first : int, optional
        Number of first trips whose median is healthy; None: the model defines it.
    sensors : array of str, optional
        Health of the sensors, as in ``Quality``; None: unknown.
    worn : array of str objects, optional
        Which parts of the bogie have worn, as in ``TripResult``; None: unknown.
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
    direction: FloatArray
    estimates: dict[str, FloatArray]
    half_widths: dict[str, FloatArray]
    events: tuple[Event, ...] = ()
    n_first: int | None = None
    sensors: NDArray[np.str_] | None = None
    worn: NDArray[np.object_] | None = None

    @property
    def key(self) -> Key:
        """Vehicle and place."""
        return self.vehicle, self.place

    @property
    def repairs(self) -> list[float]:
        """Mileages of the maintenance that gives parameters a new reference, [km]."""
        return [event.mileage_km for event in self.events if event.kind != SENSOR]

    @cached_property
    def sensor_trends(self) -> list[SensorTrend]:
        """Each sensor along the trips with a mileage, which ``part`` drops."""
        if self.sensors is None or not self.sensors.any():
            return []
        replaced = [(one.mileage_km, one.words) for one in self.events if one.kind == SENSOR]
        return sensor_trends(self.sensors.tolist(), self.mileage_km, replaced)

    @cached_property
    def misled(self) -> BoolArray:
        """Mask of the trips whose estimates are wrong by a sensor's sensitivity or delay.

        The ``doubted`` trip is taken as one.
        """
        wrong = [one.misleads for one in self.sensor_trends]
        return np.asarray(np.logical_or.reduce([self.doubted, *wrong]))

    @cached_property
    def doubted(self) -> BoolArray:
        """Mask of the newest trip if its sensors are the likelier reason of what it shows.

        It is flagged, one of its sensors is dead, loose or faulty, and it does not show the parts
        that the trip before shows: a damaged suspension shows itself on the next trip, too.
        """
        found = np.zeros(len(self.trip), dtype=np.bool_)
        read = [np.isfinite(self.estimates[one]) for one in BOGIE_PARTS if one in self.estimates]
        shown = np.logical_or.reduce([found, *read])
        *_, before, newest = [-1, -1, *np.flatnonzero(self.done)]
        if self.sensors is None or not self.done.any():
            return found
        if shown[before] and not self.flagged[before]:
            sensors = sensors_from_text(self.sensors[newest]).values()
            is_faulty = any(one.faulty > LEAST["faulty"] for one in sensors)
            found[newest] = is_faulty and self.flagged[newest] and not shown[newest]
        return found

    @property
    def outputs(self) -> tuple[str, ...]:
        """Parameters with an estimate for any trip; all parameters if there is none.

        Where parts are read, those of both sides as equal count only on the newest trips, since
        the last one that shows its parts without a flag: else these say more.
        """
        known = {name for name, column in self.estimates.items() if np.isfinite(column).any()}
        newest = np.flatnonzero(self.done & ~self.doubted)[-NEWEST:]
        if parts := known & set(BOGIE_PARTS):
            shown = np.isfinite([self.estimates[name] for name in parts]).any(axis=0)
            last = np.flatnonzero(shown & ~self.flagged).max(initial=-1)
            newest = newest[newest > last]
            for name in PARAMETERS[:-1]:
                if not np.isfinite(self.estimates[name][newest]).any():
                    known.discard(name)
        return tuple(name for name in self.estimates if name in known or not known)

    @property
    def done(self) -> BoolArray:
        """Mask of the trips with an estimate."""
        known: BoolArray = np.array([np.isfinite(one) for one in self.estimates.values()])
        return np.asarray(known.any(axis=0))

    @property
    def one_healthy(self) -> BoolArray:
        """Mask of the trips with the same commissioning as the newest trip with an estimate."""
        newest = self.healthy_since_km[np.flatnonzero(self.done)[-1:]]
        known = np.isin(self.healthy_since_km, newest)
        return np.asarray(known | (np.isnan(self.healthy_since_km) & np.isnan(newest).any()))

    @property
    def recent(self) -> BoolArray:
        """Mask of the trips since the last commissioning and the last maintenance."""
        since = max(self.repairs, default=-np.inf)
        return np.asarray(self.one_healthy & ~(self.mileage_km < since))

    @property
    def between(self) -> list[IntArray]:
        """Indices of the trips before, between and after maintenance; without a mileage: after."""
        known_km = self.mileage_km[np.isfinite(self.mileage_km)]
        ends = np.searchsorted(known_km, self.repairs)
        return np.split(np.arange(len(self.trip)), ends)

    def relative_to_first(self, n_first: int | None) -> Series:
        """Return the trips as ``relative_to_first`` does, or this series if `n_first` is None."""
        if n_first is None:
            return self
        estimates, half_widths = (
            {name: column.copy() for name, column in part.items()}
            for part in (self.estimates, self.half_widths)
        )
        for trips in self.between:
            for name in set(estimates) - {BODY_MASS}:
                first = trips[np.isfinite(self.estimates[name][trips])][:n_first]
                if not len(first):
                    continue
                estimates[name][trips] /= np.median(estimates[name][first])
                own = half_widths[name]
                own[trips] = np.hypot(own[trips], half_width_of_median(own[first]))
        return replace(self, estimates=estimates, half_widths=half_widths, n_first=n_first)

    def widened(self) -> Series:
        """Return the trips with intervals that hold what both directions of travel show.

        Flagged trips, and those without a mileage or that a sensor misled, show nothing.
        """
        if len(set(self.direction[np.isfinite(self.direction)])) < 2:
            return self
        states = np.concatenate([np.full(len(own), i) for i, own in enumerate(self.between)])
        unused = ~self.done | self.flagged | self.misled | np.isnan(self.mileage_km)
        signs = np.where(unused, 0, np.nan_to_num(self.direction)).astype(int)
        since_km = self.healthy_since_km
        found = widened(signs, states, since_km, self.estimates, self.half_widths)
        return replace(self, half_widths=found)

    def part(self, chosen: BoolArray | IntArray) -> Series:
        """Return the trips chosen by a mask or by indices, as they are to be judged.

        Those that a sensor `misled` have no estimate there; the sensors themselves are dropped.
        """
        columns = {
            name: getattr(self, name)[chosen] for name in ("trip", "start", "flagged", *NUMBERS)
        }
        columns["worn"] = None if self.worn is None else self.worn[chosen]
        estimates, half_widths = (
            {name: np.where(self.misled, np.nan, column)[chosen] for name, column in part.items()}
            for part in (self.estimates, self.half_widths)
        )
        return replace(self, estimates=estimates, half_widths=half_widths, sensors=None, **columns)

    def equals(self, other: Series) -> bool:
        """Return whether all fields are equal, with NaN equal to NaN."""
        mine, its = _columns(self), _columns(other)
        return (
            (self.key, self.events, self.n_first) == (other.key, other.events, other.n_first)
            and mine.keys() == its.keys()
            and np.array_equal(self.trip, other.trip)
            and _texts(self) == _texts(other)
            and all(np.array_equal(one, its[name], equal_nan=True) for name, one in mine.items())
        )


def _texts(one: Series) -> list[list[str]]:
    nothing = [""] * len(one.trip)
    return [nothing if texts is None else texts.tolist() for texts in (one.sensors, one.worn)]


def _columns(one: Series) -> dict[str, NDArray[Any]]:
    columns = {name: getattr(one, name) for name in ("start", "flagged", *NUMBERS)}
    columns |= one.estimates
    return columns | {f"{name}_half_width": column for name, column in one.half_widths.items()}


def car_of(one: Series) -> tuple[str, ...]:
    """Return a key that the suspensions of a car share.

    If no car is named, suspensions that differ only in bogie or side are of one car.
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

    `mileage_km` [km]: NaN if unknown. `estimates` are relative to healthy, `half_widths` those of
    their intervals in logarithms; NaN or missing: none. `others` are fields of ``Series``: vehicle,
    place, and arrays that are NaN or empty by default.

    Examples
    --------
    >>> make_series([20.0, 10.0], {"k_p": [0.9, 1.0]}).estimates["k_p"]
    array([1. , 0.9])
    """
    km = np.asarray(mileage_km, dtype=float)
    n = len(km)
    trip = np.broadcast_to(np.asarray(others.pop("trip", ""), dtype=str), n)
    start = np.broadcast_to(np.asarray(others.pop("start", "NaT"), dtype="datetime64[s]"), n)
    sensors = np.broadcast_to(np.asarray(others.pop("sensors", ""), dtype=str), n)
    worn = np.broadcast_to(np.asarray(others.pop("worn", ""), dtype=object), n)
    marks = np.broadcast_to(np.asarray(flagged, dtype=bool), n)
    order = np.lexsort((trip, km))  # NaN last

    def columns(given: Mapping[str, ArrayLike], names: Iterable[str]) -> dict[str, FloatArray]:
        whole = {name: np.asarray(given.get(name, np.nan), dtype=float) for name in names}
        return {name: np.broadcast_to(one, n)[order] for name, one in whole.items()}

    names = with_estimates(estimates)
    return Series(
        others.pop("vehicle", ""),
        others.pop("place", Place()),
        trip[order],
        start[order],
        marks[order],
        estimates=columns(estimates, names),
        half_widths=columns(half_widths or {}, names),
        events=tuple(sorted(events, key=lambda one: one.mileage_km)),
        n_first=None,
        sensors=sensors[order],
        worn=worn[order],
        **columns({"mileage_km": km} | others, NUMBERS),
    )


def with_estimates(estimates: Mapping[str, ArrayLike]) -> tuple[str, ...]:
    """Return the names of a series' columns: all parameters, and parts with any estimate."""
    parts = (name for name in ESTIMATED if name not in PARAMETERS and name in estimates)
    known = (name for name in parts if np.isfinite(np.asarray(estimates[name], dtype=float)).any())
    return (*PARAMETERS[:-1], *known, BODY_MASS)


def series_of(results: Sequence[TripResult], events: Iterable[Event] = ()) -> Series:
    """Return the trips of one suspension, at least one, as arrays by mileage.

    Their intervals are ``Series.widened``.
    """

    def values(kind: str) -> dict[str, list[float]]:
        return {
            name: [getattr(one, kind).get(name, np.nan) for one in results] for name in ESTIMATED
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
        sensors=[one.quality.sensors for one in results],
        worn=[stored(one.worn) for one in results],
        temperature_c=[one.temperature_c for one in results],
        direction=[SIGNS.get(one.quality.direction, np.nan) for one in results],
    ).widened()


def half_width_of_median(half_widths: ArrayLike) -> float:
    """Return the half-width of the median of trips from their own; 0 if one is unknown."""
    widths = np.asarray(half_widths, dtype=float)
    return float(np.nan_to_num(np.sqrt(np.pi / 2 / len(widths)) * np.median(widths)))
