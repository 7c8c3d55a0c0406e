"""What the agent answers when it refuses: application/problem+json, with the field at fault."""

from __future__ import annotations

import errno

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from machines.errors import (
    JournalError,
    MachineError,
    NotAllowedError,
    PortError,
    ProgramChangedError,
    ProgramRefusedError,
)
from service.errors import printable, sentence_of_os_error

_TITLES = {
    400: "Bad request",
    401: "Not authorised",
    403: "Forbidden",
    404: "Not found",
    405: "Method not allowed",
    409: "Not allowed in this state",
    413: "Too large",
    415: "Unsupported media type",
    422: "Unusable value",
    500: "Fault of the agent",
    502: "Could not fetch",
    503: "Mill not reachable",
    507: "No space left",
}


class Problem(Exception):
    """A refusal: HTTP status, one line, and the field of the request it is about (empty if none)."""

    def __init__(self, status: int, detail: str, *, field: str = "") -> None:
        super().__init__(detail)
        self.status = status
        self.detail = printable(detail)
        self.field = field


def problem_of(error: Exception) -> Problem:
    """The refusal that tells of an error of the machine layer or of the disk."""
    match error:
        case Problem():
            return error
        case NotAllowedError():
            return Problem(409, str(error))
        case ProgramRefusedError() | ProgramChangedError():
            return Problem(422, str(error), field="program")
        case JournalError():
            return Problem(507, str(error))
        case PortError():
            return Problem(503, str(error))
        case MachineError():
            return Problem(409, str(error))
        case OSError() if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            return Problem(507, sentence_of_os_error(error, doing="cannot write"))
        case OSError():
            return Problem(500, sentence_of_os_error(error, doing="cannot use"))
    return Problem(500, f"{type(error).__name__}: {error}")


def problem_response(problem: Problem) -> Response:
    body: dict[str, object] = {
        "type": "about:blank",
        "title": _TITLES.get(problem.status, "Refused"),
        "status": problem.status,
        "detail": problem.detail,
    }
    if problem.field:
        body["field"] = problem.field
    headers = {"WWW-Authenticate": "Bearer"} if problem.status == 401 else None
    return JSONResponse(body, status_code=problem.status, headers=headers, media_type="application/problem+json")


async def on_error(_request: Request, error: Exception) -> Response:
    """Exception handler of the app."""
    return problem_response(problem_of(error))


async def on_http_error(_request: Request, error: Exception) -> Response:
    """Exception handler for what the router itself refuses (404, 405)."""
    status = getattr(error, "status_code", 500)
    words = {404: "no such address; GET /v1/status shows the mill", 405: "this address does not take that method"}
    return problem_response(Problem(status, words.get(status, str(getattr(error, "detail", "")))))
