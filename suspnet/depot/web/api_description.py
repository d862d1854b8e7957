"""The API's description in OpenAPI 3.1, made of the types that it takes and gives."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from suspnet import __version__
from suspnet.depot.web.api_models import ID, Problem

USUAL_ERRORS = (400, 401, 403, 503)
TOKEN = "token"  # name of the security scheme
WORDS = (
    "Suspensions of a fleet with their verdicts, parts, alarms, trips, plan and work orders. "
    "Estimates are relative to healthy; names of fields end in their unit. No answer is a safety "
    "decision."
)


@dataclass(frozen=True)
class Route:
    """One request that the API answers."""

    rule: str
    name: str
    summary: str
    query: type[BaseModel]
    answer: Any
    body: type[BaseModel] | None = None


def description(root: str, routes: Sequence[Route], server: str = "/") -> dict[str, Any]:
    """Return the description of the routes below the path `root` of the address `server`."""
    bodies = [(route.body, "validation") for route in routes if route.body]
    answers = [(answer, "serialization") for answer in (*(r.answer for r in routes), Problem)]
    refs, schemas = models_json_schema(
        [*bodies, *answers],  # type: ignore[list-item]
        ref_template="#/components/schemas/{model}",
    )
    paths: dict[str, Any] = {}
    for route in routes:
        path = root + re.sub(r"<(\w+)>", r"{\1}", route.rule)
        paths.setdefault(path, {})["post" if route.body else "get"] = _operation(route, refs)
    return {
        "openapi": "3.1.0",
        "info": {"title": "suspnet", "version": __version__, "description": WORDS},
        "servers": [{"url": server}],
        "paths": paths,
        "components": {
            "schemas": schemas["$defs"],
            "securitySchemes": {TOKEN: {"type": "http", "scheme": "bearer"}},
        },
    }


def _operation(route: Route, refs: Any) -> dict[str, Any]:
    def content(model: Any, mode: str = "serialization") -> dict[str, Any]:
        return {"content": {"application/json": {"schema": refs[model, mode]}}}

    responses = {"201" if route.body else "200": {"description": "The answer."}}
    responses = {code: text | content(route.answer) for code, text in responses.items()}
    errors = {*USUAL_ERRORS} | ({404} if "<id>" in route.rule else set())
    operation: dict[str, Any] = {
        "operationId": route.name,
        "summary": route.summary,
        # without a login anybody may read; with one, a program shows its token
        "security": [{TOKEN: []}] if route.body else [{}, {TOKEN: []}],
        "parameters": _parameters(route),
        "responses": responses,
    }
    if route.body:
        errors |= {409, 413, 415}
        operation["requestBody"] = {"required": True, **content(route.body, "validation")}
    else:
        responses["304"] = {"description": "As the ETag that was sent."}
    for code in sorted(errors):
        phrase = f"{HTTPStatus(code).phrase}."
        responses[str(code)] = {"description": phrase, **content(Problem)}
    return operation


def _parameters(route: Route) -> list[dict[str, Any]]:
    parameters: list[dict[str, Any]] = []
    if "<id>" in route.rule:
        words = "Name of the suspension in addresses."
        schema: dict[str, Any] = {"type": "string", "pattern": ID}
        place = {"name": "id", "in": "path", "required": True}
        parameters.append(place | {"description": words, "schema": schema})
    for name, own in route.query.model_json_schema().get("properties", {}).items():
        # the query has no null: a missing name takes its place
        kinds = [kind for kind in own.get("anyOf", []) if kind.get("type") != "null"]
        schema = kinds[0] if kinds else {k: v for k, v in own.items() if k != "description"}
        place = {"name": name, "in": "query", "description": own["description"]}
        parameters.append(place | {"schema": schema})
    return parameters
