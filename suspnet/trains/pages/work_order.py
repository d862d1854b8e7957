"""Work orders: what a depot has to do on a part, why, since when, how surely and until when."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import BODY_MASS, KIND_NAMES, Cause, Severity, part_words
from suspnet.ground.storage import content_hash, finite_or_none
from suspnet.trains.maintenance.alarms import Alarm, newest_of
from suspnet.trains.maintenance.assessment import Assessment
from suspnet.trains.maintenance.plan import place_of
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
    return [order for index in range(len(view.states)) for order in work_orders(view, index)]


def work_orders(view: FleetView, index: int) -> list[WorkOrder]:
    """Return the work orders of the suspension of a view's state, the most severe first.

    There is one for each parameter or part whose severity is notice or act, each sensor with an
    active alarm, and each part that the plan has a visit for.
    """
    state = view.states[index]
    jobs = view.jobs.get(place_of(state), {})
    own = [a for a in state.assessments if a.parameter != BODY_MASS]
    due = [a for a in own if a.severity >= Severity.NOTICE or a.parameter in jobs]
    due.sort(key=lambda assessment: -assessment.severity)
    orders = [_of_part(view, index, a, jobs.get(a.parameter, {})) for a in due]
    for alarm in (alarm for alarm in state.alarms if alarm.cause == Cause.SENSOR):
        orders.append(
            WorkOrder(
                **_shared(view, index, alarm.parameter, [alarm]),
                part=Finding("order-for-sensor", name=alarm.parameter),
                work=INSPECT,
                severity=str(alarm.severity),
                why=alarm.words,
            )
        )
    return orders


def _of_part(view: FleetView, index: int, own: Assessment, job: dict[str, Any]) -> WorkOrder:
    state, name = view.states[index], own.parameter
    drawn = bogie.parts.get(name) if (bogie := bogie_of(state)) else None
    groups = [bogie.groups[letter] for letter in drawn.group.split()] if bogie and drawn else []
    life, unknown = state.lives.get(name), state.unknown.get(name, "")
    # the interval is the median of the leading trips without a flag
    last, leading, now = state.last_of(name), state.leading(name), state.now(name)
    clear = ~leading.flagged
    ends = [np.median(end[clear]) if clear.any() else np.nan for end in (leading.low, leading.high)]
    nearer = last.high if now < 1 else last.low
    alike = np.sign(now - 1) * (nearer - 1) > 0  # False without an interval
    return WorkOrder(
        **_shared(view, index, name, state.alarms_of(name)),
        part=part_words(name) if drawn else KIND_NAMES.get(name, name),
        work=job["what"] if job.get("what") == "replace" else INSPECT,
        severity=str(own.severity),
        why=own.words,
        value_percent=finite_or_none(100 * now),
        low_percent=finite_or_none(100 * float(ends[0])),
        high_percent=finite_or_none(100 * float(ends[1])),
        n_alike=int(alike.sum()),
        n_last=len(last.values),
        odds=drawn.odds if drawn else "",
        group=together(groups),
        doubt=together((state.doubt, unknown and Finding("remaining-life", unknown=unknown))),
        visit=job.get("day"),
        decide_by=job.get("decide_by") or None,
        is_passed=life is not None and life.interval_km()[1] == 0,
        until_km=finite_or_none(state.last_km + life.quantile_km(0.1)) if life else None,
        median_km=finite_or_none(state.last_km + life.quantile_km(0.5)) if life else None,
        failure_percent=finite_or_none(100 * job["probability"]) if job else None,
    )


def _shared(view: FleetView, index: int, name: str, alarms: list[Alarm]) -> dict[str, Any]:
    """Return the fields of an order that parts and sensors have in common."""
    state = view.states[index]
    (vehicle, place), series = state.key, state.series
    since_km = min((alarm.begin_km for alarm in alarms), default=None)
    starts = [] if since_km is None else series.start[series.mileage_km == since_km]
    days = [str(start.astype("datetime64[D]")) for start in starts if not np.isnat(start)]
    worst = max(alarms, key=lambda alarm: alarm.severity, default=None)
    seen = worst and newest_of(worst, view.acknowledged.get(state.key, ()))
    return {
        "number": content_hash([vehicle, *astuple(place), name, since_km])[:ID_DIGITS],
        "suspension": view.names[index],
        "vehicle": vehicle,
        "train": place.train,
        "car": place.car,
        "position": place.suspension,
        "bogie": place.bogie,
        "side": place.side,
        "parameter": name,
        "since_km": since_km,
        "since": days[0] if days else None,
        "acknowledged_by": seen.by if seen else "",
        "acknowledged_at": seen.at if seen else None,
        "action": seen.words if seen else "",
    }
