"""The standby's application: stops, and nothing else. No database, no route that computes."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

from machines.clock import suspend_aware_clock_s
from machines.mill.orders import Stop
from phrases.phrase import Phrase
from service.http.admission import is_stop, note_known
from service.http.hosts import own_names
from service.http.problems import Problem, problem_response
from service.server.api.access.headers import (
    Headers,
    address_of,
    is_here,
    read_headers,
    read_secret,
    refuse_foreign_page,
)
from service.server.fleet.agent_client import AT_THE_SERVER, OrderContext
from service.server.fleet.machine_stops import MachineStops
from service.server.stop_socket import StopSockets
from service.server.stoppers import StopperFile
from service.settings import ServerSettings

_WORDS = "|".join(Stop)
_OF_MACHINE = re.compile(rf"/v1/machines/(?P<machine>[^/]+)/control/(?P<stop>{_WORDS})")
_OF_RUN = re.compile(rf"/v1/runs/(?P<run>[^/:]+):(?P<stop>{Stop.HOLD}|{Stop.ABORT})")


class StandbyApp:
    """ASGI. Answers are the server's; one about a run is as its mill's agent has it."""

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
        context = OrderContext(
            name=AT_THE_SERVER,
            origin=address_of(scope, behind_proxy=self._behind_proxy),
            arrived_s=suspend_aware_clock_s(),
        )
        if (stopper := self._stoppers.find(read_secret(headers))) is not None:
            note_known(scope)
            return replace(context, name=stopper.name)
        if self._behind_proxy or not is_here(scope, headers):
            raise Problem(401, Phrase("a token is needed: Authorization: Bearer cm_..."), field="Authorization")
        return context

    async def _stop(self, path: str, context: OrderContext) -> dict[str, Any]:
        if found := _OF_MACHINE.fullmatch(path):
            order = await self._stops.stop_machine(found["machine"], Stop(found["stop"]), context)
            return order.model_dump(mode="json")
        if found := _OF_RUN.fullmatch(path):
            view = await self._stops.stop_run_anywhere(found["run"], Stop(found["stop"]), context)
            return view | {"id": found["run"]}
        raise Problem(404, Phrase("no such address"))
