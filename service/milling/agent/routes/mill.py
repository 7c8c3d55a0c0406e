"""/v1/status, /v1/events, /v1/machine: what is known of the mill."""

from __future__ import annotations

import dataclasses

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from service.http.event_hub import HubStream, Reader
from service.milling.agent.agent import Agent


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
        return HubStream(hub, reader, lambda: hub.add(reader, last), heartbeat_s=self._agent.settings.heartbeat_s)

    async def machine(self, _request: Request) -> Response:
        settings = self._agent.settings
        profile = dataclasses.asdict(self._agent.profile)
        return JSONResponse({"name": settings.machine, "port": settings.port_url, "profile": profile})
