"""How something comes to run: parking, starting, recovering, each with its checks, before anything moves.

The order is the same for both ways: a person's confirmation, an idle mill, the program as pre-flight saw it, the mill
as the program needs it (asked anew), the journal safe on disk, and only then the first byte.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from machines.driver import CommandDone, Driver, MillState, ReadSettings, TrustPosition
from machines.errors import JournalError, MachineError, NotAllowedError, ProgramChangedError
from machines.gcode.program import ProgramReader
from machines.grbl.options import find_missing_option
from machines.grbl.settings import ControllerSettings
from machines.mill.events import MillEvents
from machines.mill.orders import OrderRefusedError, Refusal
from machines.mill.placement import Placement, program_placement, way_in_placement
from machines.mill.run import Run
from machines.mill.standing import STILL_S
from machines.preflight.limits import top_of_travel_mm
from machines.preflight.preflight import Preflight
from machines.recovery.planning import Present, RecoveryPlan, plan_recovery
from machines.runs import RECOVER_CHECKS, RECOVERABLE, START_CHECKS, Confirmation, RunState, RunView

ASK_S = 5.0
_PRESUMED = ("G54", "G17", "G94")  # what a program that does not say takes for granted, beside `Preflight.assumed`


class MillStarting(MillEvents):
    """Park, start, plan, recover."""

    def park(self, program: Preflight, path: Path, name: str) -> RunView:
        """A run that waits for its start. Nothing is sent."""
        self._open()
        run_id = self._folders.new_id(self._wall(), program.sha256)
        self._folders.save_facts(run_id, program)
        record = {
            "id": run_id, "name": name, "sha256": program.sha256, "path": str(path.absolute()), "lines": program.lines,
            "bytes": program.bytes, "time_s": program.time_s, "profile": program.profile,
            "created_s": round(self._wall(), 3),
            "warnings": list(program.warnings), "state": RunState.PARKED.value, "executed_line": 0,
        }  # fmt: skip
        run = self._run_on_disk(run_id, {"id": run_id, "state": RunState.PARKED.value})
        run.write("parked", **record)
        run.journal.hasten()
        run.facts, run.reader = program, ProgramReader(path, program.index)
        self._runs[run_id] = run
        if self._active is None or not self._active.live:
            if self._active is not None:
                self._active.let_go()
            self._active = run
        self._say("run", f"{name}: parked")
        self._forget_old_runs()
        self._publish()
        return run.view

    def start(self, run_id: str, confirmation: Confirmation, *, setup: str | None = None) -> None:
        """Stream a parked run from its first line.

        setup : `MillSnapshot.setup` as the person saw it; OrderRefusedError where it is another by now
        """
        run = self._run(run_id)
        if run.state is not RunState.PARKED:
            way = "recover it" if run.state in RECOVERABLE else "load the program again"
            raise NotAllowedError(f"start: run {run_id} is {run.state.value} and does not wait for its start; {way}")
        confirmation.demand(START_CHECKS, "start")
        self._extend_permit()
        driver = self._ready_driver("start")
        facts, reader = run.load(self._folders, lambda facts: self._reader(run, facts))
        _check_file(run, facts)
        answer = self._asked()
        if setup is not None and setup != self._setup_digest(self.status):
            raise OrderRefusedError(Refusal.SETUP, "start: the zero or the position has changed since it was looked at")
        _check_modes(facts, answer)
        settings = _told(driver)
        if settings is not None and (words := find_missing_option(settings, mist_line=facts.mist_line)):
            raise NotAllowedError(f"start: {words}")
        placement = program_placement(facts, reader, _told(driver), driver.status)
        if placement.certain and placement.problems:
            words = "; ".join(placement.problems)
            raise NotAllowedError(f"start: {words}: home the mill if it counts wrongly, or set the work zero elsewhere")
        self._vouch(driver)
        baseline = self._baseline(run, confirmation, answer, placement)
        baseline |= {"started_s": round(self._wall(), 3), "executed_line": 0}
        baseline |= {"state_before": baseline["parser_state"], "began_mm": baseline["machine_mm"]}
        self._go(run, RunState.RUNNING, baseline, lambda: driver.start(reader.lines(1)))

    def plan_recovery(self, run_id: str) -> RecoveryPlan:
        """How the run would go on now: what has to be done first, and what would be sent. Sends only questions."""
        run = self._run(run_id)
        plan, _, _ = self._planned(run)
        self._rest(run)
        return plan

    def recover(self, run_id: str, confirmation: Confirmation, *, plan_seen: str | None = None) -> None:
        """Go on with an interrupted run, as the plan of this moment says.

        plan_seen : digest of the plan that the person has read; OrderRefusedError where it is another by now
        """
        run = self._run(run_id)
        self._extend_permit()
        plan, answer, placement = self._planned(run)
        if plan_seen is not None and plan_seen != plan.digest:
            raise OrderRefusedError(Refusal.PLAN, "recover: the plan is another by now; read it again")
        confirmation.demand(RECOVER_CHECKS, "recover")
        if plan.refusals:
            raise NotAllowedError(f"recover: {'; '.join(plan.refusals)}")
        if plan.needs:
            raise NotAllowedError(f"recover: {'; '.join(need.words for need in plan.needs)}")
        driver = self._ready_driver("recover")
        _, reader = run.load(self._folders, lambda facts: self._reader(run, facts))
        self._vouch(driver)
        baseline = self._baseline(run, confirmation, answer, placement)
        baseline |= {"recoveries": int(run.record.get("recoveries", 0)) + 1, "ended_s": None, "began_mm": None}
        if run.record.get("restarted"):
            baseline |= {"state_before": baseline["parser_state"], "began_mm": baseline["machine_mm"]}
        self._go(run, RunState.RECOVERING, baseline, lambda: driver.start(plan.lines(reader)))

    def _planned(self, run: Run) -> tuple[RecoveryPlan, dict[str, Any] | None, Placement]:
        """The plan, with the answer and the check of place it rests on."""
        if run.state not in RECOVERABLE:
            raise NotAllowedError(
                f"recovery: run {run.id} is {run.state.value}; only an interrupted or aborted run is recovered"
            )
        if not run.record.get("started_s"):
            raise NotAllowedError(f"recovery: run {run.id} was never started; load the program again")
        facts, reader = run.load(self._folders, lambda facts: self._reader(run, facts))
        self._await_place(run)
        answer = self._asked()
        settings = _told(self._driver) if answer else None
        by_its_count = self._homed or (settings is not None and bool(settings.soft_limits))
        present = Present(
            status=self.status,
            offsets=answer.get("offsets") if answer else None,
            parser_state=self._parser_state,
            restarted=bool(run.record.get("restarted")),
            vouched_axes=str(run.record.get("zeroed", "")),
            homed=self._homed,
            top_mm=top_of_travel_mm(settings) if by_its_count else None,
        )

        def placed(blocks: tuple[str, ...]) -> Placement:
            """The rest of the program is held against the travel as a whole: what is cut already did fit there."""
            whole = program_placement(facts, reader, settings, present.status)
            way = way_in_placement(blocks, facts, settings, present.status)
            return Placement((*whole.problems, *way.problems), whole.certain or way.certain)

        plan, placement = plan_recovery(run.record, facts, reader, present, self._reentry), Placement()
        if plan.blocks:
            placement = placed(plan.blocks)
            plan = plan.with_place(placement.problems, refused=placement.certain and by_its_count)
        return plan, answer, placement

    def _await_place(self, run: Run) -> None:
        """A mill that went on alone and stands by now: where, is known after two reports."""
        until_s = self._clock() + 4 * STILL_S
        while run.record.get("adrift") and self.status.state is MillState.IDLE and self._clock() < until_s:
            self.step(0.05)
            self._look()

    def _go(self, run: Run, state: RunState, baseline: dict[str, Any], start: Callable[[], None]) -> None:
        """The last step of start and recover: only when the journal is safe on disk does the first byte leave."""
        if self._active is not None and self._active is not run:
            self._active.let_go()
        before = {name: run.record.get(name) for name in ("state", "words", *baseline)}
        try:
            self._note_touch(but=run)
            run.journal.repair()
            run.move(state, "", **baseline)
            run.journal.sync()
            run.begin_stream()
            self._require_permit()
            start()
        except MachineError:
            run.take_back(before)
            self._publish()
            raise
        self._active = self._driven = run
        self._hold_asked = self._abort_asked = False
        self._recovering = state is RunState.RECOVERING
        self._journal_words = ""
        self._say("run", f"{run.view.name}: {run.state.value}, confirmed by {run.record['operator']}")
        try:
            self._note_touch_off()
        except JournalError as error:
            self._say("journal", str(error))
        self._look()

    def _baseline(
        self, run: Run, confirmation: Confirmation, answer: dict[str, Any] | None, placement: Placement
    ) -> dict[str, Any]:
        """What held at the start, for the day it has to be compared."""
        status = self.status
        known = answer or {}
        if placement.problems:
            self._say("notice", f"not certain that the program fits: {'; '.join(placement.problems)}")
        warnings = [*run.lasting_warnings, *placement.problems]
        return {
            "operator": confirmation.operator, "checks": sorted(confirmation.checks), "offsets": known.get("offsets"),
            "settings": known.get("settings"), "parser_state": known.get("parser_state"), "restarted": False,
            "zeroed": "", "adrift": "", "touch_off": "", "sent_line": 0, "answered_line": 0,
            "controller": status.controller, "epoch": status.epoch, "position_trusted": status.position_trusted,
            "homed": self._homed,
            "machine_mm": status.machine_mm, "work_mm": status.work_mm, "work_offset_mm": status.work_offset_mm,
            "wall_s": round(self._wall(), 3), "warnings": list(dict.fromkeys(warnings)),
        }  # fmt: skip

    def _vouch(self, driver: Driver) -> None:
        """The operator's word for the zero makes the place where it was given the reference from here on."""
        if not driver.status.position_trusted:
            try:
                driver.command(TrustPosition())
            except NotAllowedError as error:
                self._say("notice", f"the position could not be confirmed: {error}")

    def _ready_driver(self, doing: str) -> Driver:
        self._open()
        if (live := self._live()) is not None:
            raise NotAllowedError(f"{doing}: run {live.id} is {live.state.value}; one run at a time")
        if self._link.latched:
            raise NotAllowedError(f"{doing}: {self._link.latched} waits for the link to come back")
        state = self.status.state
        if self._driver is None or state is not MillState.IDLE:
            words = self._link.problem or self.status.detail
            more = f" ({words})" if words else ""
            raise NotAllowedError(f"{doing}: the mill is {state.value}{more}; allowed when it is idle")
        return self._driver

    def _asked(self) -> dict[str, Any] | None:
        """Settings, offsets and parser state, read now; None where the link does not tell or the mill is not idle."""
        driver = self._driver
        if driver is None or driver.status.state not in (MillState.IDLE, MillState.ALARM):
            return None
        wanted = ReadSettings()
        try:
            driver.command(wanted)
        except NotAllowedError:
            return None
        until_s = self._clock() + ASK_S
        answer: dict[str, Any] | None = None
        ended = False
        # The work position comes with the offset, and that only with every tenth report or so.
        stops = self.orders.stops
        while (
            self._clock() < until_s
            and self._driver is driver
            and self.orders.stops == stops
            and not (ended and driver.status.work_mm is not None)
        ):
            for event in driver.poll(0.05):
                self._on(event)
                if isinstance(event, CommandDone) and event.command == wanted:
                    ended = True
                    answer = None if event.failure else dict(event.answer)
            if ended and answer is None:
                break
        return answer

    def _open(self) -> None:
        if self._closed:
            raise NotAllowedError(f"mill {self.name} is closed")


def _told(driver: Driver | None) -> ControllerSettings | None:
    settings = getattr(driver, "settings", None)
    return settings if isinstance(settings, ControllerSettings) else None


def _check_file(run: Run, facts: Preflight) -> None:
    try:
        size = run.path.stat().st_size
    except OSError as error:
        raise ProgramChangedError(f"{run.path}: cannot be read any more ({error.strerror})") from None
    if size != facts.bytes:
        raise ProgramChangedError(f"{run.path}: has {size} bytes, pre-flight read {facts.bytes}; load it again")


def _check_modes(facts: Preflight, answer: dict[str, Any] | None) -> None:
    """A program that takes modes for granted must find them."""
    modes = str((answer or {}).get("parser_state") or "").split()
    if not modes:
        return
    missing = [mode for mode in (*facts.assumed, *_PRESUMED) if mode not in modes]
    if missing:
        raise NotAllowedError(
            f"start: the program takes {' '.join(missing)} for granted, the controller is in {' '.join(modes)}: "
            f"send '{' '.join(missing)}' first"
        )
