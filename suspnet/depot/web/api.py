"""The API: the fleet as JSON for maintenance systems, and acknowledgements by programs."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any, TypeVar

import numpy as np
from flask import Blueprint, Response, abort, request
from pydantic import BaseModel, ValidationError
from werkzeug.exceptions import HTTPException, UnsupportedMediaType

from suspnet.depot.web import api_models as models
from suspnet.depot.web.access import current_access, identify_program, visitor
from suspnet.depot.web.api_description import Route, description
from suspnet.depot.web.service import current_service
from suspnet.ground.findings import as_plain, together
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, NAMES, Severity, part_words
from suspnet.ground.records import TripResult
from suspnet.ground.storage import finite_or_none
from suspnet.trains.maintenance.alarms import Alarm, newest_of
from suspnet.trains.maintenance.assessment import Assessment
from suspnet.trains.maintenance.life import Life
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.overview import FleetView
from suspnet.trains.pages.work_order import WorkOrder, all_work_orders, work_orders

ROOT = "/api/v1"
api = Blueprint("api", __name__, url_prefix=ROOT)
api.before_request(identify_program)
ROUTES: list[Route] = []  # what the API answers, in the order of its description
Query = TypeVar("Query", bound=BaseModel)
Handler = Callable[..., tuple[dict[str, Any], int]]


def _answers(
    rule: str, query: type[BaseModel], answer: Any, *, body: type[BaseModel] | None = None
) -> Callable[[Handler], Handler]:
    """Register a function as what the API answers to `rule`, and describe it."""

    def register(function: Handler) -> Handler:
        @functools.wraps(function)
        def answered(**place: str) -> Response:
            content = _query(query) if body is None else _body(query, body)
            values, status = function(content, **place)
            return _sent(answer.model_validate(values), status)

        methods = ["GET" if body is None else "POST"]
        api.add_url_rule(rule, function.__name__, answered, methods=methods)
        summary = (function.__doc__ or "").strip()
        ROUTES.append(Route(rule, function.__name__, summary, query, answer, body))
        return function

    return register


@api.get("/openapi.json")
def openapi() -> dict[str, Any]:
    """Return the description of the API."""
    return description(ROOT, ROUTES, request.script_root or "/")


@_answers("/suspensions", models.OfFleet, models.Listed[models.SuspensionAnswer])
def suspensions(query: models.OfFleet) -> tuple[dict[str, Any], int]:
    """List the suspensions, the worst first."""
    view = _read_view()
    rows = (
        _suspension(view, i)
        for i, state in enumerate(view.states)
        if query.train in (None, state.series.place.train)
        and query.severity in (None, str(state.severity))
    )
    return _listed(query, rows), 200


@_answers("/suspensions/<id>", models.Model, models.SuspensionAnswer)
def suspension(query: models.Model, id: str) -> tuple[dict[str, Any], int]:
    """Give one suspension."""
    view = _read_view()
    return _suspension(view, _index(view, id)), 200


@_answers("/suspensions/<id>/parts", models.Paged, models.Listed[models.PartAnswer])
def parts(query: models.Paged, id: str) -> tuple[dict[str, Any], int]:
    """List the parameters of a suspension, or the parts of its bogie where each is read."""
    view = _read_view()
    state = view.states[_index(view, id)]
    rows = (_part(state, own) for own in state.assessments if own.parameter != BODY_MASS)
    return _listed(query, rows), 200


@_answers("/suspensions/<id>/trips", models.OfTrips, models.Listed[models.TripAnswer])
def trips(query: models.OfTrips, id: str) -> tuple[dict[str, Any], int]:
    """List the trips of a suspension by mileage."""
    view, service = _read_view(), current_service()
    with service.opened() as store:
        results = service.trips(store, view.states[_index(view, id)])
    low = -np.inf if query.from_km is None else query.from_km
    high = np.inf if query.to_km is None else query.to_km
    is_all = query.from_km is None and query.to_km is None  # also those without a mileage
    rows = (_trip(result) for result in results if is_all or low <= result.mileage_km <= high)
    return _listed(query, rows), 200


@_answers("/suspensions/<id>/work-orders", models.Paged, models.Listed[WorkOrder])
def orders_of_suspension(query: models.Paged, id: str) -> tuple[dict[str, Any], int]:
    """List the work orders of a suspension."""
    view = _read_view()
    return _listed(query, map(asdict, work_orders(view, _index(view, id)))), 200


@_answers("/alarms", models.OfAlarms, models.Listed[models.AlarmAnswer])
def alarms(query: models.OfAlarms) -> tuple[dict[str, Any], int]:
    """List alarms, active ones first, then the worst."""
    view = _read_view()
    rows = [
        _alarm(view, i, alarm)
        for i, state in enumerate(view.states)
        if query.train in (None, state.series.place.train)
        for alarm in state.watched.alarms
        if query.severity in (None, str(alarm.severity))
        and query.active in (None, _flag(alarm.is_open))
    ]
    by_severity = [str(severity) for severity in sorted(Severity, reverse=True)]
    rows.sort(key=lambda row: (not row["active"], by_severity.index(row["severity"])))
    if query.acknowledged is not None:
        rows = [r for r in rows if query.acknowledged == _flag(r["acknowledged_at"] is not None)]
    return _listed(query, rows), 200


@_answers("/plan", models.OfFleet, models.Listed[models.JobAnswer])
def plan(query: models.OfFleet) -> tuple[dict[str, Any], int]:
    """List the jobs of the plan: unknown parts first, then visits, then parts that wait."""
    view = _read_view()
    rows = (
        _job(row)
        for row in (view.plan.rows() if view.plan else [])
        if query.train in (None, row["train"]) and query.severity in (None, row["severity"])
    )
    return _listed(query, rows), 200


@_answers("/work-orders", models.OfFleet, models.Listed[WorkOrder])
def all_orders(query: models.OfFleet) -> tuple[dict[str, Any], int]:
    """List the work orders of the fleet, those of the worst suspensions first."""
    rows = (
        asdict(order)
        for order in all_work_orders(_read_view())
        if query.train in (None, order.train) and query.severity in (None, order.severity)
    )
    return _listed(query, rows), 200


@_answers(
    "/suspensions/<id>/acknowledgements",
    models.Model,
    models.AcknowledgementAnswer,
    body=models.AcknowledgementRequest,
)
def acknowledge(content: models.AcknowledgementRequest, id: str) -> tuple[dict[str, Any], int]:
    """Acknowledge an active alarm, with the token of programs."""
    view = _read_view()
    state = view.states[_index(view, id)]
    same = [
        alarm
        for alarm in state.alarms
        if (alarm.parameter, alarm.cause) == (content.parameter, content.cause)
    ]
    if not same:
        abort(409, f"No alarm of {content.parameter} with the cause {content.cause} is active.")
    if same[0].severity > Severity[content.severity.upper()]:
        abort(409, f"This alarm is {same[0].severity!s} by now, not {content.severity}.")
    by, words = content.by.strip(), content.words.strip()
    (stored,) = current_service().acknowledge(state, same[:1], by, words)
    return asdict(stored) | {"severity": str(stored.severity), "cause": str(stored.cause)}, 201


def problem(code: int, title: str, detail: str) -> Response:
    """Return an answer that states why a request was not answered."""
    response = _sent(models.Problem(status=code, title=title, detail=detail), code)
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


def _sent(content: BaseModel, status: int) -> Response:
    response = Response(content.model_dump_json(), status, mimetype="application/json")
    if request.method in ("GET", "HEAD") and status == 200:
        response.headers["Cache-Control"] = "no-cache"  # stored, but asked for each time
        # weak: when the store was read is not part of what has changed
        state = content.model_dump_json(exclude={"read_at"})
        response.set_etag(hashlib.sha256(state.encode()).hexdigest()[:32], weak=True)
        response.make_conditional(request)
    return response


def _query(model: type[Query]) -> Query:
    values = {}
    for name, several in request.args.lists():
        if len(several) > 1:
            abort(400, f"{name} is given {len(several)} times.")
        values[name] = several[0]
    return _validated(model.model_validate, values)


def _body(query: type[BaseModel], model: type[Query]) -> Query:
    """Return the body of a request with a token; abort with 401 or 403 if it has none."""
    if not current_access().token:
        abort(
            403,
            "No token of programs is configured: SUSPNET_API_TOKEN_FILE=FILE names it.",
        )
    if not visitor().has_token:
        abort(401, "Acknowledging needs a token: send Authorization: Bearer TOKEN.")
    _query(query)
    if request.mimetype != "application/json":
        raise UnsupportedMediaType("Send the acknowledgement as application/json.")
    return _validated(model.model_validate_json, request.get_data())


def _validated(validate: Callable[[Any], Query], content: Any) -> Query:
    """Return a request's content; abort with 400 and its first mistakes if it is not valid."""
    try:
        return validate(content)
    except ValidationError as error:
        mistakes = [
            f"{'.'.join(map(str, mistake['loc'])) or 'the body'}: {mistake['msg']}"
            for mistake in error.errors(include_url=False, include_input=False)
        ]
        abort(400, "; ".join(mistakes[:5]) + ".")


def _read_view() -> FleetView:
    view, fault = current_service().view, current_service().refresher.fault
    if not view.version or (view.trouble and not view.states):
        abort(503, fault or "The history is being read for the first time.")
    return view


def _index(view: FleetView, id: str) -> int:
    if id not in view.keys:
        abort(404, "There is no such suspension in this history.")
    return view.keys[id]


def _flag(value: bool) -> str:
    return "true" if value else "false"


def _listed(query: models.Paged, rows: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return the requested rows of a list."""
    every, end = list(rows), query.offset + query.limit
    service = current_service()
    return {
        "read_at": service.refresher.read_at.isoformat(timespec="seconds"),
        "complete": service.view.is_complete,
        "fault": service.refresher.fault,
        "total": len(every),
        "next_offset": end if end < len(every) else None,
        "items": every[query.offset : end],
    }


def _place(view: FleetView, index: int) -> dict[str, Any]:
    vehicle, place = view.states[index].key
    return {"id": view.names[index], "vehicle": vehicle, **asdict(place)}


def _suspension(view: FleetView, index: int) -> dict[str, Any]:
    row = view.rows[index]
    texts = ("severity", "reason", "sensors", "n_alarms", "life_parameter")
    counts = ("n_trips", "n_estimated", "n_flagged")
    numbers = ("life_low_km", "life_median_km", "life_high_km", "last_mileage_km")
    return {
        **_place(view, index),
        **{name: row[name] for name in (*texts, *counts)},
        "findings": as_plain(row["reason"]),
        **{name: finite_or_none(row[name]) for name in numbers},
        "parameters": [name for name in row["parameter"].split(", ") if name],
    }


def _part(state: State, assessment: Assessment) -> dict[str, Any]:
    name = assessment.parameter
    limits = state.limits.get(name)

    def percent(ends: tuple[float, float]) -> list[float]:
        return [round(100 * end, 6) for end in ends]

    return {
        "parameter": name,
        "part": part_words(name) if name in BOGIE_PARTS else NAMES[name],
        "severity": str(assessment.severity),
        "reason": assessment.words,
        "findings": as_plain(assessment.words),
        "value_percent": finite_or_none(100 * state.now(name)),
        "notice_percent": percent(limits.notice) if limits else None,
        "act_percent": percent(limits.act) if limits else None,
        **_life(state.lives.get(name)),
        "life_unknown": state.unknown.get(name, ""),
    }


def _life(life: Life | None) -> dict[str, float | None]:
    low, median, high = np.inf, np.inf, np.inf
    if life is not None:
        (low, high), median = life.interval_km(), life.quantile_km(0.5)
    ends = {"life_low_km": low, "life_median_km": median, "life_high_km": high}
    return {name: finite_or_none(km) for name, km in ends.items()}


def _alarm(view: FleetView, index: int, alarm: Alarm) -> dict[str, Any]:
    seen = newest_of(alarm, view.acknowledged.get(view.states[index].key, ()))
    return {
        **_place(view, index),
        "parameter": alarm.parameter,
        "cause": str(alarm.cause),
        "severity": str(alarm.severity),
        "active": alarm.is_open,
        "begin_km": alarm.begin_km,
        "end_km": finite_or_none(alarm.end_km),
        "reason": alarm.words,
        "findings": as_plain(alarm.words),
        "acknowledged_by": seen.by if seen else "",
        "acknowledged_at": seen.at if seen else None,
        "action": seen.words if seen else "",
    }


def _trip(result: TripResult) -> dict[str, Any]:
    texts = ("trip", "start", "status", "reason", "flags", "worn")
    numbers = {
        "mileage_km": result.mileage_km,
        "speed_m_per_s": result.quality.speed_m_per_s,
        "temperature_c": result.temperature_c,
    }
    return {
        **{name: getattr(result, name) for name in texts},
        "findings": as_plain(together((result.reason, result.flags, result.worn))),
        **{name: finite_or_none(value) for name, value in numbers.items()},
        "estimates": {k: v for k, v in result.estimates.items() if np.isfinite(v)},
        "half_widths": {k: v for k, v in result.half_widths.items() if np.isfinite(v)},
    }


def _job(row: dict[str, Any]) -> dict[str, Any]:
    texts = ("train", "car", "suspension", "parameter", "part", "what", "urgency", "severity")
    return {
        **{name: row[name] for name in (*texts, "unknown")},
        **{name: row[name] or None for name in ("day", "decide_by")},
        "mileage_km": finite_or_none(row["mileage_km"]),
        "probability": finite_or_none(row["probability"]),
    }
