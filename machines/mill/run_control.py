"""Controls the run on the mill: holds, resumes, aborts and ends it, and keeps it in step with the mill.

A run whose mill went on unattended is watched until the mill stands; then its progress is recorded. A run is unattended
from the moment its link is lost, or its owner dies, until anything is done to the mill that could move it or its zero:
any command, a restart, another run. Only until then does the mill's position prove anything.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from machines.driver import Driver, FaultCause, Faulted, MillState, MillStatus, Stopped, StreamProgress, Triple
from machines.errors import JournalError, MachineError, MillCode, NotAllowedError, WrongStateError
from machines.gcode.program import ProgramReader
from machines.mill.link import get_settings
from machines.mill.orders import Order
from machines.mill.run import LINK_LOST, OWNER_LOST, Run
from machines.mill.view import MillContext
from machines.recovery.needs import position_doubt
from machines.recovery.plan_model import Present
from machines.recovery.planner import GRBL_DIALECTS
from machines.recovery.standing import LINES_AFTER_LAST_MARK, count_executed_at_rest, tolerance_at_rest_mm
from machines.runs import RECOVERABLE, RunState
from phrases.phrase import Phrase

STILL_S = 0.5  # two status reports at the same place


@dataclass(eq=False)
class Standstill:
    """The time since which the mill has stood idle at one place."""

    _place: Triple | None = None
    _since_s: float = 0.0

    def observe(self, status: MillStatus, now_s: float) -> Triple | None:
        """Take a report; return the mill's place in machine coordinates once it certainly stands there."""
        place = status.machine_mm if status.state is MillState.IDLE else None
        if place != self._place or now_s < self._since_s:
            self._place, self._since_s = place, now_s
        return place if now_s >= self._since_s + STILL_S else None


@dataclass(eq=False)
class UnattendedRuns:
    """Finds out how far the mill has got unattended."""

    context: MillContext
    _standstill: Standstill = field(default_factory=Standstill)

    def watch(self) -> None:
        """Record what the mill has done unattended, at its first standstill after the link is back."""
        driver = self.context.link.driver
        if driver is None or self.context.runs.live is not None:
            return
        place_mm = self._standstill.observe(driver.status, self.context.clock())
        if place_mm is None:
            return
        for run in self._list_unattended():
            try:
                self._book_place(run, driver, place_mm)
            except MachineError as error:  # the program is gone, or the disk refuses: keep the known state
                self.context.log.say("journal", Phrase("{run}: {error}", run=run.view.name, error=error.words))
                run.record["adrift"] = ""

    def note_touch(self, but: Run | None = None) -> None:
        """Note an action that may move the mill or its zero: from now on its position proves nothing."""
        for run in self._list_unattended():
            if run is not but:
                run.write("ashore", adrift="")
                self.context.runs.let_rest(run)

    def _list_unattended(self) -> list[Run]:
        return [run for run in self.context.runs.recoverable() if run.unattended]

    def _book_place(self, run: Run, driver: Driver, place_mm: Triple) -> None:
        _, reader = run.load()
        line = _proven_line(run, reader, driver, place_mm)
        booked: dict[str, Any] = {}
        if line is not None and line > run.executed_line:
            words = Phrase(
                "{run}: the mill went on to the end of line {line} before it stood still", run=run.view.name, line=line
            )
            self.context.log.say("run", words)
            booked = {"executed_line": line, "stood_mm": place_mm}
        run.write("ashore", adrift="", **booked)
        if booked:
            run.journal.hasten()
        self.context.runs.let_rest(run)


def _proven_line(run: Run, reader: ProgramReader, driver: Driver, place_mm: Triple) -> int | None:
    """Return the last line that this run has certainly executed; None if the position proves nothing."""
    settings, record = get_settings(driver), run.record
    if settings is None or reader.index.dialect not in GRBL_DIALECTS:
        return None
    present = Present.of_run(record, driver.status, settings.parser_state, settings)
    if position_doubt(record, present):
        return None
    last = int(record.get("sent_line") or 0)
    if run.unattended == OWNER_LOST:
        last += LINES_AFTER_LAST_MARK
    return count_executed_at_rest(reader, record, place_mm, last_line=last, tolerance_mm=tolerance_at_rest_mm(settings))


_STANDS = frozenset({MillState.HELD, MillState.DOOR, MillState.TOOL, MillState.SLEEP})
_QUIET = frozenset({MillState.IDLE, MillState.ALARM, MillState.CHECK, MillState.SLEEP})
_MOVING = frozenset({RunState.RUNNING, RunState.RECOVERING})
_TOUCH_OFF = Phrase("a program has ended: if the tool is changed now, touch off Z again (probe or set zero)")


@dataclass(eq=False)
class RunControl:
    """Owns the live run's requested and actual state.

    streamed : the run that the present driver has streamed, while its tail is still reported
    """

    context: MillContext
    streamed: Run | None = None
    _hold_asked: bool = False
    _abort_asked: bool = False
    _recovering: bool = False
    _journal_words: str = ""

    def note_start(self, run: Run) -> None:
        """Note that the driver streams this run from now on."""
        self.context.runs.active = self.streamed = run
        self._hold_asked = self._abort_asked = False
        self._recovering = run.state is RunState.RECOVERING
        self._journal_words = ""
        words = Phrase(
            "{run}: {state}, confirmed by {operator}",
            run=run.view.name,
            state=run.state.words,
            operator=run.record["operator"],
        )
        self.context.log.say("run", words)

    # ------------------------------------------------------------------ orders of a person

    def hold(self) -> None:
        """Stop motion, keeping the position; without a link, as soon as it is back."""
        try:
            self.context.link.order("hold")
        finally:
            run = self.context.runs.live
            if run is not None and run.state in _MOVING:
                self._hold_asked = True
                self._note_asked(run, RunState.HOLDING)

    def resume(self, order: Order) -> None:
        """Go on after a hold."""
        link, driver = self.context.link, self.context.link.driver
        if link.latched and link.away:
            raise NotAllowedError(
                Phrase(
                    "resume: the mill is not connected; the {latched} is carried out first when the mill is back",
                    latched=link.latched,
                )
            )
        if driver is None:
            words = f"resume: the mill is disconnected ({link.problem}); allowed when it is held"
            raise WrongStateError(words, MillCode.MILL_STATE, link.status.state)
        run = self.context.runs.live
        if run is not None:
            if run.state not in (RunState.HELD, RunState.HOLDING):
                words = f"resume: {run.name} is {run.state.value}; allowed when it is held"
                raise WrongStateError(words, MillCode.RUN_STATE, run.state)
            run.journal.repair()
            run.journal.append("resume", wall_s=round(self.context.wall_clock(), 3))
            self._journal_words = ""
        driver.resume(order.require)
        self._hold_asked = False

    def abort(self) -> None:
        """End the run: hold, and from standstill clear what the controller holds."""
        run = self.context.runs.active
        if run is not None and run.state is RunState.PARKED:
            self._take_back(run)
            if self.context.link.status.state in _QUIET:
                return
        self._abort_asked = True
        try:
            self.context.link.order("abort")  # before anything that waits for a disk
        finally:
            if run is not None and run.live and run.state is not RunState.STOPPING:
                self._note_asked(run, RunState.STOPPING)

    def _take_back(self, run: Run) -> None:
        """Take back a run that has not begun."""
        try:
            ended_s = round(self.context.wall_clock(), 3)
            run.move(RunState.ABORTED, "taken back before its start", code=MillCode.TAKEN_BACK, ended_s=ended_s)
        except JournalError as error:
            self.context.log.say("journal", error.words)
        run.let_go()

    def _note_asked(self, run: Run, state: RunState) -> None:
        """Change the requested state. A failing disk does not prevent a stop."""
        try:
            self._change(run, state)
        except JournalError as error:
            self.context.log.say("journal", error.words)

    # ------------------------------------------------------------------ events from the mill

    def follow(self) -> None:
        """Compare the run with the mill, and mark its journal."""
        run, driver = self.streamed, self.context.link.driver
        if run is None or driver is None:
            return
        try:
            self._follow(run, driver.status, driver.progress)
        except JournalError as error:
            self.hold_without_journal(run, error)

    def _follow(self, run: Run, status: MillStatus, progress: StreamProgress) -> None:
        state = run.state
        if run.live and state is not RunState.STOPPING:
            self._mirror(run, state, status, progress)
        if run.live or run.state in RECOVERABLE:
            clocks = self.context.clock(), self.context.wall_clock()
            run.follow(progress, status, *clocks, moving=status.state is MillState.RUN)
            if (failure := run.journal.failure) is not None:
                raise JournalError(failure)

    def _mirror(self, run: Run, state: RunState, status: MillStatus, progress: StreamProgress) -> None:
        """Let the run's state follow the mill's: a button on the machine holds a run just as an order does."""
        if self._recovering and progress.answered_line > 0:
            self._recovering = False
        going = RunState.RECOVERING if self._recovering else RunState.RUNNING
        if status.state in _STANDS:
            self._hold_asked = False
            wanted = RunState.HELD
        elif status.state is MillState.HOLDING:
            wanted = RunState.HOLDING
        elif status.state in (MillState.RUN, MillState.IDLE):
            wanted = RunState.HOLDING if self._hold_asked else going
        else:
            return
        if wanted is not state:
            self._change(run, wanted, status.detail if wanted is RunState.HELD else "")

    def _change(self, run: Run, state: RunState, words: str = "", **more: Any) -> None:
        """Write a state change to the journal together with the run's progress."""
        status = self.context.link.status
        where: dict[str, Any] = {
            "machine_mm": status.machine_mm,
            "work_mm": status.work_mm,
            "wall_s": round(self.context.wall_clock(), 3),
        }
        words = words or (self._journal_words if state in (RunState.HOLDING, RunState.HELD) else "")
        told = Phrase("{state} ({words})", state=state.words, words=words) if words else state.words
        self.context.log.say("run", Phrase("{run}: {told}", run=run.view.name, told=told))
        # The driver knows nothing about any run but the streamed one.
        mark = run.last_mark(self.context.link.progress) if run is self.streamed else {}
        run.move(state, words, **mark, **where, **more)

    def hold_without_journal(self, run: Run, error: JournalError) -> None:
        """Hold, with the reason: without a journal nothing may run. Resume tries the disk again.

        This is repeated at every look, because a cycle start at the machine must not continue without a journal either.
        """
        words = Phrase("held because {error}; make room, then resume", error=error.words)
        if not self._journal_words:
            self._journal_words = words
            self.context.log.say("journal", words)
        if not run.live or run.state is RunState.STOPPING:
            return
        if self.context.link.status.state not in _STANDS and not self._hold_asked:
            self._hold_asked = True
            self.context.link.hold_unasked()
        if run.state in _MOVING:
            run.record.update(state=RunState.HOLDING.value, words=words)

    # ------------------------------------------------------------------ ends of a run

    def note_fault(self, event: Faulted) -> None:
        """Interrupt the live run; drop a link that is lost."""
        run = self.streamed
        words = Phrase("{cause}: {words}", cause=event.cause.words, words=event.words)
        self.context.log.say("fault", words)
        lost = event.cause is FaultCause.PORT_LOST
        try:
            if run is not None and run.live and self.context.link.driver is not None:
                going_on = lost and run.state is not RunState.STOPPING
                self._hold_asked = self._recovering = False
                self._change(run, RunState.INTERRUPTED, words, code=event.cause.value,
                             values={"detail": event.words, "alarm": event.alarm},
                             cause=event.cause.value, fault_line=event.line,
                             adrift=LINK_LOST if going_on else "")  # fmt: skip
                run.journal.hasten()
        finally:
            if lost or self.context.link.status.state is MillState.DISCONNECTED:
                if self._abort_asked:
                    self.context.link.latched = "abort"
                self.streamed = None
                self.context.link.drop(event.words)

    def note_end(self) -> None:
        """Finish the run whose program has been executed to its end."""
        if self.streamed is not None and self.streamed.live:
            run = self.streamed
            self._end(run, RunState.FINISHED, "", touch_off=_TOUCH_OFF if run.cuts else "")

    def note_stop(self, event: Stopped) -> None:
        """End a run that was to be aborted: the mill stands with empty buffers."""
        run = self.context.runs.active
        kept, lost = Phrase("stopped"), Phrase("stopped: position lost or never confirmed")
        self.context.log.say("state", kept if event.position_kept else lost)
        asked, self._abort_asked = self._abort_asked, False
        if run is not None and (run.state is RunState.STOPPING or (asked and run.state is RunState.INTERRUPTED)):
            self._end(run, RunState.ABORTED, "aborted by the operator", code=MillCode.ABORTED)

    def _end(self, run: Run, state: RunState, words: str, **more: object) -> None:
        self._change(run, state, words, ended_s=round(self.context.wall_clock(), 3), **more)
        self._hold_asked = self._recovering = False
        if state is RunState.FINISHED:
            self.streamed = None
        run.journal.hasten()
        run.let_go()
