"""Whose word a request is, as the job server says it in headers: name, place, grant, and the secret of the lease.

The server is trusted with names and places, as it holds the agent's token; they are for the log and decide nothing.
"""

from __future__ import annotations

from urllib.parse import unquote

from starlette.requests import Request

from machines.mill.orders import Caller
from service.errors import printable

GRANT = "Causticmill-Grant"
CONTROL = "Causticmill-Control"
BY, FROM = "Causticmill-By", "Causticmill-From"
_LONGEST = 200


def read_caller(request: Request) -> Caller:
    peer = request.client.host if request.client is not None else ""
    return Caller(
        name=_read(request, BY), origin=_read(request, FROM) or peer, grant=request.headers.get(GRANT, "")[:_LONGEST]
    )


def read_control(request: Request) -> str:
    """Return the secret that the holder of control shows; "" where there is none."""
    return request.headers.get(CONTROL, "")[:_LONGEST]


def _read(request: Request, name: str) -> str:
    return printable(unquote(request.headers.get(name, "")))[:_LONGEST]
