"""Orders to a mill, each one a person's word, passed on to its agent once.

An order whose answer was lost is not sent again: what became of it is asked. Hold and abort go out first and everything
else about them comes later.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from service.fleet.agent_link import AgentAwayError, AgentLink, Json
from service.fleet.agent_words import run_view
from service.fleet.core import FleetCore, Seen
from service.fleet.run_book import ABORTED, INTERRUPTED, PARKED, MachineTakenError, RunRow, UnknownRunError
from service.fleet.views import ORDER, Surroundings, required_checks
from service.web.problems import Problem

_MOST_KNOWN = 1000
_PLAN_S = 30.0  # the controller is asked first


class Controls:
    def __init__(self, core: FleetCore) -> None:
        self._core = core
        self._known: dict[str, RunRow] = {}  # handed over: machine and the agent's id of them never change

    async def row(self, run_id: str) -> RunRow:
        """Problem 404 where there is none."""
        try:
            return await self._core.do(self._core.runs.get, run_id)
        except UnknownRunError as error:
            raise Problem(404, str(error), field="run") from None

    async def hold(self, run_id: str) -> Seen:
        run = await self._handed_over(run_id)
        link, path = await self._link(run), f"/v1/runs/{run.agent_run}:hold"
        return await self._written(run, await _reached(link.urgent(path)))

    async def abort(self, run_id: str) -> Seen:
        """A run that never reached the mill, or that the agent is no longer about, is given up here."""
        run = self._known.get(run_id) or await self.row(run_id)
        if run.agent_run is None and run.open:
            words = "taken back before it was handed over"
            await self._core.do(self._core.runs.close, run.id, ABORTED, words)
            run = await self.row(run_id)
            if run.agent_run is None:
                return Seen(run)
        run = await self._handed_over(run_id)
        try:
            view = await _reached((await self._link(run)).urgent(f"/v1/runs/{run.agent_run}:abort"))
        except Problem as problem:
            if problem.status not in (404, 409):
                raise
            return await self._given_up(run, problem)
        return await self._written(run, view)

    async def resume(self, run_id: str) -> Seen:
        run = await self._handed_over(run_id)
        return await self._sent(run, "resume", {}, went_on=lambda state: state in ("running", "recovering"))

    async def start(self, run_id: str, operator: str, checks: frozenset[str], around: Surroundings) -> Seen:
        run = await self._handed_over(run_id, fresh=True)
        if not run.open:
            raise Problem(409, f"the run is {run.state} and closed; load the program again", field="run")
        needed = required_checks(run, around)
        if ORDER in needed and ORDER not in checks:
            names = ", ".join(one.name for one in around.left_out(run.number))
            raise Problem(
                409,
                f"start needs the operator's confirmation of: {ORDER} (this mill has not finished {names} of this job)",
                field="checks",
            )
        body: Json = {"operator": operator, "checks": sorted(checks - {ORDER})}
        return await self._sent(run, "start", body, went_on=lambda state: state != PARKED)

    async def recover(self, run_id: str, operator: str, checks: frozenset[str]) -> Seen:
        run = await self._handed_over(run_id, fresh=True)
        seen = await self._core.seen(run)
        if seen.away:
            raise AgentAwayError(seen.away).problem()
        was_open = seen.run.open
        try:
            await self._core.do(self._core.runs.reopen, run)
        except MachineTakenError as error:
            raise Problem(409, str(error), field="machine") from None
        body: Json = {"operator": operator, "checks": sorted(checks)}
        try:
            return await self._sent(run, "recover", body, went_on=lambda state: state not in (INTERRUPTED, ABORTED))
        finally:
            if not was_open:  # as its agent has it now: closed again where nothing came of it
                await self._core.seen(await self.row(run_id))

    async def recovery(self, run_id: str) -> Json:
        """How the run would go on now."""
        run = await self._handed_over(run_id)
        path = f"/v1/runs/{run.agent_run}/recovery"
        plan = await _reached((await self._link(run)).get(path, timeout_s=_PLAN_S))
        return plan | {"run": run.id}

    # ------------------------------------------------------------------

    async def _handed_over(self, run_id: str, *, fresh: bool = False) -> RunRow:
        """The run, with the agent's own id of it."""
        if not fresh and (known := self._known.get(run_id)) is not None:
            return known
        run = await self.row(run_id)
        if run.agent_run is None:
            raise Problem(
                409, f"the run is {run.state}: its program has not been handed over, nothing moves", field="run"
            )
        while len(self._known) >= _MOST_KNOWN:
            del self._known[next(iter(self._known))]
        self._known[run_id] = run
        return run

    async def _link(self, run: RunRow) -> AgentLink:
        try:
            return await self._core.link_of(run)
        except AgentAwayError as away:
            raise away.problem() from None

    async def _sent(self, run: RunRow, action: str, body: Json, *, went_on: Callable[[str], bool]) -> Seen:
        """Once. Where the answer is lost the agent is asked; where it cannot be, a person has to look."""
        link = await self._link(run)
        try:
            view = await link.post(f"/v1/runs/{run.agent_run}:{action}", body)
        except AgentAwayError as away:
            if not away.sent:
                raise away.problem() from None
            seen = await self._core.seen(run)
            if seen.away:
                words = (
                    f"{away.words}; whether the {action} arrived is not known: LOOK AT THE MILL, then ask for the run"
                )
                raise Problem(504, words, field="machine") from None
            if went_on(seen.run.state):
                return seen
            words = f"{away.words}; the {action} has not taken effect so far, the run is {seen.run.state}"
            raise Problem(504, words, field="machine") from None
        return await self._written(run, view)

    async def _written(self, run: RunRow, view: Json) -> Seen:
        return Seen(await self._core.do(self._core.runs.told, await self.row(run.id), run_view(view, run.machine)))

    async def _given_up(self, run: RunRow, problem: Problem) -> Seen:
        """The agent is about another run by now. One that waits or was interrupted gives the mill's place free."""
        seen = await self._core.seen(await self.row(run.id))
        if seen.away or not seen.run.open or seen.run.state not in (PARKED, INTERRUPTED):
            if not seen.away and not seen.run.open:
                return seen
            raise problem
        words = f"given up while its agent had it as {seen.run.state}"
        await self._core.do(self._core.runs.close, run.id, ABORTED, words)
        return Seen(await self.row(run.id))


async def _reached(asking: Awaitable[Json]) -> Json:
    try:
        return await asking
    except AgentAwayError as away:
        if away.sent:
            words = f"{away.words}; whether the order arrived is not known: LOOK AT THE MILL, use its own stop button"
            raise Problem(504, words, field="machine") from None
        raise away.problem() from None
