"""The agent's HTTP application: the routes behind the guard, every refusal as problem+json."""

from __future__ import annotations

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from machines.errors import MachineError
from service.http.problems import Problem, on_error, on_http_error
from service.milling.agent.agent import Agent
from service.milling.agent.auth import AgentGuard
from service.milling.agent.routes.control import ControlRoutes
from service.milling.agent.routes.mill import MillRoutes
from service.milling.agent.routes.orders import OrderRoutes
from service.milling.agent.routes.programs import ProgramRoutes
from service.milling.agent.routes.runs import RunRoutes


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
