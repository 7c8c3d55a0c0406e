"""Orders beside a run: jog, home, zero and the like, from the person who has control of the mill.

Theory of operation. An order is good for the moment in which it was given. It is sent once, to the agent where it was
met last, and only while it is fresh: one that waited too long, for another order or for the agent to be found, is
refused and nothing of it comes true later. Orders of one mill leave one after the other, and who has control is looked
at last, when nothing but the wire is between us and the agent: after a take-over no order of the former holder leaves.
What stops the mill asks for none of this.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from service.fleet.agent_link import ASK_S, AgentAwayError, AgentLink, Json
from service.fleet.core import FleetCore
from service.fleet.lease_book import HeldError, Lease, LeaseBook
from service.fleet.views import lease_json, mill_json
from service.web.problems import Problem

HEADER = "Causticmill-Control"
URGENT = ("hold", "abort", "jog-cancel")
_FRESH_S = 2.0  # an order that could not leave within this time is not meant any more
_ANSWER_S = 6.0  # more than the agent takes to carry an order out or to take it back


class Orders:
    """Who has control of the mills of this fleet, and what they say."""

    def __init__(self, core: FleetCore, leases: LeaseBook) -> None:
        self._core = core
        self._leases = leases
        self._turns: dict[str, asyncio.Lock] = {}

    # ------------------------------------------------------------------ control

    async def holder(self, machine: str) -> Lease | None:
        return await self._core.do(self._leases.holder, machine)

    async def take(
        self, machine: str, operator: str, principal: str, shown: str, *, take_over: bool
    ) -> tuple[Json, bool]:
        """Control of a machine, and whether it is new. Problem 409 where another person has it."""
        await self._core.machine(machine)
        try:
            secret, lease, new = await self._core.do(
                self._leases.take, machine, operator, principal, shown, take_over=take_over
            )
        except HeldError as error:
            raise _held(machine, error.lease) from None
        return lease_json(lease, secret), new

    async def release(self, machine: str, shown: str) -> None:
        """Nobody has control, if it was the caller who had it. Problem 409 where it is somebody else."""
        await self._core.machine(machine)
        given: bool = await self._core.do(self._leases.release, machine, shown)
        if not given and (lease := await self.holder(machine)) is not None:
            raise _held(machine, lease, lost=bool(shown))

    @asynccontextmanager
    async def turn(self, machine: str, shown: str, *, alone: bool = False) -> AsyncIterator[None]:
        """The one moment in which an order to this mill may leave. Problem 409, or 503 where it does not come in time.

        alone : without control nothing may be ordered even where nobody has it
        """
        lock = self._turns.setdefault(machine, asyncio.Lock())
        try:
            async with asyncio.timeout(_FRESH_S):
                await lock.acquire()
        except TimeoutError:
            words = f"another order to '{machine}' is still on its way; this one was not sent"
            raise Problem(503, words, field="machine", headers={"Retry-After": "2"}) from None
        try:
            await self._require(machine, shown, alone=alone)
            yield
        finally:
            lock.release()

    async def _require(self, machine: str, shown: str, *, alone: bool) -> None:
        """Problem 409 where the mill is in other hands, or in none and it has to be in the caller's."""
        kept: bool = bool(shown) and await self._core.do(self._leases.keep, machine, shown)
        if kept:
            return
        lease = await self.holder(machine)
        if lease is not None:
            raise _held(machine, lease, lost=bool(shown))
        if shown:
            words = f"you had control of '{machine}' and have not been heard of for too long: take control again"
            raise Problem(409, words, field=HEADER, more={"control": None})
        if alone:
            words = f"nobody has control of '{machine}': take control first"
            raise Problem(409, words, field=HEADER, more={"control": None})

    # ------------------------------------------------------------------ orders

    async def stop(self, machine: str, what: str) -> Json:
        """Hold, abort, jog-cancel: taken from everybody at any time; sent again where no answer came."""
        link = await self._core.link_named(machine)
        try:
            status = await link.urgent(f"/v1/control/{what}")
        except AgentAwayError as away:
            raise _unknown(away, what) if away.sent else away.problem() from None
        return _told(machine, what, status)

    async def give(self, machine: str, what: str, body: Json, shown: str) -> Json:
        """Any other order, from the holder of control."""
        link = self._core.link(await self._core.machine(machine))
        await self._require(machine, shown, alone=True)  # told at once, before anything is waited for
        await _met(link)
        async with self.turn(machine, shown, alone=True):
            try:
                status = await link.once(f"/v1/control/{what}", body, timeout_s=_ANSWER_S)
            except AgentAwayError as away:
                raise _unknown(away, what) if away.sent else away.problem() from None
        return _told(machine, what, status)


async def _met(link: AgentLink) -> None:
    """The agent's address is known. Nothing has been sent when this fails."""
    try:
        async with asyncio.timeout(ASK_S):
            await link.address()
    except AgentAwayError as away:
        raise away.problem() from None
    except TimeoutError:
        raise AgentAwayError(f"the agent of '{link.machine.name}' was not found in time").problem() from None


def _told(machine: str, what: str, status: Json) -> Json:
    return {"machine": machine, "order": what, "mill": mill_json(status)}


def _unknown(away: AgentAwayError, what: str) -> Problem:
    words = f"{away.words}; whether the {what} arrived is not known, it is not sent again: LOOK AT THE MILL"
    return Problem(504, words, field="machine")


def _held(machine: str, lease: Lease, *, lost: bool = False) -> Problem:
    told = lease_json(lease)
    begin = "you have lost control: " if lost else ""
    words = f"{begin}{lease.operator} has had control of '{machine}' since {told['since']}; ask them, or take over"
    return Problem(409, words, field=HEADER, more={"control": told})
