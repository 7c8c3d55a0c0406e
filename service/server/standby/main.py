"""`python -m service.server.standby.main`: the standby's process, a child of the supervisor. It only answers stop
requests.

It imports neither database nor framework, so that stops are served a moment after the start.
"""

from __future__ import annotations

import asyncio
import logging
import re
import socket
import sys
from typing import Any

from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState

from machines.mill.orders import Stop
from phrases.phrase import Phrase
from service.errors import ServiceError
from service.http.acceptor import Acceptor
from service.http.admission import is_stop, note_known
from service.http.hosts import own_names
from service.http.problems import Problem, problem_response
from service.http.serving import make_admission, make_config
from service.http.uvicorn_protocol import ProblemProtocol, allow_open_files, begin_connection
from service.processes import lifeline
from service.processes.linux import go_first
from service.server.api.access.requests import (
    Headers,
    read_headers,
    read_secret,
    refuse_foreign_page,
)
from service.server.fleet.agent_client import AgentLinks, OrderContext
from service.server.fleet.machine_stops import MachineStops
from service.server.standby.line import ApiWatch
from service.server.stop_socket import StopSockets, identify_stopper
from service.server.stoppers import FILE, StopperFile
from service.settings import ServerSettings

_WORDS = "|".join(Stop)
_OF_MACHINE = re.compile(rf"/v1/machines/(?P<machine>[^/]+)/control/(?P<stop>{_WORDS})")
_OF_RUN = re.compile(rf"/v1/runs/(?P<run>[^/:]+):(?P<stop>{Stop.HOLD}|{Stop.ABORT})")


class StandbyApp:
    """The standby's ASGI application. It answers as the server does; the state of a run comes from its mill's agent."""

    def __init__(self, settings: ServerSettings, stops: MachineStops, stoppers: StopperFile) -> None:
        self._stops = stops
        self._stoppers = stoppers
        self._behind_proxy = settings.behind_proxy
        self._names = own_names(settings.allowed_hosts)
        self._sockets = StopSockets(stops, stoppers.find, names=self._names, behind_proxy=settings.behind_proxy)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._sockets(scope, receive, send)
            return
        try:
            if not is_stop(scope["method"], scope["path"]):
                raise Problem(503, Phrase("the server is not ready yet; try again"), headers={"Retry-After": "1"})
            headers = read_headers(scope, self._names)
            refuse_foreign_page(scope, headers, behind_proxy=self._behind_proxy)
            answer = await self._stop(scope["path"], self._identify(scope, headers))
        except Problem as problem:
            problem.headers["Connection"] = "close"
            await problem_response(problem)(scope, receive, send)
            return
        await JSONResponse(answer, status_code=202, headers={"Connection": "close"})(scope, receive, send)

    def _identify(self, scope: Scope, headers: Headers) -> OrderContext:
        """Return the caller of a stop; Problem 401 if the caller may not stop mills."""
        secret = read_secret(headers)
        context = identify_stopper(scope, secret, self._stoppers.find, behind_proxy=self._behind_proxy)
        if context is None:
            raise Problem(401, Phrase("a token is needed: Authorization: Bearer cm_..."), field="Authorization")
        note_known(scope)
        return context

    async def _stop(self, path: str, context: OrderContext) -> dict[str, Any]:
        if found := _OF_MACHINE.fullmatch(path):
            order = await self._stops.stop_machine(found["machine"], Stop(found["stop"]), context)
            return order.model_dump(mode="json")
        if found := _OF_RUN.fullmatch(path):
            view = await self._stops.stop_run_anywhere(found["run"], Stop(found["stop"]), context)
            return view | {"id": found["run"]}
        raise Problem(404, Phrase("no such address"))


_FILES = 4096
_MEET_S = 10.0
_HELD_S = 25.0  # for the API to serve again


def main() -> int:
    """Run until SIGTERM."""
    listener, line = lifeline.inherit_socket(), lifeline.inherit_line()
    assert listener is not None and line is not None
    try:
        settings = ServerSettings.load()
    except ServiceError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return error.exit_code
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
    go_first()
    allow_open_files(_FILES)
    asyncio.run(_serve(settings, listener, line))
    return 0


async def _serve(settings: ServerSettings, listener: socket.socket, line: socket.socket) -> None:
    stop = asyncio.Event()
    for kind in lifeline.STOPPING:
        asyncio.get_running_loop().add_signal_handler(kind, stop.set)
    links = AgentLinks(settings)
    standby = Standby(StandbyApp(settings, MachineStops(links), StopperFile(settings.data / FILE)), listener, line)
    meeting = asyncio.create_task(_meet_agents(links))
    await stop.wait()
    meeting.cancel()
    standby.close()
    await links.close()


async def _meet_agents(links: AgentLinks) -> None:
    """Look up the addresses of the mills' agents again and again, until cancelled."""
    while True:
        await links.meet_agents()
        await asyncio.sleep(_MEET_S)


class Standby:
    """Accepts connections while the API does not."""

    def __init__(self, app: StandbyApp, listener: socket.socket, line: socket.socket) -> None:
        self._loop = asyncio.get_running_loop()
        self._config = make_config(app, lifespan="off")
        self._config.load()
        self._state = ServerState()
        self._state.default_headers = self._config.encoded_headers
        self._admission = make_admission()
        self._beginnings: set[asyncio.Task[None]] = set()
        wait_s = self._admission.wait_s
        self._acceptor = Acceptor(listener, self._begin, silent=self._admission.strangers, wait_s=wait_s)
        self._api = ApiWatch(line, lambda serves: self._acceptor.pause() if serves else self._acceptor.resume())

    def close(self) -> None:
        self._acceptor.close()

    def _begin(self, connection: socket.socket) -> None:
        protocol = StandbyProtocol(
            self._api, self._admission, config=self._config, server_state=self._state, app_state={}, _loop=self._loop
        )
        begin_connection(protocol, connection, self._beginnings)


class StandbyProtocol(ProblemProtocol):
    """Answers stops, and hands all other connections to the API."""

    def __init__(self, api: ApiWatch, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._api = api
        self._received = b""
        self._handing: asyncio.Task[bool] | None = None

    def data_received(self, data: bytes) -> None:
        self._received += data
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._handing is not None:
            self._handing.cancel()  # close at once: the descriptor may soon be reused for another caller
        super().connection_lost(exc)

    async def _admit(self, scope: Scope, receive: Receive, send: Send) -> None:
        if is_stop(scope["method"], scope["path"]):
            await super()._admit(scope, receive, send)
            return
        self.transport.pause_reading()
        connection = self.transport.get_extra_info("socket").fileno()
        self._handing = asyncio.create_task(self._api.hand_over(connection, self._received, _HELD_S))
        await asyncio.wait([self._handing])
        if self._handing.cancelled():
            return
        if self._handing.result():
            self.cycle.disconnected = True  # the answer comes from the API
            self.transport.abort()
        else:
            await super()._admit(scope, receive, send)


if __name__ == "__main__":
    sys.exit(main())
