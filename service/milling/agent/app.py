"""The agent's HTTP application: the routes behind the guard, every refusal as problem+json; and the routes about the
mill (/v1/status, /v1/events, /v1/machine).
"""

from __future__ import annotations

import dataclasses

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from machines.errors import MachineError
from service.http.event_hub import HEARTBEAT_S, HubStream, Reader
from service.http.problems import Problem, on_error, on_http_error
from service.milling.agent.agent import Agent
from service.milling.agent.requests import AgentGuard
from service.milling.agent.routes.orders import ControlRoutes, OrderRoutes
from service.milling.agent.routes.runs import ProgramRoutes, RunRoutes


class MillRoutes:
    def __init__(self, agent: Agent) -> None:
        self._agent = agent

    def routes(self) -> list[Route]:
        return [
            Route("/v1/status", self.status, methods=["GET"]),
            Route("/v1/events", self.events, methods=["GET"]),
            Route("/v1/machine", self.machine, methods=["GET"]),
        ]

    async def status(self, _request: Request) -> Response:
        return JSONResponse(self._agent.access.status())

    async def events(self, request: Request) -> HubStream:
        hub, reader, last = self._agent.hub, Reader(), request.headers.get("last-event-id", "")
        return HubStream(hub, reader, lambda: hub.add(reader, last), heartbeat_s=HEARTBEAT_S)

    async def machine(self, _request: Request) -> Response:
        settings = self._agent.settings
        profile = dataclasses.asdict(self._agent.profile)
        return JSONResponse({"name": settings.machine, "port": settings.port_url, "profile": profile})


def make_app(agent: Agent) -> Starlette:
    async def livez(_request: Request) -> Response:
        if not agent.access.is_alive():
            raise Problem(503, "the mill's thread does not answer; use the mill's own stop button")
        return JSONResponse({"alive": True, "machine": agent.settings.machine})

    routes = [
        Route("/livez", livez, methods=["GET"]),
        *MillRoutes(agent).routes(),
        *ProgramRoutes(agent).routes(),
        *RunRoutes(agent).routes(),
        *ControlRoutes(agent).routes(),
        *OrderRoutes(agent).routes(),
    ]
    guard = Middleware(AgentGuard, token=agent.settings.token, hosts=frozenset({agent.settings.host.lower()}))
    handlers = dict.fromkeys((Problem, MachineError, OSError), on_error)
    return Starlette(
        routes=routes,
        middleware=[guard],
        exception_handlers={HTTPException: on_http_error, **handlers, Exception: on_error},
    )
