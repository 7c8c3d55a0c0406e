"""Hands a program over: first the row, then the program by its hash, then a parked run with the row's id as its key.

Each step can be repeated without harm, so a server that finds a run still being prepared continues with it: this one
after a lost answer, or the next one after a crash. None of this moves the mill: a parked run waits for a person.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncIterator, Iterator

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.server.database.records import PREPARING, REFUSED, ClientKey, Job, UnknownJobError
from service.server.database.runs import JobNotReadyError, MachineTakenError, RunRow, make_reason
from service.server.fleet.agent_client import AgentLink
from service.server.fleet.agent_replies import AgentAwayError, run_view
from service.server.fleet.core import FleetCore
from service.server.fleet.registry import KnownMachine
from service.server.fleet.representation import Program, programs_of
from service.store.base import MissingObjectError

ANSWER_WITHIN_S = 20.0
_PREFLIGHT_S = 1800.0  # a program of gigabytes is read whole


class Handovers:
    """One task for each run that is being prepared by this process."""

    def __init__(self, core: FleetCore) -> None:
        self._core = core
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._untried: set[str] = set()  # runs made here that no agent can know yet

    async def begin(
        self,
        machine: KnownMachine,
        job_id: str,
        wanted: int | str | None,
        by: str,
        key: ClientKey | None,
        *,
        lift_mm: float | None = None,
    ) -> RunRow:
        """Make the run, or find the one that this key has made. Problem if it is not allowed."""
        what = (machine.name, job_id, wanted) if lift_mm is None else (machine.name, job_id, wanted, lift_mm)
        asked = hashlib.sha256(repr(what).encode()).hexdigest()
        core = self._core
        if key is not None and (before := await core.do(core.runs.find_made_before, key, asked)) is not None:
            return before
        program = await self._choose_program(machine, job_id, wanted)
        if (other := await core.do(core.runs.open_on, machine.name)) is not None:
            await core.look_at(other)  # it may have ended since the last look
        new = RunRow(
            machine=machine.name, job_id=job_id, program=program.name, number=program.number, sha256=program.sha256,
            lift_mm=lift_mm, created_by=by,
        )  # fmt: skip
        try:
            run, fresh = await core.do(core.runs.create, new, key, asked)
        except MachineTakenError as error:
            raise Problem(409, str(error), field="machine") from None
        except JobNotReadyError as error:
            raise Problem(409, str(error), field="job") from None
        except UnknownJobError:
            raise _no_job(job_id) from None
        if fresh:
            self._untried.add(run.id)
        return run

    async def finish(self, run: RunRow, machine: KnownMachine) -> RunRow:
        """Continue until the run is parked, or for 20 s; Problem if it cannot be handed over."""
        if run.state != PREPARING or not run.open:
            return run
        task = self.go_on(run, machine)
        await asyncio.wait({task}, timeout=ANSWER_WITHIN_S)
        if task.done() and not task.cancelled() and (error := task.exception()) is not None:
            if isinstance(error, Problem):
                raise error
            if not isinstance(error, AgentAwayError):
                raise error
        return await self._core.do(self._core.runs.get, run.id)

    def go_on(self, run: RunRow, machine: KnownMachine) -> asyncio.Task[None]:
        """Return the task that hands this run over: the running one, or a new one."""
        task = self._tasks.get(run.id)
        if task is None or task.done():
            self._tasks = {key: other for key, other in self._tasks.items() if not other.done()}
            task = self._tasks[run.id] = asyncio.create_task(self._hand_over(run, machine))
            task.add_done_callback(_look_at)
        return task

    async def repair(self, run: RunRow) -> RunRow:
        """Continue an interrupted hand-over; return the present state of the run without waiting."""
        if run.state != PREPARING or not run.open:
            return run
        try:
            task = self.go_on(run, await self._core.find_machine(run.machine))
        except Problem:  # its profile is gone
            return run
        await asyncio.wait({task}, timeout=0.2)
        return await self._core.do(self._core.runs.get, run.id)

    async def close(self) -> None:
        for task in self._tasks.values():
            task.cancel()
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)

    # ------------------------------------------------------------------

    async def _choose_program(self, machine: KnownMachine, job_id: str, wanted: int | str | None) -> Program:
        core = self._core
        try:
            job: Job = await core.do(core.jobs.get, job_id)
            programs = programs_of(await core.do(core.jobs.list_artifacts, job_id))
        except UnknownJobError:
            raise _no_job(job_id) from None
        if not await core.do(core.jobs.may_be_milled, job):
            raise Problem(409, str(JobNotReadyError(job)), field="job")
        if wanted is None:
            done = await core.do(core.runs.list_finished, job_id, machine.name)
            return _next(programs, done, machine.name)
        for program in programs:
            if wanted in (program.number, program.name):
                return program
        allowed = ", ".join(f"{one.number} ({one.name})" for one in programs) or "none"
        raise Problem(
            422,
            Phrase(
                "program {wanted} is not one of this job's; allowed: {allowed}",
                wanted=repr(str(wanted)[:100]),
                allowed=allowed,
            ),
            field="program",
        )

    async def _hand_over(self, run: RunRow, machine: KnownMachine) -> None:
        """Hand over. AgentAwayError leaves the run as it is, to be continued later; a refusal closes it."""
        link, posted = self._core.get_link(machine), False
        try:
            await self._bring(link, run)
            posted = True
            body: dict[str, object] = {"program": run.sha256, "name": run.program, "key": run.id}
            body |= {} if run.lift_mm is None else {"lift_mm": run.lift_mm}
            view = run_view(await link.post("/v1/runs", body, timeout_s=_PREFLIGHT_S), run.machine)
        except Problem as problem:
            await self._refuse(run, problem)
            raise
        except AgentAwayError as away:
            if (posted and away.sent) or run.id not in self._untried:
                raise
            refusal = away.problem()
            await self._refuse(run, refusal)  # the agent certainly has nothing of it
            raise refusal from None
        finally:
            self._untried.discard(run.id)
        if not await self._core.do(self._core.runs.confirm_parked, run.id, view):
            await link.post(f"/v1/runs/{view['id']}:abort")  # taken back while it was being sent

    async def _refuse(self, run: RunRow, problem: Problem) -> None:
        reason = make_reason(problem.code, problem.values)
        await self._core.do(self._core.runs.close, run.id, REFUSED, problem.detail, reason, forget_key=True)

    async def _bring(self, link: AgentLink, run: RunRow) -> None:
        """Send the program to the agent's own store, which checks its hash."""
        try:
            await link.get(f"/v1/programs/{run.sha256}")
            return
        except Problem as problem:
            if problem.status != 404:
                raise
        store = self._core.store
        try:
            size = (await self._core.do(store.head, run.sha256)).bytes
            pieces = await self._core.do(store.open_range, run.sha256)
        except MissingObjectError as error:
            raise Problem(
                409, Phrase("the program is no longer there: {error}", error=error), field="program"
            ) from None
        await link.put(f"/v1/programs/{run.sha256}", self._stream(pieces), size)

    async def _stream(self, pieces: Iterator[bytes]) -> AsyncIterator[bytes]:
        while (piece := await self._core.do(next, pieces, b"")) != b"":
            yield piece


def _next(programs: list[Program], finished: frozenset[str], machine: str) -> Program:
    """Return the first pass that this mill has not finished."""
    for program in programs:
        if program.sha256 not in finished:
            return program
    if not programs:
        raise Problem(409, Phrase("the job has no programs"), field="job")
    words = Phrase(
        "machine '{machine}' has finished every program of this job; name one in `program` to run it again",
        machine=machine,
    )
    raise Problem(409, words, field="program")


def _no_job(job_id: str) -> Problem:
    return Problem(422, Phrase("there is no job {job}", job=repr(job_id[:80])), field="job")


def _look_at(task: asyncio.Task[None]) -> None:
    """Read the error of a task, so that asyncio does not log it: a caller who asks for the run gets it."""
    if not task.cancelled():
        task.exception()
