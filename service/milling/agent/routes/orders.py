"""/v1/control, /v1/grants, /v1/lease, /v1/orders: an operator's orders outside a run, the right to give them, and their
log. Stops are accepted at any time.
"""

from __future__ import annotations

from collections.abc import Callable

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from machines.mill.commands import describe_effect
from machines.mill.mill import Mill
from machines.mill.orders import GRANT_S, LEASE_S, Stop
from phrases.phrase import Phrase
from service.http.problems import Problem, ServerCode
from service.http.schema import Body
from service.milling.agent.agent import Agent
from service.milling.agent.requests import read_body, read_caller, read_control
from service.milling.api import ORDERS, PLAIN_ORDERS, BlockBody, GrantBody, GrantView, LeaseBody

_STOPS = frozenset(Stop)


class ControlRoutes:
    def __init__(self, agent: Agent) -> None:
        self._agent = agent

    def routes(self) -> list[Route]:
        return [Route("/v1/control/{what}", self.order, methods=["POST"])]

    async def order(self, request: Request) -> Response:
        what = request.path_params["what"]
        access, caller = self._agent.access, read_caller(request)
        if what in _STOPS:  # before the body is read: nothing in it could matter
            await access.halt(Stop(what), caller)
        elif what == "resume":
            await read_body(request, Body)
            await access.order("resume", Mill.resume, caller, needs_lease=True)
        else:
            await access.order(what, await _read_order(request, what), caller, needs_lease=True)
        return JSONResponse(access.status(), status_code=202)


async def _read_order(request: Request, what: str) -> Callable[[Mill], None]:
    if what in PLAIN_ORDERS:
        await read_body(request, Body)
        command = PLAIN_ORDERS[what]()
        return lambda mill: mill.command(command)
    if what not in ORDERS:
        allowed = ", ".join(sorted([*_STOPS, *ORDERS, *PLAIN_ORDERS, "resume"]))
        raise Problem(404, f"no control '{what}'; allowed: {allowed}")
    body = await read_body(request, ORDERS[what])
    act = body.make_act()
    if isinstance(body, BlockBody) and not body.confirm and (effect := describe_effect(body.text)):
        effect = Phrase("'{text}' {effect}", text=body.text.strip(), effect=effect)
        words = Phrase('{effect}. To send it anyway, send it again with "confirm": true', effect=effect)
        raise Problem(409, words, field="confirm", code=ServerCode.CONFIRM, more={"effect": effect})
    return act


_MOST_ORDERS = 500


class OrderRoutes:
    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._orders = agent.access.orders

    def routes(self) -> list[Route]:
        return [
            Route("/v1/grants", self.grant, methods=["POST"]),
            Route("/v1/lease", self.take, methods=["POST"]),
            Route("/v1/lease/check", self.check, methods=["POST"]),
            Route("/v1/lease", self.release, methods=["DELETE"]),
            Route("/v1/orders", self.list_orders, methods=["GET"]),
        ]

    async def grant(self, request: Request) -> Response:
        """Grant one order, which may be carried out under it for a moment from now on."""
        body = await read_body(request, GrantBody)
        grant = self._orders.issue_grant(read_control(request), stops_seen=body.stops)
        view = GrantView(grant=grant.word, valid_s=GRANT_S, stops=grant.stops)
        return JSONResponse(dict(view), status_code=201)

    async def take(self, request: Request) -> Response:
        body, shown = await read_body(request, LeaseBody), read_control(request)
        secret, lease, new = self._orders.take_lease(body.operator, body.principal, shown, take_over=body.take_over)
        await self._agent.access.call(lambda mill: mill.publish())
        view = lease.as_dict() | {"control": secret, "expires_s": LEASE_S}
        return JSONResponse(view, status_code=201 if new else 200)

    async def check(self, request: Request) -> Response:
        """Raise OrderRefusedError if somebody else than the caller has control."""
        self._orders.require_free(read_control(request))
        return Response(status_code=204)

    async def release(self, request: Request) -> Response:
        """Release control, if it was the caller's. OrderRefusedError if it is somebody else's."""
        control = read_control(request)
        if not self._orders.release_lease(control):
            self._orders.require_free(control)
        await self._agent.access.call(lambda mill: mill.publish())
        return Response(status_code=204)

    async def list_orders(self, request: Request) -> Response:
        """List orders, stops, and their results, newest first."""
        before, limit = _number(request, "before", 1 << 53), _number(request, "limit", 50)
        limit = max(1, min(limit, _MOST_ORDERS))
        entries = await self._agent.access.work(lambda: self._agent.audit.read(before, limit))
        return JSONResponse({"orders": entries, "next": entries[-1]["number"] if len(entries) == limit else None})


def _number(request: Request, name: str, default: int) -> int:
    text = request.query_params.get(name)
    if text is None:
        return default
    if not (text.isascii() and text.isdigit() and len(text) <= 16):
        raise Problem(422, f"{name} is {text[:40]!r}; allowed: a whole number", field=name)
    return int(text)
