"""Refusals of the HTTP interfaces: application/problem+json, with the field at fault."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from enum import StrEnum

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from machines.errors import (
    JournalError,
    MachineError,
    PortError,
    ProgramChangedError,
    ProgramRefusedError,
)
from machines.mill.orders import OrderRefusedError, Refusal
from phrases.phrase import Phrase, phrases_in
from service.errors import printable, sentence_of_os_error

GRANT, CONTROL = "Causticmill-Grant", "Causticmill-Control"  # headers of an order
BY, FROM = "Causticmill-By", "Causticmill-From"  # its person and origin, as the server reports them to an agent

_TITLES = {
    400: "Bad request",
    401: "Not authorised",
    403: "Forbidden",
    404: "Not found",
    405: "Method not allowed",
    408: "Too slow",
    409: "Not allowed in this state",
    412: "Changed meanwhile",
    413: "Too large",
    415: "Unsupported media type",
    416: "No such range",
    421: "Not for this server",
    422: "Unusable value",
    428: "Something must come first",
    429: "Too many requests",
    431: "Headers too large",
    500: "Fault inside",
    502: "Could not fetch",
    503: "Not reachable",
    504: "No answer in time",
    507: "No space left",
}


class Kind(StrEnum):
    """The closed list of problem types, by which a client can tell them apart: `urn:causticmill:problem:<kind>`."""

    BAD_REQUEST = "bad-request"
    NOT_AUTHORISED = "not-authorised"
    FORBIDDEN = "forbidden"
    NOT_FOUND = "not-found"
    METHOD_NOT_ALLOWED = "method-not-allowed"
    TOO_SLOW = "too-slow"
    WRONG_STATE = "wrong-state"
    CHANGED = "changed"
    TOO_LARGE = "too-large"
    MEDIA_TYPE = "media-type"
    RANGE = "range"
    WRONG_HOST = "wrong-host"
    UNUSABLE = "unusable"
    SPEC = "spec"
    PICTURE = "picture"
    KEY_REUSED = "key-reused"
    TOO_MANY = "too-many"
    FAULT = "fault"
    NOT_FETCHED = "not-fetched"
    UNAVAILABLE = "unavailable"
    NOT_READY = "not-ready"
    MACHINE = "machine"
    NO_ANSWER = "no-answer"
    NO_SPACE = "no-space"


class ServerCode(StrEnum):
    """Codes of the server's statements about agents and runs, and of an agent's requests: a closed list, beside
    `MillCode`.

    In a problem, in `agent` of a machine and in a run, each with its values.
    """

    AGENT_ABSENT = "agent_absent"
    AGENT_UNREACHED = "agent_unreached"  # reason, or seconds
    AGENT_KEY_UNUSABLE = "agent_key_unusable"  # reason
    AGENT_KEY_REFUSED = "agent_key_refused"
    AGENT_OTHER = "agent_other"
    AGENT_SILENT = "agent_silent"  # its event stream has ended
    AGENT_WRONG = "agent_wrong"  # its answer is impossible
    AGENT_FAULT = "agent_fault"  # status, reason
    ORDER_UNCERTAIN = "order_uncertain"  # order: it may have arrived
    STOP_UNCERTAIN = "stop_uncertain"  # order, seconds: it may have arrived
    ORDER_WITHOUT_EFFECT = "order_without_effect"  # order, state
    CONFIRM = "confirm"  # and `effect` of the problem
    RUN_LOST = "run_lost"
    RUN_GIVEN_UP = "run_given_up"  # state
    RUN_UNKNOWN = "run_unknown"


_KINDS = {
    400: Kind.BAD_REQUEST,
    401: Kind.NOT_AUTHORISED,
    403: Kind.FORBIDDEN,
    404: Kind.NOT_FOUND,
    405: Kind.METHOD_NOT_ALLOWED,
    408: Kind.TOO_SLOW,
    409: Kind.WRONG_STATE,
    412: Kind.CHANGED,
    413: Kind.TOO_LARGE,
    415: Kind.MEDIA_TYPE,
    416: Kind.RANGE,
    421: Kind.WRONG_HOST,
    422: Kind.UNUSABLE,
    429: Kind.TOO_MANY,
    431: Kind.TOO_LARGE,
    500: Kind.FAULT,
    502: Kind.NOT_FETCHED,
    503: Kind.UNAVAILABLE,
    504: Kind.NO_ANSWER,
    507: Kind.NO_SPACE,
}


class Problem(Exception):
    """A refusal: HTTP status, one line, and the field of the request at fault (empty if none).

    kind : if several reasons share a status. code, values : for programs, of `ServerCode` or a mill's codes.
    headers : of the answer. more : further members of the problem.
    """

    def __init__(
        self,
        status: int,
        detail: str,
        *,
        field: str = "",
        kind: Kind | None = None,
        code: str = "",
        values: Mapping[str, object] | None = None,
        headers: Mapping[str, str] | None = None,
        more: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = printable(detail)
        self.field = printable(field)
        self.kind = kind or _KINDS.get(status, Kind.BAD_REQUEST if status < 500 else Kind.FAULT)
        self.code = code
        self.values = dict(values or {})
        self.headers = dict(headers or {})
        self.more = dict(more or {})


def make_value_problem(place: Sequence[object], cause: str) -> Problem:
    """Return the refusal of a value in a request. place: the keys that lead to it, none for the body as a whole."""
    field = ".".join(map(str, place)) or "body"
    return Problem(422, Phrase("{field}: {cause}", field=field, cause=cause), field=field)


def problem_of(error: Exception) -> Problem:
    """Return the refusal for an error of the machine layer or of the disk."""
    match error:
        case Problem():
            return error
        case OrderRefusedError():
            return _problem_of_order(error)
        case ProgramRefusedError() | ProgramChangedError():
            return Problem(422, str(error), field="program")
        case JournalError():
            return Problem(507, str(error))
        case PortError():
            return Problem(503, str(error))
        case MachineError():
            return Problem(409, str(error), code=error.code, values=error.values)
        case OSError() if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            return Problem(507, sentence_of_os_error(error, doing="cannot write"))
        case OSError():
            return Problem(500, sentence_of_os_error(error, doing="cannot use"))
    return Problem(500, f"{type(error).__name__}: {error}")


def _problem_of_order(error: OrderRefusedError) -> Problem:
    """Return the problem of a refused order, with the code that tells refusals apart, and who has control if that is
    the reason.
    """
    of_control = error.code in (Refusal.HELD, Refusal.LOST, Refusal.NOBODY, Refusal.LEASE)
    more = {"control": None if error.holder is None else error.holder.as_dict()} if of_control else {}
    field = CONTROL if of_control else GRANT if error.code.startswith("grant") else ""
    status = 428 if error.code == Refusal.MISSING else 409
    return Problem(status, str(error), field=field, code=error.code, values=error.values, more=more)


def problem_response(problem: Problem) -> Response:
    headers = {"WWW-Authenticate": "Bearer"} if problem.status == 401 else {}
    return JSONResponse(
        problem_body(problem),
        status_code=problem.status,
        headers=headers | problem.headers,
        media_type="application/problem+json",
    )


def problem_body(problem: Problem) -> dict[str, object]:
    """Return the members of RFC 9457, `field`, and `code` with its `values`."""
    body: dict[str, object] = {
        "type": f"urn:causticmill:problem:{problem.kind}",
        "title": _TITLES.get(problem.status, "Refused"),
        "status": problem.status,
        "detail": problem.detail,
    }
    extra: dict[str, object] = {"code": problem.code, "values": problem.values} if problem.code else {}
    extra |= {"phrases": phrases} if (phrases := phrases_in((problem.detail, problem.values, problem.more))) else {}
    return body | ({"field": problem.field} if problem.field else {}) | extra | problem.more


async def on_error(_request: Request, error: Exception) -> Response:
    """Handle an exception of the app."""
    return problem_response(problem_of(error))


async def on_http_error(_request: Request, error: Exception) -> Response:
    """Handle refusals of the router itself (404, 405)."""
    status = getattr(error, "status_code", 500)
    words = {404: "no such address; GET /v1/status shows the mill", 405: "this address does not take that method"}
    return problem_response(Problem(status, words.get(status, str(getattr(error, "detail", "")))))
