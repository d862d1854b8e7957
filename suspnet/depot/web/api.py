"""The API: the fleet as JSON for maintenance systems."""

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np
from flask import Blueprint, Response, abort
from werkzeug.exceptions import HTTPException

from suspnet.depot.web.access import identify_program
from suspnet.depot.web.service import current_refresher, named_state, opened_store, stored_trips
from suspnet.ground.findings import as_plain, together
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, NAMES, part_words
from suspnet.ground.records import TripResult
from suspnet.ground.storage import json_bytes
from suspnet.trains.maintenance.alarms import Alarm, newest_of
from suspnet.trains.maintenance.assessment import Assessment
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.overview import FleetView

ROOT = "/api/v1"
Row = dict[str, Any]
api = Blueprint("api", __name__, url_prefix=ROOT)
api.before_request(identify_program)


@api.get("/suspensions")
def suspensions() -> Response:
    """Return the suspensions, the worst first: a row of overview.csv each."""
    view = _read_view()
    return _listed(
        row
        | _place(view, i)
        | {
            "findings": as_plain(row["reason"]),
            "parameters": [name for name in row["parameter"].split(", ") if name],
        }
        for i, row in enumerate(view.rows)
    )


@api.get("/suspensions/<name>/parts")
def parts(name: str) -> Response:
    """Return the parameters of a suspension, or the parts of its bogie where each is read."""
    state = _state(name)
    return _listed(_part(state, own) for own in state.assessments if own.parameter != BODY_MASS)


@api.get("/suspensions/<name>/trips")
def trips(name: str) -> Response:
    """Return the trips of a suspension, the newest first."""
    with opened_store() as store:
        return _listed(map(_trip, reversed(stored_trips(store, _state(name)))))


@api.get("/alarms")
def alarms() -> Response:
    """Return the alarms, active ones first, then the worst."""
    view = _read_view()
    found = [(i, alarm) for i, state in enumerate(view.states) for alarm in state.watched.alarms]
    found.sort(key=lambda entry: (not entry[1].is_open, -entry[1].severity))
    return _listed(_alarm(view, i, alarm) for i, alarm in found)


@api.get("/plan")
def plan() -> Response:
    """Return the jobs of the plan: unknown parts first, then visits, then parts that wait."""
    planned = _read_view().plan
    return _listed(planned.rows() if planned else [])


def problem(code: int, title: str, detail: str) -> Response:
    """Return an answer that states why a request was not answered."""
    content = {"status": code, "title": title, "detail": detail}
    response = Response(json_bytes(content), code, mimetype="application/json")
    if code == 401:
        response.headers["WWW-Authenticate"] = 'Bearer realm="suspnet"'
    if code == 503:
        response.headers["Retry-After"] = "10"
    return response


def http_problem(error: HTTPException) -> Response:
    """Return an HTTP error as an answer of the API."""
    response = problem(error.code or 500, error.name, error.description or error.name)
    allowed = error.get_response().headers.get("Allow")  # of 405
    if allowed:
        response.headers["Allow"] = allowed
    return response


def _read_view() -> FleetView:
    refresher = current_refresher()
    view, fault = refresher.board.view, refresher.fault
    if not view.version or (view.trouble and not view.states):
        abort(503, fault or "The history is being read for the first time.")
    return view


def _state(name: str) -> State:
    _read_view()
    return named_state(name)


def _listed(rows: Iterable[Row]) -> Response:
    """Return rows, and how new they are, as JSON; null where a number is unknown or infinite."""
    refresher = current_refresher()
    content = {
        "read_at": refresher.read_at.isoformat(timespec="seconds"),
        "complete": refresher.board.view.is_complete,
        "fault": refresher.fault,
        "items": list(rows),
    }
    return Response(json_bytes(content), mimetype="application/json")


def _place(view: FleetView, index: int) -> Row:
    vehicle, place = view.states[index].key
    return {"id": view.names[index], "vehicle": vehicle, **asdict(place)}


def _part(state: State, assessment: Assessment) -> Row:
    name = assessment.parameter
    limits, life = state.limits.get(name), state.lives.get(name)
    low, high = life.interval_km() if life else (None, None)

    def percent(ends: tuple[float, float]) -> list[float]:
        return [round(100 * end, 6) for end in ends]

    return {
        "parameter": name,
        "part": part_words(name) if name in BOGIE_PARTS else NAMES[name],
        "severity": str(assessment.severity),
        "reason": assessment.words,
        "findings": as_plain(assessment.words),
        "value_percent": 100 * state.now(name),
        "notice_percent": percent(limits.notice) if limits else None,
        "act_percent": percent(limits.act) if limits else None,
        "life_low_km": low,
        "life_median_km": life.quantile_km(0.5) if life else None,
        "life_high_km": high,
        "life_unknown": state.unknown.get(name, ""),
    }


def _alarm(view: FleetView, index: int, alarm: Alarm) -> Row:
    seen = newest_of(alarm, view.acknowledged.get(view.states[index].key, ()))
    return {
        **_place(view, index),
        "parameter": alarm.parameter,
        "cause": str(alarm.cause),
        "severity": str(alarm.severity),
        "active": alarm.is_open,
        "begin_km": alarm.begin_km,
        "end_km": alarm.end_km,
        "reason": alarm.words,
        "findings": as_plain(alarm.words),
        "acknowledged_by": seen.by if seen else "",
        "acknowledged_at": seen.at if seen else None,
        "action": seen.words if seen else "",
    }


def _trip(result: TripResult) -> Row:
    names = ("trip", "start", "mileage_km", "status", "reason", "flags", "worn", "temperature_c")
    return {name: getattr(result, name) for name in names} | {
        "speed_m_per_s": result.quality.speed_m_per_s,
        "findings": as_plain(together((result.reason, result.flags, result.worn))),
        "estimates": {k: v for k, v in result.estimates.items() if np.isfinite(v)},
        "half_widths": {k: v for k, v in result.half_widths.items() if np.isfinite(v)},
    }
