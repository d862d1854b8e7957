"""Suspensions of the same car side by side, from the history of the whole fleet."""

from __future__ import annotations

from collections.abc import Sequence

from suspnet.history.series import Series
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.sisters import Sister, SisterSettings, sister_alarms
from suspnet.recordings.manifest import Place

Key = tuple[str, Place]
"""Vehicle and place: which suspension it is."""


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


def alarms_of_sisters(series: Sequence[Series], settings: SisterSettings) -> dict[Key, list[Alarm]]:
    """Return the alarms of each suspension that differs, or differed, from its sisters.

    Trips before the last commissioning or maintenance of a suspension do not count, nor do
    flagged ones.
    """
    found: dict[Key, list[Alarm]] = {}
    for car in of_same_car(series):
        for parameter in settings.least_percent:
            alarms = sister_alarms(parameter, [_sister(one, parameter) for one in car], settings)
            for one, own in zip(car, alarms, strict=True):
                if own:
                    found.setdefault((one.vehicle, one.place), []).extend(own)
    return found


def _sister(one: Series, parameter: str) -> Sister:
    """Return a parameter of a suspension since its last commissioning and maintenance."""
    used = one.recent & ~one.flagged
    return Sister(
        one.mileage_km[used], one.estimates[parameter][used], one.half_widths[parameter][used]
    )
