"""People who press: on the page, whose rule is modelled here, by curl without a limit of its own, or by a script that
asks for no grant.
"""

from __future__ import annotations

from collections.abc import Awaitable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from machines.errors import MachineError
from machines.mill.orders import Stop
from service.http.problems import Problem
from service.milling.api import GrantView, RecoverBody, StartBody
from service.server.fleet.agent_client import OrderContext
from service.server.fleet.agent_replies import AgentAwayError
from service.server.fleet.orders import Stops
from service.server.fleet.representation import Surroundings
from tests.service.server.fleet.order_network import WEATHER, Weather

if TYPE_CHECKING:
    from tests.service.server.fleet.order_world import World

MACHINE = "m"
ASK_S = 2.0  # the page's rule (service/page/machine/mill_link.js)
CHECKS = frozenset({"tool", "zero", "stock", "clear"})


@dataclass
class Press:
    """One order as a person gave it."""

    number: int
    what: str
    at_s: float
    stops_before: int  # pressed by anybody until then
    control: str
    seen: str = ""
    way: str = "page"  # "curl": its moment is when its asking for a grant arrives; "bare": asks for none
    outcome: str = "under way"
    acts: int = 0


@dataclass
class StopPress:
    at_s: float
    reached_s: float | None = None
    written: bool = False
    outcome: str = "under way"


class People:
    """Gives orders and stops, and remembers what came of them."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.presses: list[Press] = []
        self.stops: list[StopPress] = []

    def press(
        self,
        what: str,
        control: str,
        weather: Weather,
        *,
        way: str,
        seen: str = "",
        body: dict[str, Any] | None = None,
    ) -> None:
        number = len(self.presses)
        press = Press(number, what, self._world.now_s(), len(self.stops), control, seen, way)
        self.presses.append(press)
        give = {"page": self._press_on_page, "curl": self._press_by_curl, "bare": self._press_bare}[way]
        self._world.network.begin(self._note_outcome(press, weather, give(press, body or {})))

    def press_stop(self, stop: Stop) -> None:
        press = StopPress(self._world.now_s())
        self.stops.append(press)

        async def send() -> None:
            server = self._world.stops
            await self._world.network.call_server(lambda: self._stop_at(server, stop, press), is_stop=True)

        self._world.network.begin(send())

    async def _stop_at(self, server: Stops, stop: Stop, press: StopPress) -> None:
        context = OrderContext(name="p", origin=f"stop {self.stops.index(press)}", arrived_s=self._world.now_s())
        try:
            await server.stop_machine(MACHINE, stop, context)
            press.outcome = "taken"
        except Problem as problem:
            press.outcome = str(problem)

    async def _note_outcome(self, press: Press, weather: Weather, giving: Awaitable[object]) -> None:
        WEATHER.set(weather)
        try:
            await giving
            press.outcome = "taken"
        except (Problem, MachineError, AgentAwayError) as error:
            press.outcome = str(error)

    async def _press_on_page(self, press: Press, body: dict[str, Any]) -> None:
        """As service/page/machine does it."""
        stops_seen = self._world.thread.snapshot.stops
        context = OrderContext(name="p", origin=str(press.number), control=press.control)

        async def ask() -> GrantView:
            arrived = OrderContext(name="p", origin="ask", control=press.control, arrived_s=self._world.now_s())
            return await self._world.orders.grant(MACHINE, arrived, stops_seen)

        granted = await self._world.network.call_server(ask)
        if self._world.now_s() - press.at_s > ASK_S:
            press.outcome = "not sent"
            raise Problem(503, "not sent")
        await self._world.network.call_server(lambda: self._give(press, body, context, granted.grant))

    async def _press_by_curl(self, press: Press, body: dict[str, Any]) -> None:
        """As `order` of docs/rest.md, without its limit: its moment is when the asking for a grant arrives."""
        context = OrderContext(name="p", origin=str(press.number), control=press.control)
        arrived = False

        async def ask() -> GrantView:
            nonlocal arrived
            if not arrived:
                arrived, press.at_s, press.stops_before = True, self._world.now_s(), len(self.stops)
            at = OrderContext(name="p", origin="ask", control=press.control, arrived_s=self._world.now_s())
            return await self._world.orders.grant(MACHINE, at)

        granted = await self._world.network.call_server(ask)
        await self._world.network.call_server(lambda: self._give(press, body, context, granted.grant))

    async def _press_bare(self, press: Press, body: dict[str, Any]) -> None:
        """An order alone, as late and as often as it comes."""
        context = OrderContext(name="p", origin=str(press.number), control=press.control)
        await self._world.network.call_server(lambda: self._give(press, body, context, ""))

    async def _give(self, press: Press, body: dict[str, Any], context: OrderContext, grant: str) -> object:
        context = OrderContext(
            name="p", origin=context.origin, control=context.control, grant=grant, arrived_s=self._world.now_s()
        )
        match press.what:
            case "start":
                begin = StartBody(operator="Ada", checks=sorted(CHECKS), setup=press.seen)
                return await self._world.controls.start(self._world.run_id, begin, Surroundings(), context)
            case "recover":
                said = RecoverBody(operator="Ada", checks=sorted(CHECKS | {"position"}), plan=press.seen)
                return await self._world.controls.recover(self._world.run_id, said, context)
            case "resume run":
                return await self._world.controls.resume(self._world.run_id, context)
        return await self._world.orders.give(MACHINE, press.what, body, context)
