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
from suspnet.web.api_models import ID, Problem

REF = "#/components/schemas/{model}"
USUAL_ERRORS = (400, 401, 403, 503)
TOKEN = "token"
"""Name of the security scheme."""
WORDS = (
    "Suspensions of a fleet with their verdicts, parts, alarms, trips, plan and work orders. "
    "Estimates are relative to healthy; names of fields end in their unit. No answer is a safety "
    "decision."
)


@dataclass(frozen=True)
class Route:
    """One request that the API answers."""

    rule: str
    method: str
    name: str
    words: str
    query: type[BaseModel]
    answer: type[BaseModel]
    body: type[BaseModel] | None = None


def description(root: str, routes: Sequence[Route], server: str = "/") -> dict[str, Any]:
    """Return the description of the routes below the path `root` of the address `server`."""
    taken = [(one.body, "validation") for one in routes if one.body]
    given = [(one.answer, "serialization") for one in routes]
    refs, schemas = models_json_schema(
        [*taken, *given, (Problem, "serialization")],  # type: ignore[list-item]
        ref_template=REF,
    )
    paths: dict[str, Any] = {}
    for one in routes:
        path = root + re.sub(r"<(\w+)>", r"{\1}", one.rule)
        paths.setdefault(path, {})[one.method.lower()] = _operation(one, refs)
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
    status = "200" if route.body is None else "201"
    errors = [*USUAL_ERRORS, *([404] if "<id>" in route.rule else [])]
    errors += [409, 413, 415] if route.body else []
    found = {
        "operationId": route.name,
        "summary": route.words,
        # without a login anybody may read; with one, a program shows its token
        "security": [{TOKEN: []}] if route.body else [{}, {TOKEN: []}],
        "parameters": _parameters(route),
        "responses": {
            status: {
                "description": "The answer.",
                "content": _json(refs[route.answer, "serialization"]),
            },
            **({"304": {"description": "As the ETag that was sent."}} if not route.body else {}),
            **{
                str(code): {
                    "description": f"{HTTPStatus(code).phrase}.",
                    "content": _json(refs[Problem, "serialization"]),
                }
                for code in sorted(errors)
            },
        },
    }
    if route.body:
        content = _json(refs[route.body, "validation"])
        found["requestBody"] = {"required": True, "content": content}
    return found


def _json(schema: Any) -> dict[str, Any]:
    return {"application/json": {"schema": schema}}


def _parameters(route: Route) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    if "<id>" in route.rule:
        words = "Name of the suspension in addresses."
        schema: dict[str, Any] = {"type": "string", "pattern": ID}
        found.append(
            {"name": "id", "in": "path", "required": True, "description": words, "schema": schema}
        )
    for name, one in route.query.model_json_schema().get("properties", {}).items():
        kinds = [kind for kind in one.get("anyOf", []) if kind.get("type") != "null"]
        schema = kinds[0] if kinds else {k: v for k, v in one.items() if k != "description"}
        found.append(
            {"name": name, "in": "query", "description": one["description"], "schema": schema}
        )
    return found
