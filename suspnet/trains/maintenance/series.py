"""Trips of a suspension as arrays, with its maintenance events."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from suspnet.ground.findings import Finding, stored
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, ESTIMATED, PARAMETERS
from suspnet.ground.records import EVENT_KINDS, SENSOR, Commissioning, Key, Place, TripResult, utc
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.trains.maintenance.directions import SIGNS, widened
from suspnet.trains.maintenance.sensors import SensorTrend, sensor_trends

NUMBERS = ("mileage_km", "healthy_since_km", "speed_m_per_s", "temperature_c", "direction")
"""Numeric columns of a series, in addition to those of each parameter."""
PARTS, EQUAL = set(BOGIE_PARTS), set(PARAMETERS) - {BODY_MASS}
"""Springs and dampers, each part, and of both sides and axles as equal."""
N_LAST = 5  # number of the newest trips with an estimate that decide on a parameter


@dataclass(frozen=True)
class Event:
    """Maintenance of a suspension: later trips are judged without earlier ones.

    After that of the kind ``SENSOR`` only the sensors are, those that `words` names. Trips of at
    least `mileage_km` are after it. `kind` is one of ``EVENT_KINDS``; `words` say what.
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
    """Trips of one suspension, by mileage, as arrays of shape (n_trips,); NaN: unknown.

    `trip` are their names, `start` is in UTC if the manifest gives a zone, else as given there
    (NaT: unknown), `temperature_c` that of the outside air, `direction` one of ``SIGNS``.
    `estimates` and `half_widths` are as in ``TripResult``, of each parameter and of each part that
    any trip has. `sensors` is the health of the sensors as in ``Quality``, `worn` the worn parts as
    in ``TripResult``; empty: unknown. `events` are sorted by mileage.
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
    sensors: NDArray[np.str_]
    worn: NDArray[np.object_]
    events: tuple[Event, ...] = ()

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
        """Each sensor along the trips with a mileage, which ``select`` drops."""
        replaced = [(e.mileage_km, e.words) for e in self.events if e.kind == SENSOR]
        return sensor_trends(self.sensors.tolist(), self.mileage_km, replaced)

    @cached_property
    def misled(self) -> BoolArray:
        """Mask of the trips whose estimates are wrong by a sensor's sensitivity or delay."""
        none = np.zeros(len(self.trip), dtype=np.bool_)
        misleads = [none, *(trend.misleads for trend in self.sensor_trends)]
        return np.asarray(np.any(misleads, axis=0))

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Parameters with an estimate for any trip; all parameters if there is none.

        They are of parts if the newest commissioning reads these, else of both sides as equal.
        """
        names = {name for name, column in self.estimates.items() if np.isfinite(column).any()}
        now = self.of_newest_reference
        has_parts = any(np.isfinite(self.estimates[name][now]).any() for name in names & PARTS)
        names -= EQUAL if has_parts else PARTS
        return tuple(name for name in self.estimates if name in names or not names)

    @property
    def done(self) -> BoolArray:
        """Mask of the trips with an estimate."""
        return np.asarray(np.isfinite(list(self.estimates.values())).any(axis=0))

    @property
    def of_newest_reference(self) -> BoolArray:
        """Mask of the trips with the same commissioning as the newest trip with an estimate."""
        newest = self.healthy_since_km[np.flatnonzero(self.done)[-1:]]
        is_same = np.isin(self.healthy_since_km, newest)
        return np.asarray(is_same | (np.isnan(self.healthy_since_km) & np.isnan(newest).any()))

    @property
    def recent(self) -> BoolArray:
        """Mask of the trips since the last commissioning and the last maintenance."""
        since = max(self.repairs, default=-np.inf)
        return np.asarray(self.of_newest_reference & ~(self.mileage_km < since))

    @property
    def between(self) -> list[IntArray]:
        """Indices of the trips before, between and after maintenance; without a mileage: after."""
        ends = np.searchsorted(self.mileage_km[np.isfinite(self.mileage_km)], self.repairs)
        return np.split(np.arange(len(self.trip)), ends)

    def widened(self) -> Self:
        """Return the trips with intervals that hold what both directions of travel show.

        Flagged trips, and those without a mileage or that a sensor misled, show nothing.
        """
        if len(set(self.direction[np.isfinite(self.direction)])) < 2:
            return self
        states = np.concatenate([np.full(len(trips), i) for i, trips in enumerate(self.between)])
        unused = ~self.done | self.flagged | self.misled | np.isnan(self.mileage_km)
        signs = np.where(unused, 0, np.nan_to_num(self.direction)).astype(int)
        columns = self.healthy_since_km, self.estimates, self.half_widths
        return replace(self, half_widths=widened(signs, states, *columns))

    def select(self, trips: BoolArray | IntArray) -> Self:
        """Return the trips of a mask or of indices, as they are to be judged.

        Those that a sensor `misled` have no estimate there; the sensors themselves are dropped.
        """
        names = ("trip", "start", "flagged", "worn", *NUMBERS)
        columns = {name: getattr(self, name)[trips] for name in names}
        columns["sensors"] = np.full(len(columns["trip"]), "")
        columns["estimates"], columns["half_widths"] = (
            {name: np.where(self.misled, np.nan, column)[trips] for name, column in values.items()}
            for values in (self.estimates, self.half_widths)
        )
        return replace(self, **columns)

    def equals(self, other: Self) -> bool:
        """Return whether all fields are equal, with NaN equal to NaN."""
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))


def _same(value: Any, other: Any) -> bool:
    if isinstance(value, dict):
        return value.keys() == other.keys() and all(_same(value[key], other[key]) for key in value)
    if isinstance(value, np.ndarray):
        return np.array_equal(value, other, equal_nan=value.dtype.kind in "fM")
    return bool(value == other)


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
    trip = np.broadcast_to(np.asarray(others.get("trip", ""), dtype=str), len(km))
    order = np.lexsort((trip, km))  # NaN last

    def column(values: ArrayLike, dtype: Any = float) -> NDArray[Any]:
        return np.broadcast_to(np.asarray(values, dtype=dtype), len(km))[order]

    # all parameters have a column, and those parts of which any trip has an estimate
    estimated = (name for name in ESTIMATED if name not in PARAMETERS and name in estimates)
    parts = [n for n in estimated if np.isfinite(np.asarray(estimates[n], dtype=float)).any()]
    names, widths = (*PARAMETERS[:-1], *parts, BODY_MASS), half_widths or {}
    others |= {"mileage_km": km}
    numbers: dict[str, Any] = {name: column(others.get(name, np.nan)) for name in NUMBERS}
    return Series(
        vehicle=others.get("vehicle", ""),
        place=others.get("place", Place()),
        trip=trip[order],
        start=column(others.get("start", "NaT"), "datetime64[s]"),
        flagged=column(flagged, bool),
        estimates={name: column(estimates.get(name, np.nan)) for name in names},
        half_widths={name: column(widths.get(name, np.nan)) for name in names},
        sensors=column(others.get("sensors", ""), str),
        worn=column(others.get("worn", ""), object),
        events=tuple(sorted(events, key=lambda event: event.mileage_km)),
        **numbers,
    )


def series_of(results: Sequence[TripResult], events: Iterable[Event] = ()) -> Series:
    """Return the trips of one suspension, at least one, as arrays by mileage.

    Their intervals are ``Series.widened``.
    """

    def values(kind: str) -> dict[str, list[float]]:
        return {name: [getattr(r, kind).get(name, np.nan) for r in results] for name in ESTIMATED}

    return make_series(
        [r.mileage_km for r in results],
        values("estimates"),
        values("half_widths"),
        [bool(r.flags) for r in results],
        events,
        vehicle=results[0].vehicle,
        place=results[0].place,
        trip=[r.trip for r in results],
        start=np.array([utc(r.start) for r in results], dtype="datetime64[s]"),
        healthy_since_km=[r.healthy_since_km for r in results],
        speed_m_per_s=[r.quality.speed_m_per_s for r in results],
        sensors=[r.quality.sensors for r in results],
        worn=[stored(r.worn) for r in results],
        temperature_c=[r.temperature_c for r in results],
        direction=[SIGNS.get(r.quality.direction, np.nan) for r in results],
    ).widened()


def with_widened(results: Sequence[TripResult], events: Sequence[Event]) -> list[TripResult]:
    """Return results with the intervals of ``Series.widened``."""
    if not results:
        return []
    # nothing depends on starts, and those of a store may be unreadable
    series = series_of([replace(result, start="") for result in results], events)
    order = np.lexsort(([r.trip for r in results], [r.mileage_km for r in results]))
    widths = series.half_widths
    return [
        replace(
            result,
            half_widths={
                name: float(widths[name][row]) if name in widths else width
                for name, width in result.half_widths.items()
            },
        )
        for row, result in zip(np.argsort(order), results, strict=True)
    ]


def relative_to_first_healthy(
    results: Sequence[TripResult], commissionings: Sequence[Commissioning]
) -> list[TripResult]:
    """Return results with estimates and truth relative to those of the first commissioning."""
    factors = {state.since_km: state.relative for state in commissionings}

    def times(values: Mapping[str, float], since_km: float) -> dict[str, float]:
        of_healthy = factors.get(since_km, {})
        return {name: value * of_healthy.get(name, 1.0) for name, value in values.items()}

    return [
        replace(
            r,
            estimates=times(r.estimates, r.healthy_since_km),
            truth=times(r.truth, r.healthy_since_km),
        )
        for r in results
    ]
