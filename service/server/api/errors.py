"""Maps errors to refusals, and describes these in the OpenAPI document. Answers contain no path and no traceback; those
are in the log.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError, SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from phrases.phrase import Phrase, join
from service.errors import FailedError, InputError, PictureError, SpecError
from service.http.problems import Kind, Problem, make_value_problem, problem_response
from service.server.database.records import JobStateError, KeyReusedError, UnknownArtifactError, UnknownJobError
from service.server.schemas.jobs import ProblemBody
from service.store.base import MissingObjectError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_RETRY = {"Retry-After": "5"}
_log = structlog.get_logger("api")


def install_problems(app: FastAPI) -> None:
    """Turn every error into a problem; the framework does not log errors of known families as faults."""
    known = (Problem, InputError, FailedError, SQLAlchemyError, OSError, HTTPException, RequestValidationError)
    ours = (JobStateError, UnknownJobError, UnknownArtifactError, KeyReusedError, MissingObjectError, ClientDisconnect)
    for kind in (*known, *ours, Exception):
        app.add_exception_handler(kind, _answer)


async def _answer(request: Request, error: Exception) -> Response:
    problem = problem_of(error)
    if problem.status >= 500 and not isinstance(error, Problem):
        fault = not isinstance(error, FailedError | SQLAlchemyError | OSError)
        _log.error(
            "refused", status=problem.status, method=request.method, path=request.url.path, error=_words(error),
            exc_info=error if fault else None,
        )  # fmt: skip
    return problem_response(problem)


def problem_of(error: Exception) -> Problem:
    """Return the refusal for an error; 500 for an unexpected one."""
    for kinds, convert in _TABLE:
        if isinstance(error, kinds):
            return convert(error)
    return Problem(500, Phrase("internal server error; see the server's log"))


def _of_spec(error: Exception) -> Problem:
    problems, rows = (error.problems, error.rows()[:20]) if isinstance(error, SpecError) else ([], [])
    first = [Phrase("{key}: {sentence}", key=key, sentence=sentence) for key, sentence in problems[:5]]
    detail = join("; ", first) if first else Phrase("the spec cannot be used")
    field = rows[0]["field"] if rows else "spec"
    return Problem(422, detail, field=field, kind=Kind.SPEC, more={"problems": rows})


def _of_request(error: Exception) -> Problem:
    """Return the problem of FastAPI's own complaint about a parameter or a body."""
    details = error.errors() if isinstance(error, RequestValidationError) else []
    first: Mapping[str, Any] = details[0] if details else {"loc": (), "msg": "cannot be used"}
    if first.get("type") == "json_invalid":
        return Problem(400, Phrase("the body is not valid JSON"), field="body")
    place = first["loc"]
    return make_value_problem(place[1:] if len(place) > 1 else place, first["msg"])


def _of_http(error: Exception) -> Problem:
    """Return the problem for refusals of the router, and for the framework's refusals of bodies."""
    status = getattr(error, "status_code", 500)
    words = {
        404: Phrase("no such address"),
        405: Phrase("this address does not take that method"),
        408: Phrase("the body stopped arriving"),
        413: Phrase("the request is too large"),
    }
    headers = {key: value for key, value in (getattr(error, "headers", None) or {}).items() if key.lower() == "allow"}
    return Problem(status, words.get(status) or HTTPStatus(status).phrase.lower(), headers=headers)


def _of_database(error: Exception) -> Problem:
    words = str(getattr(error, "orig", error)).lower()
    if "disk is full" in words or "no space left" in words or "could not extend file" in words:
        return Problem(507, Phrase("the database has no space left"), headers=_RETRY)
    broken = not isinstance(error, DBAPIError) or isinstance(error, OperationalError | InterfaceError)
    if broken or getattr(error, "connection_invalidated", False):
        return Problem(503, Phrase("the database cannot be reached or written at present"), headers=_RETRY)
    return Problem(500, Phrase("internal server error; see the server's log"))


def _of_disk(error: Exception) -> Problem:
    cause = error if isinstance(error, OSError) else error.__cause__ or error.__context__
    if (isinstance(cause, OSError) and cause.errno in _FULL) or "no space left" in str(error).lower():
        return Problem(507, Phrase("the server's disk has no space left"), headers=_RETRY)
    return Problem(503, Phrase("the server's disk or artifact store cannot be used at present"), headers=_RETRY)


_TABLE: list[tuple[type[Exception] | tuple[type[Exception], ...], Callable[[Exception], Problem]]] = [
    (Problem, lambda error: error if isinstance(error, Problem) else Problem(500, "")),
    (SpecError, _of_spec),
    (PictureError, lambda error: Problem(422, str(error), field="image", kind=Kind.PICTURE)),
    (InputError, lambda error: Problem(422, str(error), field=error.field if isinstance(error, InputError) else "")),
    (UnknownJobError, lambda error: Problem(404, str(error), field="id")),
    (UnknownArtifactError, lambda error: Problem(404, str(error), field="name")),
    (JobStateError, lambda error: Problem(409, str(error))),
    (KeyReusedError, lambda error: Problem(422, str(error), field="Idempotency-Key", kind=Kind.KEY_REUSED)),
    (
        MissingObjectError,
        lambda _: Problem(503, Phrase("the artifact store does not hold this file at present"), headers=_RETRY),
    ),
    (RequestValidationError, _of_request),
    (ClientDisconnect, lambda _: Problem(400, Phrase("the connection ended before the request did"))),
    (HTTPException, _of_http),
    (SQLAlchemyError, _of_database),
    ((FailedError, OSError), _of_disk),
]


def _words(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:500]


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
# Answers of the guard and the framework on every route.
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
    """Return the OpenAPI document with the problem's schema, and with each refusal described once for all routes."""
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
            for status, answer in operation["responses"].items():
                if _PROBLEM_JSON in answer.get("content", {}):
                    operation["responses"][status] = {"$ref": f"#/components/responses/Problem{status}"}
    return document
