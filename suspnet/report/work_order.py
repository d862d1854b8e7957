"""Work orders: what a depot has to do on a part, why, since when, how surely and until when."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import BODY_MASS, KIND_NAMES, Cause, Severity, part_words
from suspnet.ground.storage import content_hash, finite_or_none
from suspnet.maintenance.alarms import Alarm, newest_of
from suspnet.maintenance.plan import place_of
from suspnet.maintenance.state import State
from suspnet.report.bogie import bogie_of
from suspnet.report.overview import ID_DIGITS, FleetView

INSPECT = "inspect"
"""Work on a part with an alarm that the plan has no visit for, and on a sensor."""


@dataclass(frozen=True)
class WorkOrder:
    """Work on one part of a suspension, or on one of its sensors.

    A number that is unknown, or a date that is not fixed, is None; a text is then empty. Days are
    in ISO 8601.

    Attributes
    ----------
    number : str
        The same for as long as the same alarm is active.
    suspension : str
        Name of the suspension in addresses.
    vehicle, train, car, position, bogie, side : str
        Place as in the manifests; `position` is its name of the suspension.
    parameter, part : str
        Symbol, and the part as a depot calls it.
    work : {"replace", "inspect"}
    severity : {"act", "notice", "unknown", "none"}
    why : str
    since_km : float, [km]
        Mileage where the oldest active alarm starts; `since` is the day of that trip.
    value_percent, low_percent, high_percent : float, [% of healthy]
        Median of the last trips, and of the ends of the intervals of those without a flag.
    n_alike, n_last : int
        How many of the last trips are on the same side of 100 % with all of their interval, and
        how many there are.
    odds : str
        Odds of the verdict that this part is worn; empty without one.
    group : str
        Other parts that may be the worn one instead, as a sentence.
    doubt : str
        Why limits or remaining life are unknown.
    visit, latest, decide_by : str
        Day of the planned visit, the last day at little extra cost, and the last for the decision.
    is_passed : bool
        Whether the act limit is passed already.
    until_km : float, [km]
        Mileage at which the act limit is passed with a probability of 10 %.
    median_km : float, [km]
        Mileage at which it is passed with a probability of 50 %.
    failure_percent : float, [%]
        Probability that it is passed before the visit.
    acknowledged_by, acknowledged_at, action : str
        Newest acknowledgement of the worst alarm, and what its person is doing.
    """

    number: str
    suspension: str
    vehicle: str
    train: str
    car: str
    position: str
    bogie: str
    side: str
    parameter: str
    part: str
    work: str
    severity: str
    why: str
    since_km: float | None = None
    since: str | None = None
    value_percent: float | None = None
    low_percent: float | None = None
    high_percent: float | None = None
    n_alike: int = 0
    n_last: int = 0
    odds: str = ""
    group: str = ""
    doubt: str = ""
    visit: str | None = None
    latest: str | None = None
    decide_by: str | None = None
    is_passed: bool = False
    until_km: float | None = None
    median_km: float | None = None
    failure_percent: float | None = None
    acknowledged_by: str = ""
    acknowledged_at: str | None = None
    action: str = ""


def all_work_orders(view: FleetView) -> list[WorkOrder]:
    """Return the work orders of a fleet, in the order of its states: the most severe first."""
    jobs = _jobs(view)
    return [one for index in range(len(view.states)) for one in _orders(view, index, jobs)]


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
    found = {one.parameter: one for one in state.assessments if one.parameter != BODY_MASS}
    named = [name for name, one in found.items() if one.severity >= Severity.NOTICE or name in due]
    named.sort(key=lambda name: -found[name].severity)
    sensors = [one for one in state.alarms if one.cause == Cause.SENSOR]
    return [
        *(_of_part(view, index, name, due.get(name, {})) for name in named),
        *(_of_sensor(view, index, one) for one in sensors),
    ]


def _of_part(view: FleetView, index: int, name: str, job: dict[str, Any]) -> WorkOrder:
    state = view.states[index]
    (assessment,) = (one for one in state.assessments if one.parameter == name)
    alarms = state.alarms_of(name)
    drawn = bogie.parts.get(name) if (bogie := bogie_of(state)) else None
    groups = [bogie.groups[one] for one in drawn.group.split()] if bogie and drawn else []
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
        latest=job.get("latest") or None,
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
    since_km = min((one.begin_km for one in alarms), default=None)
    worst = max(alarms, key=lambda one: one.severity, default=None)
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
