"""/v1/control: what an operator can ask of the mill beside a run. Stops are taken at any time."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from machines.driver import Command
from machines.mill.commands import describe_effect
from machines.mill.mill import Mill
from machines.mill.orders import Stop
from phrases.phrase import Phrase
from service.http.problems import Problem, ServerCode
from service.http.schema import Body
from service.milling.agent.agent import Agent
from service.milling.agent.requests import read_body, read_caller
from service.milling.api import ORDERS, PLAIN_ORDERS, BlockBody

_STOPS = frozenset(Stop)


class ControlRoutes:
    def __init__(self, agent: Agent) -> None:
        self._agent = agent

    def routes(self) -> list[Route]:
        return [Route("/v1/control/{what}", self.order, methods=["POST"])]

    async def order(self, request: Request) -> Response:
        what = request.path_params["what"]
        access, caller = self._agent.access, read_caller(request)
        if what in _STOPS:  # before the body is looked at: nothing in it could matter
            await access.halt(Stop(what), caller)
        elif what == "resume":
            await read_body(request, Body)
            await access.order("resume", Mill.resume, caller, needs_lease=True)
        else:
            command = await _read_command(request, what)
            await access.order(what, lambda mill: mill.command(command), caller, needs_lease=True)
        return JSONResponse(access.status(), status_code=202)


async def _read_command(request: Request, what: str) -> Command:
    if what in PLAIN_ORDERS:
        await read_body(request, Body)
        return PLAIN_ORDERS[what]()
    if what not in ORDERS:
        allowed = ", ".join(sorted([*_STOPS, *ORDERS, *PLAIN_ORDERS, "resume"]))
        raise Problem(404, f"no control '{what}'; allowed: {allowed}")
    body = await read_body(request, ORDERS[what])
    command = body.command()
    if isinstance(body, BlockBody) and not body.confirm and (effect := describe_effect(body.text)):
        effect = Phrase("'{text}' {effect}", text=body.text.strip(), effect=effect)
        words = Phrase('{effect}. To send it all the same, send it again with "confirm": true', effect=effect)
        raise Problem(409, words, field="confirm", code=ServerCode.CONFIRM, more={"effect": effect})
    return command
