"""A WebSocket for stops only: a browser does not count it among its six connections to a server.

The page first identifies itself, {"token": "cm_..."} (on the server's own computer "" is enough), and may then stop any
mill: {"id": 1, "machine": "shop-mill", "what": "hold"} is answered {"id": 1, "taken": true, ...}. A heartbeat every few
seconds shows that the connection works.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from machines.clock import suspend_aware_clock_s
from machines.mill.orders import Stop
from phrases.phrase import Phrase, phrases_in
from service.http.admission import note_known
from service.http.problems import Problem
from service.server.api.access.requests import address_of, is_here, read_headers, refuse_foreign_page
from service.server.fleet.agent_client import AT_THE_SERVER, OrderContext
from service.server.fleet.machine_stops import MachineStops
from service.server.stoppers import Stopper

PATH = "/v1/stops"
_BEAT_S = 5.0
_MOST = 500
_NOT_KNOWN, _MAKE_ROOM = 4401, 1013


def identify_stopper(
    scope: Scope, secret: str, find_stopper: Callable[[str], Stopper | None], *, behind_proxy: bool
) -> OrderContext | None:
    """Return the caller of a stop; None if the caller may not stop mills.

    find_stopper : whose token may stop mills
    """
    name = None if (stopper := find_stopper(secret)) is None else stopper.name
    if name is None and not behind_proxy and is_here(scope, dict(scope["headers"])):
        name = AT_THE_SERVER
    if name is None:
        return None
    origin = address_of(scope, behind_proxy=behind_proxy)
    return OrderContext(name=name, origin=origin, arrived_s=suspend_aware_clock_s())


class StopSockets:
    """ASGI, of WebSockets only.

    find_stopper : finds the owner of a token that may stop mills; names: of this server
    """

    def __init__(
        self,
        stops: MachineStops,
        find_stopper: Callable[[str], Stopper | None],
        *,
        names: frozenset[str],
        behind_proxy: bool,
    ) -> None:
        self._stops = stops
        self._find_stopper = find_stopper
        self._names = names
        self._behind_proxy = behind_proxy
        self.open: dict[int, WebSocket] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one socket until it is closed."""
        try:
            headers = read_headers(scope, self._names)
            refuse_foreign_page(scope, headers, behind_proxy=self._behind_proxy)
            if scope["path"] != PATH:
                raise Problem(404, Phrase("no such address"))
        except Problem:
            await send({"type": "websocket.close", "code": 1008})
            return
        await self._serve(WebSocket(scope, receive, send))

    async def _serve(self, socket: WebSocket) -> None:
        await socket.accept()
        try:
            first = _object(await socket.receive_text())  # a stranger keeps its place only for a while
            secret = str(first.get("token", ""))
            context = identify_stopper(socket.scope, secret, self._find_stopper, behind_proxy=self._behind_proxy)
            if context is None:
                await socket.close(_NOT_KNOWN, "a token with machine:run is needed")
                return
            note_known(socket.scope)
            await self._listen(socket, context)
        except WebSocketDisconnect:
            pass  # the page has gone
        except (RuntimeError, KeyError):  # starlette raises them for a closed socket, and for bytes instead of text
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await socket.close()

    async def _listen(self, socket: WebSocket, context: OrderContext) -> None:
        await self._make_room()
        self.open[id(socket)] = socket
        beating = asyncio.create_task(_send_beats(socket))
        under_way: set[asyncio.Task[None]] = set()
        try:
            await socket.send_json({"ready": True})
            while True:
                asked = _object(await socket.receive_text())
                pressed = replace(
                    context, arrived_s=suspend_aware_clock_s()
                )  # the time of the press, not of opening the socket
                task = asyncio.create_task(self._stop(socket, pressed, asked))  # no stop waits for the one before
                under_way.add(task)
                task.add_done_callback(under_way.discard)
        finally:
            beating.cancel()
            self.open.pop(id(socket), None)

    async def _stop(self, socket: WebSocket, context: OrderContext, asked: dict[str, Any]) -> None:
        answer: dict[str, Any] = {"id": asked.get("id")}
        what, machine = str(asked.get("what")), str(asked.get("machine"))[:100]
        try:
            if what not in set(Stop):
                words = Phrase("what is {value}; allowed: {allowed}", value=repr(what[:40]), allowed=", ".join(Stop))
                raise Problem(422, words, field="what")
            order = await self._stops.stop_machine(machine, Stop(what), context)
            answer |= {"taken": True} | order.model_dump(mode="json")
        except Problem as problem:
            answer |= {"taken": False, "detail": problem.detail, "code": problem.code, "values": problem.values}
            answer |= {"phrases": phrases_in(problem.detail)}
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.send_json(answer)

    async def _make_room(self) -> None:
        """Close the socket that has been open longest: its page opens a new one."""
        while len(self.open) >= _MOST:
            oldest = self.open.pop(next(iter(self.open)))
            with contextlib.suppress(RuntimeError):
                await oldest.close(_MAKE_ROOM)


async def _send_beats(socket: WebSocket) -> None:
    number = 0
    with contextlib.suppress(RuntimeError, WebSocketDisconnect):
        while True:
            await asyncio.sleep(_BEAT_S)
            number += 1
            await socket.send_json({"beat": number})


def _object(text: str) -> dict[str, Any]:
    with contextlib.suppress(ValueError, RecursionError):
        if isinstance(found := json.loads(text), dict):
            return found
    return {}
