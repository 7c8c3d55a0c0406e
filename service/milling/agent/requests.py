"""Checks and reads requests to the agent: the bearer token, a Host header that no web page can forge, the caller, whom
the job server names in headers, and the body.

The server is trusted with names and origins, because it has the agent's token; they only go to the log and decide
nothing.
"""

from __future__ import annotations

import hmac
import json
from typing import TypeVar
from urllib.parse import unquote

from pydantic import ValidationError
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Receive, Scope, Send

from machines.mill.orders import Caller
from service.errors import printable
from service.http.admission import note_known
from service.http.hosts import is_own_host, own_names
from service.http.problems import BY, CONTROL, FROM, GRANT, Problem, make_value_problem, problem_response
from service.http.schema import Body

_LONGEST = 200
_MAX_BYTES = 65536
_OPEN = {"/livez"}

Form = TypeVar("Form", bound=Body)


class AgentGuard:
    """ASGI middleware: refuses foreign Host headers (403) and requests without the token (401)."""

    def __init__(self, app: ASGIApp, *, token: str, hosts: frozenset[str] = frozenset()) -> None:
        self._app = app
        self._token = token.encode()
        self._hosts = hosts | own_names()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and (problem := self._refusal(scope)) is not None:
            await problem_response(problem)(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Problem | None:
        headers: dict[bytes, bytes] = {}
        for name, value in scope["headers"]:
            if name in (b"host", b"authorization") and name in headers:
                return Problem(400, f"two {name.decode()} headers")
            headers[name] = value
        host = headers.get(b"host", b"").decode("latin-1").lower()
        if not is_own_host(host, self._hosts):
            return Problem(403, f"Host is '{host}'; allowed: localhost, an address, or this machine's name")
        if scope["path"] in _OPEN:
            return None
        kind, _, token = headers.get(b"authorization", b"").partition(b" ")
        if kind.lower() != b"bearer" or not hmac.compare_digest(token.strip(), self._token):
            return Problem(401, "a token is needed: Authorization: Bearer ...", field="Authorization")
        note_known(scope)
        return None


def read_caller(request: Request) -> Caller:
    peer = request.client.host if request.client is not None else ""
    return Caller(
        name=_read(request, BY), origin=_read(request, FROM) or peer, grant=request.headers.get(GRANT, "")[:_LONGEST]
    )


def read_control(request: Request) -> str:
    """Return the secret of the holder of control; "" if there is none."""
    return request.headers.get(CONTROL, "")[:_LONGEST]


async def read_body(request: Request, form: type[Form]) -> Form:
    """Read the JSON object of a request; an empty body is an empty object. Problem 400, 413, 422."""
    content = bytearray()
    try:
        async for chunk in request.stream():
            content += chunk
            if len(content) > _MAX_BYTES:
                raise Problem(413, f"the body is longer than {_MAX_BYTES} bytes")
    except ClientDisconnect:
        raise Problem(400, "the connection ended before the body did") from None
    try:
        values = json.loads(content) if content.strip() else {}
    except (ValueError, RecursionError) as error:
        raise Problem(400, f"the body is not JSON: {str(error)[:100]}") from None
    if not isinstance(values, dict):
        raise Problem(400, "the body is not a JSON object")
    try:
        return form.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        raise make_value_problem(first["loc"], first["msg"]) from None


def _read(request: Request, name: str) -> str:
    return printable(unquote(request.headers.get(name, "")))[:_LONGEST]
