"""uvicorn's HTTP/1.1, where the answers that it gives by itself are problems like all others of ours.

A connection that brings no whole request head is closed after a while; uvicorn waits for one for ever. Where there are
too many connections, those that ask for nothing make room for those that do, strangers before callers whom the
application has let in once: whoever owns a mill keeps a way to it.
"""

from __future__ import annotations

import asyncio
import json
import resource
from typing import Any, cast

import h11
from starlette.types import Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from phrases.phrase import Phrase
from service.http.problems import Problem, problem_body, problem_response

HEADER_BYTES = 32 << 10
VERSION_HEADER = "Causticmill-Version"  # with every answer
_REQUEST_HEAD_S = 30.0
_STRANGER = frozenset({400, 401, 403, 421, 429, 431})


def allow_open_files(most: int) -> None:
    """Raise this process's limit of open files to `most`, or as far as it may."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


class ProblemProtocol(H11Protocol):
    """What is refused here never reaches the application."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._app = self.app
        self._most, self.limit_concurrency = self.limit_concurrency, None
        self.app = self._admit
        self._waits_since_s: float | None = None  # for a request's head; None: a request is being answered
        self._head_timer: asyncio.TimerHandle | None = None
        self._is_known = False  # the application has let a request of this connection in

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(cast("asyncio.Transport", transport))
        self._await_head()
        if self._most is not None and len(self.connections) > self._most:
            self._make_room()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._note_request()

    def on_response_complete(self) -> None:
        self._await_head()
        super().on_response_complete()
        self._note_request()  # the next one may be here already

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._await_nothing()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._await_nothing()
        super().handle_websocket_upgrade(event)

    def send_400_response(self, msg: str) -> None:
        words = Phrase("this is not a request in HTTP/1.1: {cause}", cause=msg)
        body = json.dumps(problem_body(Problem(400, words))).encode()
        headers = [
            *self.server_state.default_headers,
            (b"content-type", b"application/problem+json"),
            (b"content-length", str(len(body)).encode()),
            (b"connection", b"close"),
        ]
        answer = h11.Response(status_code=400, headers=headers, reason=b"Bad Request")
        for event in (answer, h11.Data(data=body), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    async def _admit(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._most is not None and len(self.tasks) > self._most:
            headers = {"Retry-After": "5", "Connection": "close"}
            problem = Problem(503, Phrase("too many requests at once"), headers=headers)
            await problem_response(problem)(scope, receive, send)
            return

        async def send_noted(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] not in _STRANGER:
                self._is_known = True
            await send(message)

        await self._app(scope, receive, send_noted)

    def _await_head(self) -> None:
        self._await_nothing()
        self._waits_since_s = self.loop.time()
        self._head_timer = self.loop.call_later(_REQUEST_HEAD_S, self.transport.close)

    def _note_request(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self._await_nothing()

    def _await_nothing(self) -> None:
        self._waits_since_s = None
        if self._head_timer is not None:
            self._head_timer.cancel()

    def _make_room(self) -> None:
        """Close the connection that has asked for nothing for the longest time."""
        others = [each for each in self.connections if isinstance(each, ProblemProtocol) and each is not self]
        idle = [
            (each._is_known, each._waits_since_s, id(each), each) for each in others if each._waits_since_s is not None
        ]
        if idle:
            *_, longest = min(idle)
            longest._await_nothing()
            longest.transport.abort()
