"""The API: the fleet as JSON for maintenance systems, and acknowledgements by programs."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, TypeVar

import numpy as np
from flask import Blueprint, Response, abort, request
from pydantic import BaseModel, ValidationError
from werkzeug.exceptions import HTTPException, UnsupportedMediaType

from suspnet.ground.findings import as_plain, together
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, NAMES, Severity, part_words
from suspnet.ground.storage import finite_or_none
from suspnet.maintenance.alarms import newest_of
from suspnet.maintenance.relative import relative_results
from suspnet.maintenance.state import State
from suspnet.report.overview import FleetView
from suspnet.report.work_order import all_work_orders, work_orders
from suspnet.web import api_models as models
from suspnet.web import pages
from suspnet.web.access import identify_program, visitor
from suspnet.web.api_description import Route, description
from suspnet.web.page_values import Choice

ROOT = "/api/v1"
api = Blueprint("api", __name__, url_prefix=ROOT)
api.before_request(identify_program)
ROUTES: list[Route] = []
"""What the API answers, in the order of its description."""
Query = TypeVar("Query", bound=BaseModel)
Handler = Callable[..., tuple[dict[str, Any], int]]


def _answers(
    rule: str,
    query: type[BaseModel],
    answer: type[BaseModel],
    *,
    body: type[BaseModel] | None = None,
) -> Callable[[Handler], Handler]:
    """Register a function as what the API answers to `rule`, and describe it."""

    def register(function: Handler) -> Handler:
        @functools.wraps(function)
        def answered(**where: str) -> Response:
            given: BaseModel = _query(query) if body is None else _body(query, body)
            content, status = function(given, **where)
            return _sent(answer.model_validate(content), status)

        method = "GET" if body is None else "POST"
        api.add_url_rule(rule, function.__name__, answered, methods=[method])
        words = (function.__doc__ or "").strip()
        ROUTES.append(Route(rule, method, function.__name__, words, query, answer, body))
        return function

    return register


@api.get("/openapi.json")
def openapi() -> dict[str, Any]:
    """Return the description of the API."""
    return description(ROOT, ROUTES, request.script_root or "/")


@_answers("/suspensions", models.OfFleet, models.Suspensions)
def suspensions(query: models.OfFleet) -> tuple[dict[str, Any], int]:
    """List the suspensions, the worst first."""
    view = _read_view()
    return _listed(view, query, _chosen(view, query), lambda i: _suspension(view, i)), 200


@_answers("/suspensions/<id>", models.Nothing, models.SuspensionAnswer)
def suspension(query: models.Nothing, id: str) -> tuple[dict[str, Any], int]:
    """Give one suspension."""
    view = _read_view()
    return _suspension(view, _index(view, id)), 200


@_answers("/suspensions/<id>/parts", models.Paged, models.Parts)
def parts(query: models.Paged, id: str) -> tuple[dict[str, Any], int]:
    """List the parameters of a suspension, or the parts of its bogie where each is read."""
    view = _read_view()
    state = view.states[_index(view, id)]
    found = [one for one in state.assessments if one.parameter != BODY_MASS]
    return _listed(view, query, found, lambda one: _part(state, one)), 200


@_answers("/suspensions/<id>/trips", models.OfTrips, models.Trips)
def trips(query: models.OfTrips, id: str) -> tuple[dict[str, Any], int]:
    """List the trips of a suspension by mileage."""
    view = _read_view()
    state = view.states[_index(view, id)]
    with pages.opened() as store:
        results = store.read(*state.key)
    low = -np.inf if query.from_km is None else query.from_km
    high = np.inf if query.to_km is None else query.to_km
    is_all = query.from_km is None and query.to_km is None  # also those without a mileage
    n_first = pages.current_refresher().board.settings.n_first
    results = relative_results(results, state.series.events, n_first)
    chosen = [one for one in results if is_all or low <= one.mileage_km <= high]
    return _listed(view, query, chosen, _trip), 200


@_answers("/suspensions/<id>/work-orders", models.Paged, models.WorkOrders)
def orders_of_suspension(query: models.Paged, id: str) -> tuple[dict[str, Any], int]:
    """List the work orders of a suspension."""
    view = _read_view()
    return _listed(view, query, work_orders(view, _index(view, id)), asdict), 200


@_answers("/alarms", models.OfAlarms, models.Alarms)
def alarms(query: models.OfAlarms) -> tuple[dict[str, Any], int]:
    """List alarms, active ones first, then the worst."""
    view = _read_view()
    found = [
        _alarm(view, i, alarm)
        for i, state in enumerate(view.states)
        if query.train is None or state.series.place.train == query.train
        for alarm in state.watched.alarms
    ]
    wanted = {
        "severity": query.severity,
        "active": _switch(query.active),
        "is_seen": _switch(query.acknowledged),
    }
    found = [
        one
        for one in found
        if all(one[k] == value for k, value in wanted.items() if value is not None)
    ]
    order = [str(one) for one in sorted(Severity, reverse=True)]
    found.sort(key=lambda one: (not one["active"], order.index(one["severity"])))
    return _listed(view, query, found, lambda one: {k: one[k] for k in one if k != "is_seen"}), 200


@_answers("/plan", models.OfFleet, models.Jobs)
def plan(query: models.OfFleet) -> tuple[dict[str, Any], int]:
    """List the jobs of the plan: unknown parts first, then visits, then parts that wait."""
    view = _read_view()
    rows = view.plan.rows() if view.plan else []
    found = [
        row
        for row in rows
        if (query.train is None or row["train"] == query.train)
        and query.severity in (None, row["severity"])
    ]
    return _listed(view, query, found, _job), 200


@_answers("/work-orders", models.OfFleet, models.WorkOrders)
def all_orders(query: models.OfFleet) -> tuple[dict[str, Any], int]:
    """List the work orders of the fleet, those of the worst suspensions first."""
    view = _read_view()
    found = [
        one
        for one in all_work_orders(view)
        if query.train in (None, one.train) and query.severity in (None, one.severity)
    ]
    return _listed(view, query, found, asdict), 200


@_answers(
    "/suspensions/<id>/acknowledgements",
    models.Nothing,
    models.AcknowledgementAnswer,
    body=models.AcknowledgementRequest,
)
def acknowledge(given: models.AcknowledgementRequest, id: str) -> tuple[dict[str, Any], int]:
    """Acknowledge an active alarm, with the token of programs."""
    view = _read_view()
    state = view.states[_index(view, id)]
    same = [
        one for one in state.alarms if (one.parameter, one.cause) == (given.parameter, given.cause)
    ]
    if not same:
        abort(409, f"No alarm of {given.parameter} with the cause {given.cause} is active.")
    seen = Severity[given.severity.upper()]
    if same[0].severity > seen:
        abort(409, f"This alarm is {same[0].severity!s} by now, not {given.severity}.")
    (stored,) = pages.store_acknowledgement(state, same[:1], given.by.strip(), given.words.strip())
    return asdict(stored) | {"severity": str(stored.severity), "cause": str(stored.cause)}, 201


def problem(code: int, title: str, detail: str) -> Response:
    """Return an answer that states why a request was not answered."""
    found = _sent(models.Problem(status=code, title=title, detail=detail), code)
    found.headers.pop("ETag", None)
    if code == 401:
        found.headers["WWW-Authenticate"] = 'Bearer realm="suspnet"'
    if code == 503:
        found.headers["Retry-After"] = "10"
    return found


def http_problem(error: HTTPException) -> Response:
    """Return an HTTP error as an answer of the API."""
    found = problem(error.code or 500, error.name, error.description or error.name)
    allowed = error.get_response().headers.get("Allow")  # of 405
    if allowed:
        found.headers["Allow"] = allowed
    return found


def _sent(content: BaseModel, status: int) -> Response:
    text = content.model_dump_json()
    found = Response(text, status, mimetype="application/json")
    if request.method in ("GET", "HEAD") and status == 200:
        found.headers["Cache-Control"] = "no-cache"  # kept, but asked for each time
        # weak: when the store was read is not part of what has changed
        state = content.model_dump_json(exclude={"read_at"})
        found.set_etag(hashlib.sha256(state.encode()).hexdigest()[:32], weak=True)
        found.make_conditional(request)
    return found


def _query(model: type[Query]) -> Query:
    given = {}
    for name, values in request.args.lists():
        if len(values) > 1:
            abort(400, f"{name} is given {len(values)} times.")
        given[name] = values[0]
    try:
        return model.model_validate(given)
    except ValidationError as error:
        abort(400, _words(error))


def _body(query: type[BaseModel], model: type[Query]) -> Query:
    """Return the body of a request with a token; abort with 401 or 403 if it has none."""
    if not pages.current_access().token:
        abort(403, "No token of programs is configured: start suspnet-serve with token_file=FILE.")
    if not visitor().has_token:
        abort(401, "Acknowledging needs a token: send Authorization: Bearer TOKEN.")
    _query(query)
    if request.mimetype != "application/json":
        raise UnsupportedMediaType("Send the acknowledgement as application/json.")
    try:
        return model.model_validate_json(request.get_data())
    except ValidationError as error:
        abort(400, _words(error))


def _words(error: ValidationError) -> str:
    found = [
        f"{'.'.join(map(str, one['loc'])) or 'the body'}: {one['msg']}"
        for one in error.errors(include_url=False, include_input=False, include_context=False)
    ]
    return "; ".join(found[:5]) + "."


def _read_view() -> FleetView:
    view = pages.current_view()
    if not view.version or (view.trouble and not view.states):
        abort(
            503, pages.current_refresher().fault or "The history is being read for the first time."
        )
    return view


def _index(view: FleetView, id: str) -> int:
    if id not in view.keys:
        abort(404, "There is no such suspension in this history.")
    return view.keys[id]


def _chosen(view: FleetView, query: models.OfFleet) -> list[int]:
    choice = Choice(query.train or "", query.severity or "")
    return [i for i, state in enumerate(view.states) if choice.holds(state)]


def _switch(text: str | None) -> bool | None:
    return None if text is None else text == "true"


def _listed(
    view: FleetView, query: models.Paged, found: Sequence[Any], item: Callable[[Any], Any]
) -> dict[str, Any]:
    """Return the requested part of a list, of which `item` makes each entry."""
    end = query.offset + query.limit
    return {
        "read_at": pages.current_refresher().read_at.isoformat(timespec="seconds"),
        "complete": view.is_complete,
        "fault": pages.current_refresher().fault,
        "total": len(found),
        "next_offset": end if end < len(found) else None,
        "items": [item(one) for one in found[query.offset : end]],
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
        "parameters": [one for one in row["parameter"].split(", ") if one],
    }


def _part(state: State, assessment: Any) -> dict[str, Any]:
    name = assessment.parameter
    limits, life = state.limits.get(name), state.lives.get(name)
    low, high = life.interval_km() if life else (np.inf, np.inf)

    def percent(ends: tuple[float, float]) -> list[float]:
        return [round(100 * one, 6) for one in ends]

    return {
        "parameter": name,
        "part": part_words(name) if name in BOGIE_PARTS else NAMES[name],
        "severity": str(assessment.severity),
        "reason": assessment.words,
        "findings": as_plain(assessment.words),
        "value_percent": finite_or_none(100 * state.now(name)),
        "notice_percent": percent(limits.notice) if limits else None,
        "act_percent": percent(limits.act) if limits else None,
        "life_low_km": finite_or_none(low),
        "life_median_km": finite_or_none(life.quantile_km(0.5)) if life else None,
        "life_high_km": finite_or_none(high),
        "life_unknown": state.unknown.get(name, ""),
    }


def _alarm(view: FleetView, index: int, alarm: Any) -> dict[str, Any]:
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
        "is_seen": seen is not None,
    }


def _trip(one: Any) -> dict[str, Any]:
    texts = ("trip", "start", "status", "reason", "flags", "worn")
    numbers = {
        "mileage_km": one.mileage_km,
        "speed_m_per_s": one.quality.speed_m_per_s,
        "temperature_c": one.temperature_c,
    }
    return {
        **{name: getattr(one, name) for name in texts},
        "findings": as_plain(together((one.reason, one.flags, one.worn))),
        **{name: finite_or_none(value) for name, value in numbers.items()},
        "estimates": {k: v for k, v in one.estimates.items() if np.isfinite(v)},
        "half_widths": {k: v for k, v in one.half_widths.items() if np.isfinite(v)},
    }


def _job(row: dict[str, Any]) -> dict[str, Any]:
    texts = ("train", "car", "suspension", "parameter", "part", "what", "urgency", "severity")
    return {
        **{name: row[name] for name in (*texts, "unknown")},
        **{name: row[name] or None for name in ("day", "latest", "decide_by")},
        "mileage_km": finite_or_none(row["mileage_km"]),
        "probability": finite_or_none(row["probability"]),
    }
