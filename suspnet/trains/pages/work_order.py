"""Work orders: what a depot has to do on a part, why, since when, how surely and until when."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import BODY_MASS, KIND_NAMES, Cause, Severity, part_words
from suspnet.ground.storage import content_hash, finite_or_none
from suspnet.trains.maintenance.alarms import Alarm, newest_of
from suspnet.trains.maintenance.plan import place_of
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.bogie import bogie_of
from suspnet.trains.pages.overview import ID_DIGITS, FleetView

INSPECT = "inspect"  # work on a part with an alarm that the plan has no visit for, and on a sensor


@dataclass(frozen=True)
class WorkOrder:
    """Work on one part of a suspension, or on one of its sensors.

    A number that is unknown, or a date that is not fixed, is None; a text is then empty. Days are
    in ISO 8601, values in % of healthy.
    """

    number: str  # the same for as long as the same alarm is active
    suspension: str  # its name in addresses
    vehicle: str
    train: str
    car: str
    position: str  # the manifest's name of the suspension
    bogie: str
    side: str
    parameter: str
    part: str  # as a depot calls it
    work: str  # replace or inspect
    severity: str
    why: str
    since_km: float | None = None  # where the oldest active alarm starts
    since: str | None = None  # the day of that trip
    value_percent: float | None = None  # median of the last trips
    low_percent: float | None = None  # of the ends of the intervals of those without a flag
    high_percent: float | None = None
    n_alike: int = 0  # of the last trips, on the same side of 100 % with all of their interval
    n_last: int = 0
    odds: str = ""  # of the verdict that this part is worn
    group: str = ""  # other parts that may be the worn one instead, as a sentence
    doubt: str = ""  # why limits or remaining life are unknown
    visit: str | None = None  # latest day of the planned visit
    decide_by: str | None = None
    is_passed: bool = False  # whether the act limit is passed already
    until_km: float | None = None  # passed before this mileage with a probability of 10 %
    median_km: float | None = None  # and with one of 50 %
    failure_percent: float | None = None  # probability that it is passed before the visit
    acknowledged_by: str = ""
    acknowledged_at: str | None = None
    action: str = ""  # what that person is doing


def all_work_orders(view: FleetView) -> list[WorkOrder]:
    """Return the work orders of a fleet, in the order of its states: the most severe first."""
    jobs = _jobs(view)
    return [order for index in range(len(view.states)) for order in _orders(view, index, jobs)]


def work_orders(view: FleetView, index: int) -> list[WorkOrder]:
    """Return the work orders of the suspension of a view's state, the most severe first.

    There is one for each parameter or part whose severity is notice or act, each sensor with an
    active alarm, and each part that the plan has a visit for.
    """
    return _orders(view, index, _jobs(view))


Jobs = dict[tuple[str, str, str, str], dict[str, Any]]
"""Rows of the plan's visits by train, car, suspension and parameter."""


def _jobs(view: FleetView) -> Jobs:
    rows = view.plan.rows() if view.plan else []
    return {
        (row["train"], row["car"], row["suspension"], row["parameter"]): row
        for row in rows
        if row["day"]
    }


def _orders(view: FleetView, index: int, jobs: Jobs) -> list[WorkOrder]:
    state = view.states[index]
    place = place_of(state)
    due = {
        name: job
        for name in state.outputs
        if name != BODY_MASS and (job := jobs.get((*place, name)))
    }
    severities = {own.parameter: own.severity for own in state.assessments}
    severities.pop(BODY_MASS, None)
    named = [name for name, level in severities.items() if level >= Severity.NOTICE or name in due]
    named.sort(key=lambda name: -severities[name])
    sensors = [alarm for alarm in state.alarms if alarm.cause == Cause.SENSOR]
    return [
        *(_of_part(view, index, name, due.get(name, {})) for name in named),
        *(_of_sensor(view, index, alarm) for alarm in sensors),
    ]


def _of_part(view: FleetView, index: int, name: str, job: dict[str, Any]) -> WorkOrder:
    state = view.states[index]
    (assessment,) = (own for own in state.assessments if own.parameter == name)
    alarms = state.alarms_of(name)
    drawn = bogie.parts.get(name) if (bogie := bogie_of(state)) else None
    groups = [bogie.groups[letter] for letter in drawn.group.split()] if bogie and drawn else []
    life = state.lives.get(name)
    unknown = state.unknown.get(name, "")
    return WorkOrder(
        **_shared(view, index, name, alarms),
        part=part_words(name) if drawn else KIND_NAMES.get(name, name),
        work=job["what"] if job.get("what") in ("replace", INSPECT) else INSPECT,
        severity=str(assessment.severity),
        why=assessment.words,
        **_level(state, name),
        odds=drawn.odds if drawn else "",
        group=together(groups),
        doubt=together((state.doubt, unknown and Finding("remaining-life", unknown=unknown))),
        visit=job.get("day") or None,
        decide_by=job.get("decide_by") or None,
        is_passed=life is not None and life.interval_km()[1] == 0,
        until_km=finite_or_none(state.last_km + life.quantile_km(0.1)) if life else None,
        median_km=finite_or_none(state.last_km + life.quantile_km(0.5)) if life else None,
        failure_percent=finite_or_none(100 * job["probability"]) if job else None,
    )


def _of_sensor(view: FleetView, index: int, alarm: Alarm) -> WorkOrder:
    return WorkOrder(
        **_shared(view, index, alarm.parameter, [alarm]),
        part=Finding("order-for-sensor", name=alarm.parameter),
        work=INSPECT,
        severity=str(alarm.severity),
        why=alarm.words,
    )


def _shared(view: FleetView, index: int, name: str, alarms: list[Alarm]) -> dict[str, Any]:
    """Return the fields of an order that parts and sensors have in common."""
    state, key = view.states[index], view.states[index].key
    place = key[1]
    since_km = min((alarm.begin_km for alarm in alarms), default=None)
    worst = max(alarms, key=lambda alarm: alarm.severity, default=None)
    seen = worst and newest_of(worst, view.acknowledged.get(key, ()))
    return {
        "number": content_hash([key[0], *astuple(place), name, since_km])[:ID_DIGITS],
        "suspension": view.names[index],
        "vehicle": key[0],
        "train": place.train,
        "car": place.car,
        "position": place.suspension,
        "bogie": place.bogie,
        "side": place.side,
        "parameter": name,
        "since_km": since_km,
        "since": None if since_km is None else _day_of(state, since_km),
        "acknowledged_by": seen.by if seen else "",
        "acknowledged_at": seen.at if seen else None,
        "action": seen.words if seen else "",
    }


def _day_of(state: State, km: float) -> str | None:
    """Return the day of the trip at a mileage; None if its start is unknown."""
    at = np.flatnonzero(state.series.mileage_km == km)
    starts = state.series.start[at]
    return str(starts[0].astype("datetime64[D]")) if len(at) and not np.isnat(starts[0]) else None


def _level(state: State, name: str) -> dict[str, Any]:
    last, leading = state.last_of(name), state.leading(name)
    clear, side = ~leading.flagged, np.sign(state.now(name) - 1)
    nearer = np.where(side < 0, last.high, last.low)
    alike = side * (nearer - 1) > 0  # False without an interval
    both = leading.low[clear], leading.high[clear]
    ends = (np.median(end) if clear.any() else math.nan for end in both)
    low, high = (finite_or_none(100 * float(end)) for end in ends)
    return {
        "value_percent": finite_or_none(100 * state.now(name)),
        "low_percent": low,
        "high_percent": high,
        "n_alike": int(alike.sum()),
        "n_last": len(last.values),
    }
