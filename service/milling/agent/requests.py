"""What a request tells the agent: whose it is, as the job server says in headers, and its body.

The server is trusted with names and places, as it holds the agent's token; they are for the log and decide nothing.
"""

from __future__ import annotations

import json
from typing import TypeVar
from urllib.parse import unquote

from pydantic import ValidationError
from starlette.requests import ClientDisconnect, Request

from machines.mill.orders import Caller
from service.errors import printable
from service.http.problems import BY, CONTROL, FROM, GRANT, Problem, make_value_problem
from service.http.schema import Body

_LONGEST = 200
_MAX_BYTES = 65536

Form = TypeVar("Form", bound=Body)


def read_caller(request: Request) -> Caller:
    peer = request.client.host if request.client is not None else ""
    return Caller(
        name=_read(request, BY), origin=_read(request, FROM) or peer, grant=request.headers.get(GRANT, "")[:_LONGEST]
    )


def read_control(request: Request) -> str:
    """Return the secret that the holder of control shows; "" where there is none."""
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
