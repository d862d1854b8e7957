"""Alarms of sensors along the mileage, so that a failing sensor is never a failing damper.

Each number of ``SensorHealth`` is compared with its median over the sensor's first trips, since it
was replaced. A change counts if it exceeds a size that matters and the spread of those trips, in
several trips in a row. What all sensors share is the track: it is subtracted.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.records import SensorHealth, sensors_from_text
from suspnet.ground.types import BoolArray, FloatArray, IntArray

N_FIRST = 8  # number of first trips that are the reference of a sensor
IN_A_ROW = 3  # trips in a row that raise an alarm of a sensor, or clear it
LEAST = {"noise": math.log(2.0), "gain": 0.05, "delay_s": 0.005, "faulty": 0.01}
"""Smallest change that counts: twice the noise, 5 % of sensitivity, 5 ms, and 1 % of a trip."""
SPREADS = 4.0
"""A change counts if it exceeds this multiple of the standard deviation of the first trips."""
FAR = 2.0
"""Factor on these two for a single trip: of eight first trips a deviation is so uncertain that one
of 100 healthy trips exceeds four, one of 4,900 eight."""
MISLEADING = ("gain", "delay_s")  # numbers whose change makes estimates wrong
FLAT = 0.5
"""Largest change of the gain's rise over the band, relative to that of the gain: a side of which a
spring or damper is worn changes the gain by frequency, a sensor does not."""
TOGETHER = (("axle_box", "bogie"), ("body",))
"""Places whose gains are relative to each other: the one that differs from most has changed."""
Numbers = dict[str, FloatArray]  # numbers of one sensor by name, along the trips, (n_trips,)


@dataclass(frozen=True)
class SensorTrend:
    """One sensor along the trips: (n_trips,) arrays, NaN where unknown.

    `values` has the numbers of ``SensorHealth``, `changes` their changes from the first trips
    [log, log, s, 1], and `beyond` whether they count; `active` marks the trips with an alarm, from
    the first that confirms it. `misleads` marks those whose estimates the sensor makes wrong, by
    its gain or delay: with an alarm, or with a change that is no chance in a single trip; noise and
    drop-outs widen intervals only. `fellow` is a sensor that may be at fault in its place.
    """

    name: str
    values: Numbers
    changes: Numbers
    beyond: dict[str, BoolArray]
    active: BoolArray
    misleads: BoolArray
    fellow: str = ""

    def words(self, trip: int) -> str:
        """Return what has changed on a trip, as text."""
        size = {name: float(change[trip]) for name, change in self.changes.items()}
        texts = {
            "noise": Finding("sensor-noise", exp=math.exp(size["noise"])),
            "gain": Finding("sensor-gain", expm1=100 * math.expm1(size["gain"])),
            "delay_s": Finding("sensor-late", size=1000.0 * size["delay_s"]),
            "faulty": Finding("sensor-drop-outs", values=100 * float(self.values["faulty"][trip])),
        }
        if self.fellow:  # of two that differ, each may have changed by all of it
            difference = 100 * math.expm1(2 * size["gain"])
            texts["gain"] = Finding(
                "sensor-gain-against", difference=difference, fellow=self.fellow
            )
        return together((texts[name] for name in texts if self.beyond[name][trip]), ", ")


def sensor_trends(
    texts: Sequence[str], mileage_km: FloatArray, replaced: Sequence[tuple[float, str]] = ()
) -> list[SensorTrend]:
    """Return the trend of each sensor over trips in the order of the mileage.

    `texts` are those of ``Quality.sensors``, `mileage_km` (n_trips,). `replaced` are mileages and
    words of maintenance: a sensor that the words name starts again, all do if they name none.
    """
    trips = [sensors_from_text(text) for text in texts]
    names = list(dict.fromkeys(name for trip in trips for name in trip))
    since = {name: _eras(name, names, mileage_km, replaced) for name in names}
    health = {name: [trip.get(name, SensorHealth()) for trip in trips] for name in names}
    values = {
        name: {
            n: np.array([getattr(state, n) for state in states], dtype=float)
            for n in (*LEAST, "tilt")
        }
        for name, states in health.items()
    }
    # each number against the sensor's own first trips
    changes: dict[str, Numbers] = {name: {} for name in names}
    for name in names:
        for number, column in values[name].items():
            scaled = np.log(column) if number == "noise" else column
            changes[name][number] = scaled - _of_first(scaled, since[name], np.median)
    # what sensors share is not theirs: the track's roughness is in all noise, a worn part or the
    # speed in the gains of both sides
    _subtract_common([changes[name] for name in names], "noise")
    groups = [[name for name in names if name.split()[0] in places] for places in TOGETHER]
    for group in groups:
        for number in MISLEADING:
            _subtract_common([changes[name] for name in group], number)
        # noise in one sensor hides the gains of its fellows
        noisy = np.any([changes[name]["noise"] > LEAST["noise"] for name in group], axis=0)
        for name in group:
            for number in MISLEADING:
                changes[name][number] = np.where(noisy, np.nan, changes[name][number])
    return [_trend(name, values[name], changes[name], since[name], groups) for name in names]


def _eras(
    name: str, names: Sequence[str], km: FloatArray, replaced: Sequence[tuple[float, str]]
) -> IntArray:
    """Return how often a sensor had been replaced before each trip, (n_trips,)."""
    replaced_km = [
        at for at, words in replaced if name in words or not any(n in words for n in names)
    ]
    return np.asarray(
        np.searchsorted(np.sort(replaced_km), np.nan_to_num(km, nan=np.inf), side="right")
    )


def _of_first(
    column: FloatArray, eras: IntArray, number: Callable[[FloatArray], Any]
) -> FloatArray:
    """Return a number of the first trips of each era for all its trips; NaN if they are few."""
    numbers = np.full_like(column, np.nan)
    for era in np.unique(eras):
        first = np.flatnonzero((eras == era) & np.isfinite(column))[:N_FIRST]
        if len(first) == N_FIRST:
            numbers[eras == era] = number(column[first])
    return numbers


def _subtract_common(sensors: Sequence[Numbers], number: str) -> None:
    """Subtract the median over some sensors from their changes; of noise only a common rise."""
    if len(sensors) < 2:
        return
    rows = np.stack([changes[number] for changes in sensors])
    has_any = np.isfinite(rows).any(axis=0)
    common = np.zeros(rows.shape[1])
    common[has_any] = np.nanmedian(rows[:, has_any], axis=0)
    if number == "noise":
        common = np.maximum(common, 0)
    for changes in sensors:
        changes[number] = changes[number] - common


def _trend(
    name: str, values: Numbers, changes: Numbers, eras: IntArray, groups: Sequence[Sequence[str]]
) -> SensorTrend:
    beyond, far = {}, np.zeros(len(eras), dtype=np.bool_)
    with np.errstate(invalid="ignore"):  # NaN is never beyond
        of_sensor = np.abs(changes["tilt"]) <= FLAT * np.abs(changes["gain"])
        for number, least in LEAST.items():
            # noise and drop-outs only count when they grow
            size = changes[number] if number in ("noise", "faulty") else np.abs(changes[number])
            limit = np.maximum(least, SPREADS * _of_first(changes[number], eras, np.std))
            counts = of_sensor if number == "gain" else np.isfinite(size)
            beyond[number] = counts & (size > limit)
            if number in MISLEADING:
                far |= counts & (size > FAR * limit)
    is_out = np.logical_or.reduce(list(beyond.values()))
    active = _active(is_out, np.isfinite(values["faulty"]))
    misleads = far | active & np.logical_or.reduce([beyond[number] for number in MISLEADING])
    group = next((group for group in groups if name in group), [name])
    fellow = next(other for other in group if other != name) if len(group) == 2 else ""
    return SensorTrend(name, values, changes, beyond, active, misleads, fellow)


def _active(is_out: BoolArray, is_known: BoolArray) -> BoolArray:
    """Return the trips with an alarm, raised and cleared by ``IN_A_ROW`` ones in a row."""
    active, run, state = np.zeros(len(is_out), dtype=np.bool_), 0, False
    for trip in range(len(is_out)):
        if is_known[trip]:
            run = run + 1 if is_out[trip] != state else 0
        if run == IN_A_ROW:
            state, run = not state, 0
        active[trip] = state
    return active
