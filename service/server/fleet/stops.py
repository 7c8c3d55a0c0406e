"""Stops: hold, abort, jog-cancel. Taken from everybody who may, at any time.

Theory of operation. Between the request and the agent there is memory only: which link a machine has, which machine a
run is on. No database, no thread, no lock and no profile file is waited for before the stop has left; what they add
(where an agent has moved to, what the run's row says) is waited for afterwards, for a moment. A stop that may be meant
for two agents goes to both: to stop a mill that did not need it costs little.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from dataclasses import replace
from typing import Any, TypeVar

from machines.mill.orders import Stop
from service.http.problems import Problem, ServerCode
from service.server.database.runs import ABORTED, ENDED, INTERRUPTED, PARKED, RunRow, make_reason, read_reason
from service.server.fleet.agent_client import AgentAwayError, AgentLink, Json, require_answer
from service.server.fleet.agent_replies import run_view
from service.server.fleet.core import FleetCore, Seen, not_handed_over
from service.server.fleet.machine_commands import OrderContext
from service.server.fleet.representation import make_order_view
from service.server.schemas.control import OrderView

T = TypeVar("T")
_LOOK_S = 0.2  # for a look at the profiles before the answer: a page that has none after 0.3 s says a stop again
_RENEW_S = 1.0  # for that look where the known agent does not answer
_BOOK_S = 0.3  # for the database, after the stop has left


class Stops:
    def __init__(self, core: FleetCore) -> None:
        self._core = core
        self._behind: set[asyncio.Future[Any]] = set()  # what goes on after the answer

    async def stop_machine(self, machine: str, stop: Stop, context: OrderContext) -> OrderView:
        """Stop, twice where no answer came. Problem 404 where there is no such machine, 503 or 504 for no answer."""
        self._core.stopped_s[machine] = context.arrived_s
        path = f"/v1/control/{stop.value}"
        known = self._core.known_link(machine)
        if known is None:
            known = await self._find_present_link(machine, None)
            answer = await require_answer(known.send_urgent(path, headers=context.headers()), stop)
            return make_order_view(machine, stop.value, answer)
        sending = self._go_on(known.send_urgent(path, headers=context.headers()))
        present = self._go_on(self._stop_present(machine, known, path, context))
        await asyncio.wait({present}, timeout=_LOOK_S)
        waiting: set[asyncio.Future[Any]] = {sending, present}
        await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        if present.done() or sending.exception() is not None:
            sending = await present or sending
        return make_order_view(machine, stop.value, await require_answer(sending, stop))

    async def _stop_present(
        self, machine: str, known: AgentLink, path: str, context: OrderContext
    ) -> asyncio.Future[Json] | None:
        """Send the stop to where the mill's agent is now; None where that is the known one."""
        present = await self._find_present_link(machine, known)
        return None if present is known else self._go_on(present.send_urgent(path, headers=context.headers()))

    async def stop_run(self, run_id: str, stop: Stop, context: OrderContext) -> Seen:
        """Stop as `stop_machine` the mill that has this run. Problem 404, 409 where the run is not on its mill.

        An abort also gives up a run that never reached its mill, or that its agent is no longer about.
        """
        known = self._core.known_runs.get(run_id)
        for machine in [known.machine] if known else list(self._core.links):
            self._core.stopped_s[machine] = context.arrived_s
        try:
            stopping = self._stop_known(known, stop, context) if known else self._ask_all(run_id, stop, context)
            run, view = await stopping
        except Problem as problem:
            if stop is not Stop.ABORT or problem.status not in (404, 409):
                raise
            return await self._give_up(run_id, problem)
        writing = self._go_on(self._core.do(self._core.runs.record_report, run, run_view(view, run.machine)))
        return Seen(await self.wait_briefly(writing, _apply_view(run, view)))

    async def wait_briefly(self, work: Awaitable[T], otherwise: T) -> T:
        """Return what comes of work that may wait for a database; it goes on where that takes too long."""
        task = self._go_on(work)
        await asyncio.wait({task}, timeout=_BOOK_S)
        return task.result() if task.done() and task.exception() is None else otherwise

    # ------------------------------------------------------------------

    async def _stop_known(self, run: RunRow, stop: Stop, context: OrderContext) -> tuple[RunRow, Json]:
        path = f"/v1/runs/{run.agent_run}:{stop.value}"
        link = self._core.known_link(run.machine) or await self._find_present_link(run.machine, None)
        return run, await require_answer(link.send_urgent(path, headers=context.headers()), stop)

    async def _ask_all(self, run_id: str, stop: Stop, context: OrderContext) -> tuple[RunRow, Json]:
        """Ask all agents for a run that this process has not seen yet, by our id. Problem where none of them has it."""
        path = f"/v1/runs/{run_id}:{stop.value}"
        links = await self._list_links()
        answers = await asyncio.gather(
            *(link.send_urgent(path, headers=context.headers()) for link in links), return_exceptions=True
        )
        for link, answer in zip(links, answers, strict=True):
            if isinstance(answer, dict):
                row = self._core.do(self._core.runs.get, run_id)
                return await self.wait_briefly(row, _make_row(run_id, link, answer)), answer
        refused = next((one for one in answers if isinstance(one, Problem) and one.status == 409), None)
        run = await self._core.get_row(run_id)
        if run.agent_run is None:
            raise not_handed_over(run)
        away = next((one for one in answers if isinstance(one, AgentAwayError)), None)
        unknown = Problem(404, f"no agent knows run {run_id}", field="run", code=ServerCode.RUN_UNKNOWN)
        raise refused or (away.problem(stop) if away else unknown)

    async def _find_present_link(self, machine: str, known: AgentLink | None) -> AgentLink:
        """Return the link by the profiles as they are now; the known one where that takes too long."""
        looking = self._go_on(self._core.renew_link(machine))
        await asyncio.wait({looking}, timeout=_RENEW_S if known is not None else None)
        if not looking.done() or (known is not None and looking.exception() is not None):
            assert known is not None
            return known
        return looking.result()

    async def _list_links(self) -> list[AgentLink]:
        known, _ = await self._core.list_machines()
        return [self._core.get_link(machine) for machine in known.values()]

    async def _give_up(self, run_id: str, problem: Problem) -> Seen:
        run = await self._core.get_row(run_id)
        if run.agent_run is None and run.open:
            await self._close(run, "taken back before it was handed over")
            return Seen(await self._core.get_row(run_id))
        seen = await self._core.look_at(run)
        if seen.away or not seen.run.open or seen.run.state not in (PARKED, INTERRUPTED):
            if not seen.away and not seen.run.open and run.agent_run is not None:
                return seen
            raise problem
        words, values = f"given up while its agent had it as {seen.run.state}", {"state": seen.run.state}
        await self._close(run, words, make_reason(ServerCode.RUN_GIVEN_UP, values))
        return Seen(await self._core.get_row(run_id))

    async def _close(self, run: RunRow, words: str, reason: Json | None = None) -> None:
        await self._core.do(self._core.runs.close, run.id, ABORTED, words, reason)

    def _go_on(self, work: Awaitable[T]) -> asyncio.Future[T]:
        task = asyncio.ensure_future(work)
        self._behind.add(task)
        task.add_done_callback(self._forget)
        return task

    def _forget(self, task: asyncio.Future[Any]) -> None:
        self._behind.discard(task)
        if not task.cancelled():
            task.exception()  # told to whoever still waits; nobody may, and then it is no news


def _apply_view(run: RunRow, view: Json) -> RunRow:
    state = str(view.get("state", run.state))
    return replace(run, state=state, view=view, **read_reason(view), open=run.open and state not in ENDED)


def _make_row(run_id: str, link: AgentLink, view: Json) -> RunRow:
    """Return what is certain of a run without the database."""
    return RunRow(
        id=run_id,
        machine=link.machine.name,
        job_id="",
        program=str(view.get("name", "")),
        number=0,
        sha256=str(view.get("program", "")),
        agent_run=str(view.get("id", "")),
        state=str(view.get("state", "")),
        open=True,
        view=view,
        **read_reason(view),
        created_by="",
        created_at=float(view.get("created_s") or 0.0),
        ended_at=None,
    )
