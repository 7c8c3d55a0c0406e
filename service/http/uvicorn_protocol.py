"""uvicorn's HTTP/1.1 with two changes: its own answers are problems like all others, and connections have places
(`admission`), because uvicorn waits for a request without limit and counts a stop like any other.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import resource
import socket
from typing import Any, cast

import h11
import uvicorn
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from phrases.phrase import Phrase
from service.http.acceptor import Acceptor
from service.http.admission import PLACE, Admission, Place, is_stop
from service.http.problems import Problem, problem_body, problem_response

HEADER_BYTES = 32 << 10
SOCKET_BYTES = 4096  # of one message over a WebSocket
VERSION_HEADER = "Causticmill-Version"  # with every answer


def allow_open_files(most: int) -> int:
    """Raise this process's limit of open files to `most`, or as far as permitted. Return the limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


class HttpServer(uvicorn.Server):
    """uvicorn with our acceptor and places for its connections."""

    def __init__(self, config: uvicorn.Config, admission: Admission) -> None:
        config.http = cast("type[asyncio.Protocol]", functools.partial(ProblemProtocol, admission))
        super().__init__(config)
        self._admission = admission
        self._acceptors: list[Acceptor] = []
        self._beginnings: set[asyncio.Task[None]] = set()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup([])
        few, wait_s = self._admission.strangers, self._admission.wait_s
        self._acceptors = [Acceptor(each, self.begin, silent=few, wait_s=wait_s) for each in sockets or ()]

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for acceptor in self._acceptors:
            acceptor.close()
        await super().shutdown(sockets)

    def begin(self, connection: socket.socket, received: bytes = b"") -> None:
        """Serve a connection. received: the bytes that another process has already read from it"""
        protocol: Any = self.config.http_protocol_class(  # type: ignore[call-arg]
            config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        protocol.first_data = received
        begin_connection(protocol, connection, self._beginnings)


def begin_connection(protocol: asyncio.Protocol, connection: socket.socket, tasks: set[asyncio.Task[None]]) -> None:
    """Set up a connection for its protocol. tasks: holds this work until it is done."""
    loop = asyncio.get_running_loop()

    async def begin() -> None:
        with contextlib.suppress(OSError):  # its caller has gone
            await loop.connect_accepted_socket(lambda: protocol, connection)

    task = loop.create_task(begin())
    tasks.add(task)
    task.add_done_callback(tasks.discard)


class ProblemProtocol(H11Protocol):
    """HTTP/1.1 of one connection; what it refuses never reaches the application."""

    _place: Place
    first_data = b""  # bytes that another process has read from the connection

    def __init__(self, admission: Admission, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._admission = admission
        self._app = self.app
        self.app = self._admit

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(cast("asyncio.Transport", transport))
        self._place = self._admission.enter(self.transport)
        self.app_state = {**self.app_state, PLACE: self._place}
        if self.first_data:
            self.data_received(self.first_data)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._track_request()

    def on_response_complete(self) -> None:
        self._place.await_request()
        super().on_response_complete()
        self._track_request()  # the next request may have arrived already

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._place.leave()

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
        if self._admission.is_full and not self._place.is_stop:
            headers = {"Retry-After": "5", "Connection": "close"}
            problem = Problem(503, Phrase("too many requests at once"), headers=headers)
            await problem_response(problem)(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _track_request(self) -> None:
        if self.cycle is None or self.cycle.response_complete:
            return
        if is_stop(self.scope["method"], self.scope["path"]):
            self._place.answer_stop()
        elif self._place.is_known or not self.cycle.more_body:
            self._place.stop_waiting()
