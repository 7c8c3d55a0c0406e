"""uvicorn's HTTP/1.1, where the answers that it gives by itself are problems like all others of ours.

A connection that brings no request is closed after a while; uvicorn waits for a first one for ever.
"""

from __future__ import annotations

import asyncio
import json
from typing import Any, cast

import h11
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.web.problems import Problem, problem_body, problem_response

_FIRST_REQUEST_S = 30.0


class ProblemProtocol(H11Protocol):
    """What is refused here never reaches the application."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._app = self.app
        self._most, self.limit_concurrency = self.limit_concurrency, None
        self.app = self._admit

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(cast("asyncio.Transport", transport))
        self.loop.call_later(_FIRST_REQUEST_S, self._close_if_silent)

    def send_400_response(self, msg: str) -> None:
        body = json.dumps(problem_body(Problem(400, f"this is not a request in HTTP/1.1: {msg}"))).encode()
        headers = [
            (b"content-type", b"application/problem+json"),
            (b"content-length", str(len(body)).encode()),
            (b"connection", b"close"),
        ]
        answer = h11.Response(status_code=400, headers=headers, reason=b"Bad Request")
        for event in (answer, h11.Data(data=body), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    async def _admit(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._most is not None and max(len(self.connections), len(self.tasks)) > self._most:
            problem = Problem(503, "too many connections at once", headers={"Retry-After": "5", "Connection": "close"})
            await problem_response(problem)(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _close_if_silent(self) -> None:
        if self.cycle is None and not self.transport.is_closing():
            self.transport.close()
