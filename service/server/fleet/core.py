"""The common core of the fleet: the books, the links to the agents, and threads for the database."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, TypeVar

import sqlalchemy as sa

from phrases.phrase import Phrase
from service.http.problems import Problem, ServerCode
from service.server.database.jobs import JobBook
from service.server.database.records import FINISHED, LOST
from service.server.database.runs import LIVE_WORDS, RunBook, RunRow, UnknownRunError, make_reason, word_state
from service.server.fleet.agent_client import ASK_S, AgentLink, AgentLinks
from service.server.fleet.agent_replies import AgentAwayError, run_view
from service.server.fleet.registry import KnownMachine, read_machines
from service.settings import ServerSettings
from service.store.base import Store

T = TypeVar("T")
_THREADS = 8
_MOST_KNOWN = 1000


def not_handed_over(run: RunRow) -> Problem:
    words = Phrase(
        "the run is {state}: its program has not been handed over, nothing moves", state=word_state(run.state)
    )
    return Problem(409, words, field="run")


class FleetCore(AgentLinks):
    """Queries the agents and stores their answers. Moves nothing."""

    def __init__(self, settings: ServerSettings, database: sa.Engine, store: Store, jobs: JobBook) -> None:
        super().__init__(settings)
        self.store = store
        self.ending = asyncio.Event()
        self.jobs = jobs
        self.runs = RunBook(database)
        self.live_runs: set[str] = set()  # as last seen
        self.known_runs: dict[str, RunRow] = {}  # handed over: machine and the agent's id of them never change
        # Separate threads, so that an order to a mill never waits behind uploads and downloads.
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="fleet")

    async def do(self, function: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Run a call that waits for the database or a disk, off the event loop."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, lambda: function(*arguments, **named))

    async def list_machines(self) -> tuple[dict[str, KnownMachine], list[str]]:
        return await self.do(read_machines, self.settings)

    def remember(self, run: RunRow) -> RunRow:
        """Remember the machine of this run, so that a stop of it needs no database."""
        if run.agent_run is not None:
            self.known_runs.pop(run.id, None)
            while len(self.known_runs) >= _MOST_KNOWN:
                del self.known_runs[next(iter(self.known_runs))]
            self.known_runs[run.id] = run
        return run

    async def get_row(self, run_id: str) -> RunRow:
        """Return the run by the database. Problem 404 if there is none."""
        try:
            return await self.do(self.runs.get, run_id)
        except UnknownRunError as error:
            raise Problem(404, str(error), field="run") from None

    async def find_link(self, run: RunRow) -> AgentLink:
        """Return the link to the agent that has this run."""
        try:
            return self.get_known_link(run.machine) or self.get_link(await self.find_machine(run.machine))
        except Problem as gone:
            raise AgentAwayError(gone.detail, gone.code, gone.values) from None

    async def look_at(self, run: RunRow, *, timeout_s: float = ASK_S) -> RunRow:
        """Return the run as its agent has it now; store it if that is new."""
        run = await self._look_at(replace(run, away=None), timeout_s=timeout_s)
        (self.live_runs.add if run.state in LIVE_WORDS else self.live_runs.discard)(run.id)
        return run

    async def _look_at(self, run: RunRow, *, timeout_s: float) -> RunRow:
        self.remember(run)
        if run.agent_run is None or (run.state == FINISHED and not run.open) or run.state == LOST:
            return run
        try:
            link = await self.find_link(run)
            view = run_view(await link.get(f"/v1/runs/{run.agent_run}", timeout_s=timeout_s), run.machine)
        except AgentAwayError as away:
            return replace(run, away=away.problem())
        except Problem as problem:
            if problem.status != 404:
                return replace(run, away=problem)
            words = Phrase("its agent no longer knows this run")
            await self.do(self.runs.close, run.id, LOST, words, make_reason(ServerCode.RUN_LOST))
            return await self.do(self.runs.get, run.id)
        return await self.do(self.runs.record_report, run, view)

    async def await_end(self, seconds: float) -> bool:
        """Wait for that long. Return True as soon as the server ends."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self.ending.wait()
        return self.ending.is_set()

    async def close(self) -> None:
        await super().close()
        self._threads.shutdown(wait=False, cancel_futures=True)
