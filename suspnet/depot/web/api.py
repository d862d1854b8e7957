"""The API: the fleet as JSON for maintenance systems, with its description in OpenAPI 3.1."""

import functools
import hashlib
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from http import HTTPStatus
from typing import Any, TypeVar

import numpy as np
from flask import Blueprint, Response, abort, request
from pydantic import BaseModel, ValidationError
from pydantic.json_schema import models_json_schema
from werkzeug.exceptions import HTTPException

from suspnet import __version__
from suspnet.depot.web import api_models as models
from suspnet.depot.web.access import identify_program
from suspnet.depot.web.service import current_refresher, opened_store, stored_trips
from suspnet.ground.findings import as_plain, together
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, NAMES, Severity, part_words
from suspnet.ground.records import TripResult
from suspnet.trains.maintenance.alarms import Alarm, newest_of
from suspnet.trains.maintenance.assessment import Assessment
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.overview import FleetView

ROOT = "/api/v1"
WORDS = (
    "Suspensions of a fleet with their verdicts, parts, alarms, trips and plan. "
    "Estimates are relative to healthy; names of fields end in their unit. No answer is a safety "
    "decision."
)
ERRORS = (400, 401, 403, 503)  # of every request
api = Blueprint("api", __name__, url_prefix=ROOT)
api.before_request(identify_program)
Row = dict[str, Any]
Rows = Callable[..., Iterable[Row]]
Query = TypeVar("Query", bound=BaseModel)


@dataclass(frozen=True)
class Route:
    """One request that the API answers."""

    rule: str
    name: str
    summary: str
    query: type[BaseModel]
    answer: Any


ROUTES: list[Route] = []  # in the order of the description


def _answers(rule: str, query: type[Query], item: Any) -> Callable[[Rows], Rows]:
    """Register a function that gives rows as what the API answers to `rule`.

    The function is given the view of the fleet, the query, and the index of the suspension whose
    name is part of the rule.
    """
    answer = models.Listed[item]

    def register(function: Rows) -> Rows:
        @functools.wraps(function)
        def answered(**place: str) -> Response:
            content, view = _query(query), _read_view()
            rows = function(view, content, *(_index(view, id) for id in place.values()))
            return _sent(answer.model_validate(_listed(content, rows)))

        api.add_url_rule(rule, function.__name__, answered)
        summary = (function.__doc__ or "").strip()
        ROUTES.append(Route(rule, function.__name__, summary, query, answer))
        return function

    return register


@_answers("/suspensions", models.OfFleet, models.SuspensionAnswer)
def suspensions(view: FleetView, query: models.OfFleet) -> Iterable[Row]:
    """List the suspensions, the worst first."""
    return (
        _suspension(view, i)
        for i, state in enumerate(view.states)
        if query.train in (None, state.place.train)
        and query.severity in (None, str(state.severity))
    )


@_answers("/suspensions/<id>/parts", models.Paged, models.PartAnswer)
def parts(view: FleetView, query: models.Paged, index: int) -> Iterable[Row]:
    """List the parameters of a suspension, or the parts of its bogie where each is read."""
    state = view.states[index]
    return (_part(state, own) for own in state.assessments if own.parameter != BODY_MASS)


@_answers("/suspensions/<id>/trips", models.Paged, models.TripAnswer)
def trips(view: FleetView, query: models.Paged, index: int) -> Iterable[Row]:
    """List the trips of a suspension, the newest first."""
    with opened_store() as store:
        return map(_trip, reversed(stored_trips(store, view.states[index])))


@_answers("/alarms", models.OfAlarms, models.AlarmAnswer)
def alarms(view: FleetView, query: models.OfAlarms) -> Iterable[Row]:
    """List alarms, active ones first, then the worst."""
    rows = [
        _alarm(view, i, alarm)
        for i, state in enumerate(view.states)
        if query.train in (None, state.place.train)
        for alarm in state.all_alarms
        if query.severity in (None, str(alarm.severity))
        and query.active in (None, str(alarm.is_open).lower())
    ]
    by_severity = [str(severity) for severity in sorted(Severity, reverse=True)]
    rows.sort(key=lambda row: (not row["active"], by_severity.index(row["severity"])))
    is_seen = query.acknowledged
    return [r for r in rows if is_seen in (None, str(r["acknowledged_at"] is not None).lower())]


@_answers("/plan", models.OfFleet, models.JobAnswer)
def plan(view: FleetView, query: models.OfFleet) -> Iterable[Row]:
    """List the jobs of the plan: unknown parts first, then visits, then parts that wait."""
    return (
        row
        for row in (view.plan.rows() if view.plan else [])
        if query.train in (None, row["train"]) and query.severity in (None, row["severity"])
    )


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


def _sent(content: BaseModel, status: int = 200) -> Response:
    response = Response(content.model_dump_json(), status, mimetype="application/json")
    if status == 200:
        response.headers["Cache-Control"] = "no-cache"  # stored, but asked for each time
        # weak: when the store was read is not part of what has changed
        state = content.model_dump_json(exclude={"read_at"})
        response.set_etag(hashlib.sha256(state.encode()).hexdigest()[:32], weak=True)
        response.make_conditional(request)
    return response


def _query(model: type[Query]) -> Query:
    """Return the query of a request; abort with 400 and its first mistakes if it is not valid."""
    values = {}
    for name, several in request.args.lists():
        if len(several) > 1:
            abort(400, f"{name} is given {len(several)} times.")
        values[name] = several[0]
    try:
        return model.model_validate(values)
    except ValidationError as error:
        mistakes = [
            f"{'.'.join(map(str, mistake['loc']))}: {mistake['msg']}"
            for mistake in error.errors(include_url=False, include_input=False)
        ]
        abort(400, "; ".join(mistakes[:5]) + ".")


def _read_view() -> FleetView:
    refresher = current_refresher()
    view, fault = refresher.board.view, refresher.fault
    if not view.version or (view.trouble and not view.states):
        abort(503, fault or "The history is being read for the first time.")
    return view


def _index(view: FleetView, id: str) -> int:
    if id not in view.keys:
        abort(404, "There is no such suspension in this history.")
    return view.keys[id]


def _listed(query: Any, rows: Iterable[Row]) -> Row:
    """Return the requested rows of a list."""
    every, end = list(rows), query.offset + query.limit
    refresher = current_refresher()
    return {
        "read_at": refresher.read_at.isoformat(timespec="seconds"),
        "complete": refresher.board.view.is_complete,
        "fault": refresher.fault,
        "total": len(every),
        "next_offset": end if end < len(every) else None,
        "items": every[query.offset : end],
    }


def _place(view: FleetView, index: int) -> Row:
    vehicle, place = view.states[index].key
    return {"id": view.names[index], "vehicle": vehicle, **asdict(place)}


def _suspension(view: FleetView, index: int) -> Row:
    row = view.rows[index]
    names = [name for name in row["parameter"].split(", ") if name]
    return {**row, **_place(view, index), "findings": as_plain(row["reason"]), "parameters": names}


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
        **asdict(alarm),
        "cause": str(alarm.cause),
        "severity": str(alarm.severity),
        "active": alarm.is_open,
        "reason": alarm.words,
        "findings": as_plain(alarm.words),
        "acknowledged_by": seen.by if seen else "",
        "acknowledged_at": seen.at if seen else None,
        "action": seen.words if seen else "",
    }


def _trip(result: TripResult) -> Row:
    return {
        **vars(result),
        "speed_m_per_s": result.quality.speed_m_per_s,
        "findings": as_plain(together((result.reason, result.flags, result.worn))),
        "estimates": {k: v for k, v in result.estimates.items() if np.isfinite(v)},
        "half_widths": {k: v for k, v in result.half_widths.items() if np.isfinite(v)},
    }


@api.get("/openapi.json")
def openapi() -> Row:
    """Return the description of the API, made of the types that it takes and gives."""
    answers: Any = [
        (answer, "serialization") for answer in (*(r.answer for r in ROUTES), models.Problem)
    ]
    template = "#/components/schemas/{model}"
    refs: Any
    refs, schemas = models_json_schema(answers, ref_template=template)
    contents = {
        model: {"content": {"application/json": {"schema": refs[model, mode]}}}
        for model, mode in answers
    }
    return {
        "openapi": "3.1.0",
        "info": {"title": "suspnet", "version": __version__, "description": WORDS},
        "servers": [{"url": request.script_root or "/"}],
        # without a login anybody may read; with one, a program shows its token
        "security": [{}, {"token": []}],
        "paths": {
            ROOT + re.sub(r"<(\w+)>", r"{\1}", route.rule): {"get": _operation(route, contents)}
            for route in ROUTES
        },
        "components": {
            "schemas": schemas["$defs"],
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _operation(route: Route, contents: dict[Any, Row]) -> Row:
    responses: Row = {"200": {"description": "The answer."} | contents[route.answer]}
    responses["304"] = {"description": "As the ETag that was sent."}
    errors = {*ERRORS} | ({404} if "<id>" in route.rule else set())
    for code in sorted(errors):
        phrase = f"{HTTPStatus(code).phrase}."
        responses[str(code)] = {"description": phrase} | contents[models.Problem]
    parameters: list[Row] = []
    if "<id>" in route.rule:
        schema: Row = {"type": "string", "pattern": models.ID}
        place = {"name": "id", "in": "path", "required": True, "schema": schema}
        parameters.append(place | {"description": "Name of the suspension in addresses."})
    for name, declared in route.query.model_json_schema().get("properties", {}).items():
        # the query has no null: a missing name takes its place
        kinds = [kind for kind in declared.get("anyOf", []) if kind.get("type") != "null"]
        schema = kinds[0] if kinds else {k: v for k, v in declared.items() if k != "description"}
        place = {"name": name, "in": "query", "description": declared["description"]}
        parameters.append(place | {"schema": schema})
    return {
        "operationId": route.name,
        "summary": route.summary,
        "parameters": parameters,
        "responses": responses,
    }
