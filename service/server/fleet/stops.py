"""Stops of mills and of runs, with what the database adds.

Theory of operation. Nothing of the database is waited for before a stop has left (`machine_stops`): which machine a run
is on is remembered, or all agents are asked. What the run's row says is waited for afterwards, for a moment.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from dataclasses import replace
from typing import TypeVar

from machines.mill.orders import Stop
from service.http.problems import Problem, ServerCode
from service.server.database.records import ABORTED, INTERRUPTED, PARKED
from service.server.database.runs import ENDED, RunRow, make_reason, read_reason
from service.server.fleet.agent_client import AgentLink, Json, OrderContext
from service.server.fleet.agent_replies import require_answer, run_view
from service.server.fleet.core import FleetCore, not_handed_over
from service.server.fleet.machine_stops import MachineStops, find_refusal

T = TypeVar("T")
_BOOK_S = 0.3  # for the database, after the stop has left


class Stops(MachineStops):
    """Stops of mills and of runs."""

    def __init__(self, core: FleetCore) -> None:
        super().__init__(core)
        self._core = core

    async def stop_run(self, run_id: str, stop: Stop, context: OrderContext) -> RunRow:
        """Stop as `stop_machine` the mill that has this run. Problem 404, 409 where the run is not on its mill.

        An abort also gives up a run that never reached its mill, or that its agent is no longer about.
        """
        known = self._core.known_runs.get(run_id)
        if known:
            self._core.stopped_s[known.machine] = context.arrived_s
        try:
            stopping = self._stop_known(known, stop, context) if known else self._ask_all(run_id, stop, context)
            run, view = await stopping
        except Problem as problem:
            if stop is not Stop.ABORT or problem.status not in (404, 409):
                raise
            return await self._give_up(run_id, problem)
        writing = self._start_task(self._core.do(self._core.runs.record_report, run, run_view(view, run.machine)))
        return await self.wait_briefly(writing, _apply_view(run, view))

    async def wait_briefly(self, work: Awaitable[T], otherwise: T) -> T:
        """Return what comes of work that may wait for a database; it goes on where that takes too long."""
        task = self._start_task(work)
        await asyncio.wait({task}, timeout=_BOOK_S)
        return task.result() if task.done() and task.exception() is None else otherwise

    # ------------------------------------------------------------------

    async def _stop_known(self, run: RunRow, stop: Stop, context: OrderContext) -> tuple[RunRow, Json]:
        path = f"/v1/runs/{run.agent_run}:{stop.value}"
        link = self._core.known_link(run.machine) or await self._find_present_link(run.machine, None)
        return run, await require_answer(link.send_urgent(path, headers=context.headers()), stop)

    async def _ask_all(self, run_id: str, stop: Stop, context: OrderContext) -> tuple[RunRow, Json]:
        """Ask all agents for a run that this process has not seen yet, by our id. Problem where none of them has it."""
        answers = await self.ask_agents(run_id, stop, context)
        for link, answer in answers:
            if isinstance(answer, dict):
                row = self._core.do(self._core.runs.get, run_id)
                return await self.wait_briefly(row, _make_row(run_id, link, answer)), answer
        run = await self._core.get_row(run_id)
        if run.agent_run is None:
            raise not_handed_over(run)
        raise find_refusal(run_id, stop, answers)

    async def _give_up(self, run_id: str, problem: Problem) -> RunRow:
        run = await self._core.get_row(run_id)
        if run.agent_run is None and run.open:
            await self._close(run, "taken back before it was handed over")
            return await self._core.get_row(run_id)
        seen = await self._core.look_at(run)
        if seen.away or not seen.open or seen.state not in (PARKED, INTERRUPTED):
            if not seen.away and not seen.open and run.agent_run is not None:
                return seen
            raise problem
        words, values = f"given up while its agent had it as {seen.state}", {"state": seen.state}
        await self._close(run, words, make_reason(ServerCode.RUN_GIVEN_UP, values))
        return await self._core.get_row(run_id)

    async def _close(self, run: RunRow, words: str, reason: Json | None = None) -> None:
        await self._core.do(self._core.runs.close, run.id, ABORTED, words, reason)


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
        view=view,
        **read_reason(view),
        created_by="",
        created_at=float(view.get("created_s") or 0.0),
    )
