"""What the OpenAPI document says of refusals and of event streams."""

from __future__ import annotations

from typing import Any

from service.server.schemas.jobs import ProblemBody

_PROBLEM_JSON = "application/problem+json"
_WORDS = {
    400: "the request is malformed",
    401: "a token is needed",
    403: "the token lacks a scope, or the request came from a foreign page",
    404: "there is no such thing",
    405: "this address does not take that method",
    408: "the request did not arrive in time",
    409: "not allowed in the present state",
    412: "changed meanwhile",
    413: "the request is too large",
    415: "not a media type this address takes",
    416: "no such range in this file",
    422: "a value cannot be used; `field` names it",
    428: "an order needs a grant: POST .../grants hands one out",
    429: "too many requests; Retry-After tells when to come back",
    431: "the headers are too large",
    500: "internal server error",
    502: "the mill's agent answered with something else",
    503: "a part of the server cannot be reached at present; Retry-After tells when to come back",
    504: "the mill's agent did not answer in time",
    507: "the server has no space left",
}
_EVENT = {"type": "object", "properties": {name: {"type": "string"} for name in ("id", "event", "data")}}
# What the guard and the frame answer on every route.
ANYWHERE = (400, 401, 403, 404, 405, 408, 413, 422, 429, 431, 503)

Responses = dict[int | str, dict[str, Any]]


def refusals(*statuses: int) -> Responses:
    """Return the problems of these statuses, for the document."""
    return {status: _refusal(status) for status in statuses}


def event_stream(words: str, example: str) -> Responses:
    """Return a stream of events, each as OpenAPI 3.2 describes one."""
    return {200: {"description": words, "content": {"text/event-stream": {"schema": _EVENT, "example": example}}}}


def _refusal(status: int) -> dict[str, Any]:
    content = {_PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {"description": _WORDS[status], "content": content}


def with_problems(document: dict[str, Any]) -> dict[str, Any]:
    """Return the OpenAPI document with the problem's schema, and each refusal told once for all routes."""
    components = document.setdefault("components", {})
    schema = ProblemBody.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas = components.setdefault("schemas", {})
    schemas.update(schema.pop("$defs", {}))
    schemas["Problem"] = schema | {"title": "Problem"}
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    components["responses"] = {f"Problem{status}": _refusal(status) for status in _WORDS}
    for item in document["paths"].values():
        for operation in item.values():
            told = operation["responses"]
            for status in [status for status in told if told[status] == _refusal_or_none(status)]:
                told[status] = {"$ref": f"#/components/responses/Problem{status}"}
    return document


def _refusal_or_none(status: str) -> dict[str, Any] | None:
    return _refusal(int(status)) if int(status) in _WORDS else None
