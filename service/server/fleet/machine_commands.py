"""Orders to a mill from the person who has control of it, each under a grant of the mill's agent.

Theory of operation. An order is good for the moment in which it was given. The page asks for a grant when a button is
pressed and sends the order with it; the agent carries it out within seconds, once, and only if nobody has stopped the
mill or taken control since. Nothing here decides whether an order is still for now: it may wait for a database, a
thread or a network as long as it likes, and then the agent refuses it, as it refuses one without a grant. The asking
for a grant is what can be late: one that has waited for more than ASK_S since it arrived, or past a stop, is refused.
"""

from __future__ import annotations

from collections.abc import Callable

from machines.clock import suspend_aware_clock_s
from machines.mill.orders import LEASE_S, Refusal
from service.http.problems import Problem
from service.milling.api import GrantView
from service.server.fleet.agent_client import AgentLink, Json, require_answer
from service.server.fleet.agent_replies import make_order_view, parse_holder, parse_reply
from service.server.fleet.core import FleetCore
from service.server.fleet.order_context import OrderContext
from service.server.schemas.runs import ControlView, OrderView

ASK_S = 2.0  # from the request's arrival to the grant
_ANSWER_S = 6.0  # more than the agent takes to carry an order out or to take it back


class Orders:
    """Who has control of the mills of this fleet, and what they say."""

    def __init__(self, core: FleetCore, clock: Callable[[], float] = suspend_aware_clock_s) -> None:
        self._core = core
        self._clock = clock

    # ------------------------------------------------------------------ control

    async def take(
        self, machine: str, context: OrderContext, operator: str, *, take_over: bool
    ) -> tuple[ControlView, bool]:
        """Take control of a machine; return it and whether it is new. Problem 409 where another person has it."""
        link = self._core.get_link(await self._core.find_machine(machine))
        body = {"operator": operator, "principal": context.name, "take_over": take_over}
        lease = await require_answer(link.send_once("/v1/lease", body, timeout_s=_ANSWER_S, headers=context.headers()))
        secret = str(lease.get("control", ""))
        control = ControlView(**dict(parse_holder(lease)), control=secret, expires_s=LEASE_S)
        return control, secret != context.control

    async def release(self, machine: str, context: OrderContext) -> None:
        """Release control, if it was the caller who had it. Problem 409 where it is somebody else's."""
        link = self._core.get_link(await self._core.find_machine(machine))
        await require_answer(link.delete("/v1/lease", headers=context.headers()))

    # ------------------------------------------------------------------ orders

    async def grant(self, machine: str, context: OrderContext, stops: int | None = None) -> GrantView:
        """Ask for a grant for the caller's next order. Problem 409 where the mill is in other hands, or was stopped
        since the caller has seen this stop count.
        """
        link = self._core.get_link(await self._core.find_machine(machine))
        return parse_reply(GrantView, await require_answer(self._ask_grant(link, context, stops)), machine)

    async def give(self, machine: str, what: str, body: Json, context: OrderContext) -> OrderView:
        """Carry out an order beside a run, from the holder of control. Problem 504 where it is not known what came of
        it.
        """
        link = self._core.get_link(await self._core.find_machine(machine))
        sending = link.send_once(f"/v1/control/{what}", body, timeout_s=_ANSWER_S, headers=context.headers())
        return make_order_view(machine, what, await require_answer(sending, what))

    # ------------------------------------------------------------------

    async def _ask_grant(self, link: AgentLink, context: OrderContext, stops: int | None) -> Json:
        """Ask the agent for a grant; it counts if the request is still for now and no stop has come by since.
        AgentAwayError.
        """
        body = {} if stops is None else {"stops": stops}
        granted = await link.send_once("/v1/grants", body, timeout_s=ASK_S, headers=context.headers())
        if self._core.stopped_s.get(link.machine.name, 0.0) >= context.arrived_s:
            words = "the mill was stopped since: there is no grant for what was ordered before"
            raise Problem(409, words, field="machine", code=Refusal.STOPPED)
        if self._clock() - context.arrived_s <= ASK_S:
            return granted
        raise Problem(
            503,
            f"this has waited for more than {ASK_S:g} s: no grant was given; give the order again",
            field="machine",
            code=Refusal.EXPIRED,
            headers={"Retry-After": "2"},
        )
