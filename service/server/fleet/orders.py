"""Orders to mills and to runs, each under a grant of the mill's agent; and stops of mills and of runs, including their
part that needs the database.

Theory of operation. An order is valid only for the moment at which it was given. The page asks for a grant when a
button is pressed and sends the order with it; the agent carries it out within seconds, once, and only if nobody has
stopped the mill or taken control since. Nothing here decides whether an order is still valid: it may wait for a
database, a thread or a network for any time, and the agent then refuses it, as it refuses one without a grant. Only the
request for a grant can be late here: it is refused if it has waited for more than ASK_S since it arrived, or if a stop
has come since. Only the agent validates the contents of an order. Each order is sent once. If its answer is lost, the
agent is asked for the outcome; if the agent does not know it either, a person has to look.

No stop waits for the database before it is sent (`machine_stops`): the machine of a run is remembered, or else all
agents are asked. Afterwards it waits for the run's row, for a moment.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import TypeVar

from machines.clock import suspend_aware_clock_s
from machines.mill.orders import LEASE_S, Refusal, Stop
from phrases.phrase import Phrase
from service.http.problems import Problem, ServerCode
from service.milling.api import GrantView, RecoverBody, RecoveryView, StartBody
from service.server.database.records import ABORTED, INTERRUPTED, PARKED
from service.server.database.runs import ENDED, MachineTakenError, RunRow, make_reason, read_reason, word_state
from service.server.fleet.agent_client import AgentLink, Json, OrderContext
from service.server.fleet.agent_replies import (
    AgentAwayError,
    make_order_view,
    parse_holder,
    parse_reply,
    require_answer,
    run_view,
)
from service.server.fleet.core import FleetCore, not_handed_over
from service.server.fleet.machine_stops import MachineStops, find_refusal
from service.server.fleet.representation import ORDER, Surroundings, list_required_checks
from service.server.schemas.runs import ControlView, OrderView

ASK_S = 2.0  # from the request's arrival to the grant
_ANSWER_S = 6.0  # more than the agent takes to carry an order out or to take it back
_PLAN_S = 30.0  # the controller is asked first
_START_S = 45.0  # a start asks it first, too, and waits for the journal
_MOST_KNOWN = 1000


class Orders:
    """Control of the mills of this fleet, and the orders of those who have it."""

    def __init__(self, core: FleetCore, clock: Callable[[], float] = suspend_aware_clock_s) -> None:
        self._core = core
        self._clock = clock

    # ------------------------------------------------------------------ control

    async def take(
        self, machine: str, context: OrderContext, operator: str, *, take_over: bool
    ) -> tuple[ControlView, bool]:
        """Take control of a machine; return it and whether it is new. Problem 409 if another person has it."""
        link = self._core.get_link(await self._core.find_machine(machine))
        body = {"operator": operator, "principal": context.name, "take_over": take_over}
        lease = await require_answer(link.send_once("/v1/lease", body, timeout_s=_ANSWER_S, headers=context.headers()))
        secret = str(lease.get("control", ""))
        control = ControlView(**dict(parse_holder(lease)), control=secret, expires_s=LEASE_S)
        return control, secret != context.control

    async def release(self, machine: str, context: OrderContext) -> None:
        """Release control if the caller has it. Problem 409 if someone else does."""
        link = self._core.get_link(await self._core.find_machine(machine))
        await require_answer(link.delete("/v1/lease", headers=context.headers()))

    # ------------------------------------------------------------------ orders

    async def grant(self, machine: str, context: OrderContext, stops: int | None = None) -> GrantView:
        """Ask for a grant for the caller's next order. Problem 409 if someone else has control, or if the mill was
        stopped since the caller saw this stop count.
        """
        link = self._core.get_link(await self._core.find_machine(machine))
        return parse_reply(GrantView, await require_answer(self._ask_grant(link, context, stops)), machine)

    async def give(self, machine: str, what: str, body: Json, context: OrderContext) -> OrderView:
        """Carry out an order outside runs, from the holder of control. Problem 504 if its outcome is not known. It goes
        to the agent that gave the grant, and waits for no disk.
        """
        link = self._core.get_known_link(machine) or self._core.get_link(await self._core.find_machine(machine))
        sending = link.send_once(f"/v1/control/{what}", body, timeout_s=_ANSWER_S, headers=context.headers())
        return make_order_view(machine, what, await require_answer(sending, what))

    # ------------------------------------------------------------------

    async def _ask_grant(self, link: AgentLink, context: OrderContext, stops: int | None) -> Json:
        """Ask the agent for a grant. It is valid only if the request is recent and no stop has come since.
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


class Controls:
    """Start, resume and recover: a person's orders to a run, each passed on to its agent once."""

    def __init__(self, core: FleetCore) -> None:
        self._core = core
        self._plans_shown: dict[
            tuple[str, str], str
        ] = {}  # by caller and run: the digest of the plan that they saw last

    async def resume(self, run_id: str, context: OrderContext) -> RunRow:
        run = await self._require_handed_over(run_id)
        went_on = ("running", "recovering")
        return await self._send_once(run, "resume", {}, context, went_on=lambda state: state in went_on)

    async def start(self, run_id: str, said: StartBody, around: Surroundings, context: OrderContext) -> RunRow:
        run = await self._require_handed_over(run_id, fresh=True)
        if not run.open:
            raise Problem(
                409,
                Phrase("the run is {state} and closed; load the program again", state=word_state(run.state)),
                field="run",
            )
        needed = list_required_checks(run, around)
        if ORDER in needed and ORDER not in said.checks:
            names = ", ".join(one.name for one in around.list_left_out(run.number))
            raise Problem(
                409,
                Phrase(
                    "start needs the operator's confirmation of: {check} (this mill has not finished {names} of "
                    "this job)",
                    check=ORDER,
                    names=names,
                ),
                field="checks",
            )
        body: Json = {"operator": said.operator, "checks": sorted({*said.checks} - {ORDER})}
        body |= {"setup": said.setup} if said.setup else {}
        return await self._send_once(run, "start", body, context, went_on=lambda state: state != PARKED)

    async def recover(self, run_id: str, said: RecoverBody, context: OrderContext) -> RunRow:
        """Recover only by the plan that the caller has read: the one they name, or the one last shown to them."""
        plan = said.plan or self._plans_shown.get((context.name, run_id), "")
        if not plan:
            words = f"recover needs the `plan` that you have read: GET /v1/runs/{run_id}/recovery shows it"
            raise Problem(409, words, field="plan", code=Refusal.PLAN)
        run = await self._require_handed_over(run_id, fresh=True)
        seen = await self._core.look_at(run)
        if seen.away:
            raise seen.away
        was_open = seen.open
        try:
            await self._core.do(self._core.runs.reopen, run)
        except MachineTakenError as error:
            raise Problem(409, str(error), field="machine") from None
        body: Json = {"operator": said.operator, "checks": sorted({*said.checks}), "plan": plan}
        over = (INTERRUPTED, ABORTED)
        try:
            return await self._send_once(run, "recover", body, context, went_on=lambda state: state not in over)
        finally:
            if not was_open:  # read it from its agent: closed again if the recovery did not happen
                await self._core.look_at(await self._core.get_row(run_id))

    async def plan_recovery(self, run_id: str, caller: str) -> RecoveryView:
        """Return the plan by which the run would be recovered now, and remember that the caller has seen it."""
        run = await self._require_handed_over(run_id)
        path = f"/v1/runs/{run.agent_run}/recovery"
        view = await require_answer((await self._find_link(run)).get(path, timeout_s=_PLAN_S))
        plan = parse_reply(RecoveryView, view | {"run": run.id}, run.machine)
        while len(self._plans_shown) >= _MOST_KNOWN:
            del self._plans_shown[next(iter(self._plans_shown))]
        self._plans_shown[caller, run.id] = plan.plan[:100]
        return plan

    # ------------------------------------------------------------------

    async def _require_handed_over(self, run_id: str, *, fresh: bool = False) -> RunRow:
        """Return the run, with the agent's own id of it."""
        if not fresh and (known := self._core.known_runs.get(run_id)) is not None:
            return known
        run = await self._core.get_row(run_id)
        if run.agent_run is None:
            raise not_handed_over(run)
        return self._core.remember(run)

    async def _find_link(self, run: RunRow) -> AgentLink:
        return await require_answer(self._core.find_link(run))

    async def _send_once(
        self, run: RunRow, action: str, body: Json, context: OrderContext, *, went_on: Callable[[str], bool]
    ) -> RunRow:
        """Send an order once. If the answer is lost, ask the agent; if that fails too, a person has to look."""
        link = await self._find_link(run)
        try:
            path = f"/v1/runs/{run.agent_run}:{action}"
            view = await link.send_once(path, body, timeout_s=_START_S, headers=context.headers())
        except AgentAwayError as away:
            if not away.sent:
                raise away.problem() from None
            seen = await self._core.look_at(run)
            if seen.away:
                raise away.problem(action) from None
            if went_on(seen.state):
                return seen
            words = f"{away.words}; the {action} has not taken effect so far, the run is {seen.state}"
            values = {"order": action, "state": seen.state}
            raise Problem(504, words, field="machine", code=ServerCode.ORDER_WITHOUT_EFFECT, values=values) from None
        return await self._write_view(run, view)

    async def _write_view(self, run: RunRow, view: Json) -> RunRow:
        row = await self._core.get_row(run.id)
        return await self._core.do(self._core.runs.record_report, row, run_view(view, run.machine))


T = TypeVar("T")
_BOOK_S = 0.3  # wait for the database, after the stop has left


class Stops(MachineStops):
    """Stops of mills and of runs."""

    def __init__(self, core: FleetCore) -> None:
        super().__init__(core)
        self._core = core

    async def stop_run(self, run_id: str, stop: Stop, context: OrderContext) -> RunRow:
        """Stop the mill that has this run, as `stop_machine` does. Problem 404; 409 if the run is not on its mill.

        An abort also closes a run that never reached its mill, or that its agent no longer knows.
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
        """Return the result of work that may wait for a database; None if that takes too long, and the work goes on."""
        task = self._start_task(work)
        await asyncio.wait({task}, timeout=_BOOK_S)
        return task.result() if task.done() and task.exception() is None else otherwise

    # ------------------------------------------------------------------

    async def _stop_known(self, run: RunRow, stop: Stop, context: OrderContext) -> tuple[RunRow, Json]:
        path = f"/v1/runs/{run.agent_run}:{stop.value}"
        link = self._core.get_known_link(run.machine) or await self._find_present_link(run.machine, None)
        return run, await require_answer(link.send_urgent(path, headers=context.headers()), stop)

    async def _ask_all(self, run_id: str, stop: Stop, context: OrderContext) -> tuple[RunRow, Json]:
        """Ask all agents for a run that this process has not seen yet, by our id. Problem if none of them has it."""
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
    """Return the run's row as far as it is known without the database."""
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
