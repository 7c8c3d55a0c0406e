"""Stops of mills: hold, abort, jog-cancel.

Theory of operation. Between the request and the agent there is memory only: the link of each machine. A stop leaves
before anything waits for a database, a thread, a lock or a profile file. Only then are the profiles read, for a moment,
in case the agent has moved. A stop that may be meant for two agents goes to both: it costs little to stop a mill that
did not need it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Iterable
from typing import Any, TypeVar

from machines.mill.orders import Stop
from service.http.problems import Problem, ServerCode
from service.server.fleet.agent_client import AgentLink, AgentLinks, Json, OrderContext
from service.server.fleet.agent_replies import AgentAwayError, make_order_view, require_answer
from service.server.schemas.runs import OrderView

T = TypeVar("T")
_LOOK_S = 0.2  # time to read the profiles before the answer: a page without an answer after 0.3 s repeats a stop
_RENEW_S = 1.0  # the same if the known agent does not answer


class MachineStops:
    def __init__(self, links: AgentLinks) -> None:
        self._links = links
        self._behind: set[asyncio.Future[Any]] = set()  # tasks that continue after the answer

    async def stop_machine(self, machine: str, stop: Stop, context: OrderContext) -> OrderView:
        """Stop a machine; try twice if no answer comes. Problem 404 if there is no such machine, 503 or 504 for no
        answer.
        """
        self._links.stopped_s[machine] = context.arrived_s
        path = f"/v1/control/{stop.value}"
        known = self._links.get_known_link(machine)
        if known is None:
            known = await self._find_present_link(machine, None)
            answer = await require_answer(known.send_urgent(path, headers=context.headers()), stop)
            return make_order_view(machine, stop.value, answer)
        sending = self._start_task(known.send_urgent(path, headers=context.headers()))
        present = self._start_task(self._stop_present(machine, known, path, context))
        await asyncio.wait({present}, timeout=_LOOK_S)
        waiting: set[asyncio.Future[Any]] = {sending, present}
        await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        if present.done() or sending.exception() is not None:
            sending = await present or sending
        return make_order_view(machine, stop.value, await require_answer(sending, stop))

    async def _stop_present(
        self, machine: str, known: AgentLink, path: str, context: OrderContext
    ) -> asyncio.Future[Json] | None:
        """Send the stop to the present address of the mill's agent; None if that is the known one."""
        present = await self._find_present_link(machine, known)
        return None if present is known else self._start_task(present.send_urgent(path, headers=context.headers()))

    async def stop_run_anywhere(self, run_id: str, stop: Stop, context: OrderContext) -> Json:
        """Stop a run at the mill that has it; return its agent's view of it. Problem 404, 409, 503, 504."""
        answers = await self.ask_agents(run_id, stop, context)
        for _, answer in answers:
            if isinstance(answer, dict):
                return answer
        raise find_refusal(run_id, stop, answers)

    async def ask_agents(
        self, run_id: str, stop: Stop, context: OrderContext
    ) -> list[tuple[AgentLink, Json | BaseException]]:
        """Send a stop of a run, by our id of it, to all agents: the one that has it knows the id. Return each one's
        answer.
        """
        for machine in self._links.links:
            self._links.stopped_s[machine] = context.arrived_s
        path = f"/v1/runs/{run_id}:{stop.value}"
        links = await self._list_links()
        answers = await asyncio.gather(
            *(link.send_urgent(path, headers=context.headers()) for link in links), return_exceptions=True
        )
        return list(zip(links, answers, strict=True))

    async def _find_present_link(self, machine: str, known: AgentLink | None) -> AgentLink:
        """Return the link by the present profiles; the known one if reading them takes too long."""
        looking = self._start_task(self._links.renew_link(machine))
        await asyncio.wait({looking}, timeout=_RENEW_S if known is not None else None)
        if not looking.done() or (known is not None and looking.exception() is not None):
            assert known is not None
            return known
        return looking.result()

    async def _list_links(self) -> list[AgentLink]:
        known, _ = await self._links.list_machines()
        return [self._links.get_link(machine) for machine in known.values()]

    def _start_task(self, work: Awaitable[T]) -> asyncio.Future[T]:
        task = asyncio.ensure_future(work)
        self._behind.add(task)
        task.add_done_callback(self._forget)
        return task

    def _forget(self, task: asyncio.Future[Any]) -> None:
        self._behind.discard(task)
        if not task.cancelled():
            task.exception()  # retrieve it, or asyncio logs it: perhaps no one awaits the task any more


def find_refusal(run_id: str, stop: Stop, answers: Iterable[tuple[AgentLink, Json | BaseException]]) -> Problem:
    """Return why no agent has stopped a run."""
    errors = [answer for _, answer in answers]
    refused = next((error for error in errors if isinstance(error, Problem) and error.status == 409), None)
    away = next((error for error in errors if isinstance(error, AgentAwayError)), None)
    unknown = Problem(404, f"no agent knows run {run_id}", field="run", code=ServerCode.RUN_UNKNOWN)
    return refused or (away.problem(stop) if away else unknown)
