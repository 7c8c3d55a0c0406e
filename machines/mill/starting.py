"""How a program is started or recovered, with the checks of each before anything moves.

Both keep the same order: a person confirms, the mill is idle, the program is still the one that pre-flight checked, the
mill is asked again whether it meets the program's needs, the journal is safe on disk. Only then is the first byte sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from machines.driver import Driver, MillState, ProgramLine, TrustPosition, allow_always
from machines.errors import JournalError, MachineError, MillCode, NotAllowedError, WrongStateError
from machines.grbl.settings import find_missing_option
from machines.mill.cycle import MillCycle
from machines.mill.hand_spindle import HandSpindle
from machines.mill.link import get_settings
from machines.mill.orders import Order, OrderRefusedError, Refusal
from machines.mill.run import Run
from machines.mill.run_control import STILL_S, RunControl, UnattendedRuns
from machines.mill.start_checks import (
    Placement,
    check_file,
    check_homed,
    check_modes,
    check_way_in,
    program_placement,
    recovery_placement,
)
from machines.mill.view import MillContext
from machines.preflight.preflight import top_of_travel_mm
from machines.recovery.plan_model import Present, RecoveryPlan, Reentry
from machines.recovery.planner import plan_recovery
from machines.runs import RECOVER_CHECKS, RECOVERABLE, START_CHECKS, Confirmation, RunState
from phrases.phrase import Phrase, join


@dataclass(eq=False)
class RecoveryPlanner:
    """Makes a recovery plan from a run's journal and the mill's present state. Sends only queries."""

    context: MillContext
    cycle: MillCycle
    reentry: Reentry

    def plan(self, run: Run) -> tuple[RecoveryPlan, dict[str, Any] | None, Placement]:
        """Return the plan, with the answer and the position check on which it is based."""
        if run.state not in RECOVERABLE:
            words = f"recovery: {run.name} is {run.state.value}; only an interrupted or aborted run is recovered"
            raise WrongStateError(words, MillCode.RUN_STATE, run.state)
        if not run.record.get("started_s"):
            words = f"recovery: {run.name} was never started; load the program again"
            raise NotAllowedError(words, code=MillCode.RUN_UNSTARTED)
        facts, reader = run.load()
        self._await_place(run)
        answer = self.cycle.read_settings()
        settings, setup = get_settings(self.context.link.driver) if answer else None, self.context.link.setup
        by_its_count = setup.homed or (settings is not None and bool(settings.soft_limits))
        present = replace(
            Present.of_run(run.record, self.context.link.status, setup.parser_state, settings),
            offsets=answer.get("offsets") if answer else None,
            homed=setup.homed,
            top_mm=top_of_travel_mm(settings) if by_its_count else None,
        )
        plan, placement = plan_recovery(run.record, facts, reader, present, self.reentry), Placement()
        if plan.blocks:
            placement = recovery_placement(plan.blocks, facts, reader, settings, present.status)
            plan = plan.with_place(placement.problems, refused=placement.certain and by_its_count)
        return plan, answer, placement

    def _await_place(self, run: Run) -> None:
        """Wait for two reports of the position of a mill that went on unattended and has stopped since."""
        until_s = self.context.clock() + 4 * STILL_S
        while run.unattended and self.context.link.status.state is MillState.IDLE and self.context.clock() < until_s:
            self.cycle.step(0.05)
            self.cycle.look()


@dataclass(eq=False)
class RunStarter:
    """Sends the first byte of a program after all checks have passed."""

    context: MillContext
    cycle: MillCycle
    control: RunControl
    unattended: UnattendedRuns
    planner: RecoveryPlanner
    spindle: HandSpindle

    def start(self, run_id: str, confirmation: Confirmation, order: Order, *, setup: str | None) -> None:
        """Stream a parked run from its first line. setup : as `Mill.start`"""
        run = self.context.runs.get(run_id)
        if run.state is not RunState.PARKED:
            way = "recover it" if run.state in RECOVERABLE else "load the program again"
            words = f"start: {run.name} is {run.state.value} and does not wait for its start; {way}"
            raise WrongStateError(words, MillCode.RUN_STATE, run.state)
        confirmation.demand(START_CHECKS, "start")
        order.extend()
        driver = self._ready_driver("start")
        facts, reader = run.load()
        check_file(run, facts)
        answer = self.cycle.read_settings()
        link = self.context.link
        if setup is not None and setup != link.setup.digest(link.status, self.context.runs.needs()):
            raise OrderRefusedError(Refusal.SETUP, "start: the zero or the position has changed since it was looked at")
        check_modes(facts, answer)
        settings = get_settings(driver)
        if settings is not None and (lack := find_missing_option(settings, mist_line=facts.mist_line)):
            raise NotAllowedError(Phrase("start: {words}", words=lack))
        check_homed(facts, settings, homed=link.setup.homed)
        check_way_in(facts, reader, driver.status.machine_mm, (answer or {}).get("offsets") or {})
        placement = program_placement(facts, reader, settings, driver.status)
        if placement.certain and placement.problems:
            words = "; ".join(placement.problems)
            words = f"start: {words}: home the mill if it counts wrongly, or set the work zero elsewhere"
            raise NotAllowedError(words, code=MillCode.TRAVEL, values={"detail": join("\n", placement.problems)})
        self._vouch(driver)
        baseline = self._baseline(run, confirmation, answer, placement)
        baseline |= {"started_s": round(self.context.wall_clock(), 3), "executed_line": 0}
        baseline |= {"state_before": baseline["parser_state"], "began_mm": baseline["machine_mm"]}
        self._stream(run, RunState.RUNNING, baseline, driver, reader.lines(1), order)

    def recover(self, run_id: str, confirmation: Confirmation, order: Order, *, plan_seen: str | None) -> None:
        """Continue an interrupted run by its present plan. plan_seen : as `Mill.recover`"""
        run = self.context.runs.get(run_id)
        order.extend()
        plan, answer, placement = self.planner.plan(run)
        if plan_seen is not None and plan_seen != plan.digest:
            raise OrderRefusedError(Refusal.PLAN, "recover: the plan has changed; read it again")
        confirmation.demand(RECOVER_CHECKS, "recover")
        if plan.refusals:
            raise NotAllowedError(Phrase("recover: {words}", words=join("; ", plan.refusals)))
        if plan.needs:
            raise NotAllowedError(Phrase("recover: {words}", words=join("; ", (need.words for need in plan.needs))))
        driver = self._ready_driver("recover")
        _, reader = run.load()
        self._vouch(driver)
        baseline = self._baseline(run, confirmation, answer, placement)
        baseline |= {"recoveries": run.view.recoveries + 1, "ended_s": None, "began_mm": None}
        if run.record.get("restarted"):
            baseline |= {"state_before": baseline["parser_state"], "began_mm": baseline["machine_mm"]}
        self._stream(run, RunState.RECOVERING, baseline, driver, plan.lines(reader), order)

    def _ready_driver(self, doing: str) -> Driver:
        self.spindle.require_off(doing)
        if (live := self.context.runs.live) is not None:
            words = f"{doing}: {live.name} is {live.state.value}; one run at a time"
            raise NotAllowedError(words, code=MillCode.RUN_LIVE)
        if self.context.link.latched:
            words = Phrase(
                "{doing}: {latched} is waiting for the link to come back",
                doing=doing,
                latched=self.context.link.latched,
            )
            raise NotAllowedError(words)
        driver, state = self.context.link.driver, self.context.link.status.state
        if driver is None or state is not MillState.IDLE:
            why = self.context.link.problem or self.context.link.status.detail
            words = f"{doing}: the mill is {state.value}{f' ({why})' if why else ''}; allowed when it is idle"
            raise WrongStateError(words, MillCode.MILL_STATE, state)
        return driver

    def _vouch(self, driver: Driver) -> None:
        """From here on, the position at which the operator confirmed the zero is the reference."""
        if not driver.status.position_trusted:
            try:
                driver.command(TrustPosition(), allow_always)
            except NotAllowedError as error:
                self.context.log.say(
                    "notice", Phrase("the position could not be confirmed: {error}", error=error.words)
                )

    def _baseline(
        self, run: Run, confirmation: Confirmation, answer: dict[str, Any] | None, placement: Placement
    ) -> dict[str, Any]:
        """Return the state at the start, for a later comparison."""
        status = self.context.link.status
        known = answer or {}
        if placement.problems:
            self.context.log.say(
                "notice",
                Phrase("it is not certain that the program fits: {problems}", problems=join("; ", placement.problems)),
            )
        warnings = [*run.lasting_warnings, *placement.problems]
        return {
            "operator": confirmation.operator, "checks": sorted(confirmation.checks), "offsets": known.get("offsets"),
            "settings": known.get("settings"), "parser_state": known.get("parser_state"), "restarted": False,
            "zeroed": "", "adrift": "", "touch_off": "", "sent_line": 0, "answered_line": 0,
            "controller": status.controller, "epoch": status.epoch, "position_trusted": status.position_trusted,
            "homed": self.context.link.setup.homed,
            "reframed": False, "stood_mm": None,
            "machine_mm": status.machine_mm, "work_mm": status.work_mm, "work_offset_mm": status.work_offset_mm,
            "wall_s": round(self.context.wall_clock(), 3), "warnings": list(dict.fromkeys(warnings)),
            "travel_in_doubt": bool(placement.problems),
        }  # fmt: skip

    def _stream(
        self,
        run: Run,
        state: RunState,
        baseline: dict[str, Any],
        driver: Driver,
        lines: Iterator[ProgramLine],
        order: Order,
    ) -> None:
        """Send the first byte once the journal is safe on disk: the last step of start and recover.

        The driver checks the order for the last time just before it writes. Notes about other runs are written
        afterwards, because they may have to wait for a disk.
        """
        if self.context.runs.active is not None and self.context.runs.active is not run:
            self.context.runs.active.let_go()
        before = {name: run.record.get(name) for name in ("state", "words", "code", "values", *baseline)}
        try:
            self.unattended.note_touch(but=run)
            run.journal.repair()
            run.move(state, "", **baseline)
            run.journal.sync()
            run.begin_stream()
            driver.start(lines, order.require)
        except MachineError:
            run.take_back(before)
            raise
        self.control.note_start(run)
        if not run.cuts:
            return  # the zeros and the touch-off are still to come for the program itself
        self.context.link.setup.zeroed_anew = ""
        try:
            self.context.runs.note_touch_off()
        except JournalError as error:
            self.context.log.say("journal", error.words)
