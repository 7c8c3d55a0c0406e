"""The run on the mill: held, resumed, aborted, ended, and kept in step with what the mill does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from machines.codes import MillCode
from machines.driver import FaultCause, Faulted, MillState, MillStatus, Stopped, StreamProgress
from machines.errors import JournalError, NotAllowedError, WrongStateError
from machines.mill.orders import Order
from machines.mill.run import LINK_LOST, Run
from machines.mill.view import MillContext
from machines.runs import RECOVERABLE, RunState
from phrases.phrase import Phrase

_STANDS = frozenset({MillState.HELD, MillState.DOOR, MillState.TOOL, MillState.SLEEP})
_QUIET = frozenset({MillState.IDLE, MillState.ALARM, MillState.CHECK, MillState.SLEEP})
_MOVING = frozenset({RunState.RUNNING, RunState.RECOVERING})
_TOUCH_OFF = Phrase("a program has ended: if the tool is changed now, touch off Z again (probe or set zero)")


@dataclass(eq=False)
class RunControl:
    """Owns what was asked of the live run, and its state.

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

    # ------------------------------------------------------------------ what a person asks for

    def hold(self) -> None:
        """Stop motion, keeping the position; without a link as soon as it is back."""
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
                words = f"resume: run {run.id} is {run.state.value}; allowed when it is held"
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
        """Take a run back that has not begun."""
        try:
            ended_s = round(self.context.wall_clock(), 3)
            run.move(RunState.ABORTED, "taken back before its start", code=MillCode.TAKEN_BACK, ended_s=ended_s)
        except JournalError as error:
            self.context.log.say("journal", error.words)
        run.let_go()

    def _note_asked(self, run: Run, state: RunState) -> None:
        """Change what was asked for. A disk that refuses does not stop a stop."""
        try:
            self._change(run, state)
        except JournalError as error:
            self.context.log.say("journal", error.words)

    # ------------------------------------------------------------------ what the mill does

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
        """Let the run's state follow the mill's: a button on the machine holds a run as well as a call does."""
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
        """Write a state change to the journal together with how far the run has come."""
        status = self.context.link.status
        where: dict[str, Any] = {
            "machine_mm": status.machine_mm,
            "work_mm": status.work_mm,
            "wall_s": round(self.context.wall_clock(), 3),
        }
        words = words or (self._journal_words if state in (RunState.HOLDING, RunState.HELD) else "")
        told = Phrase("{state} ({words})", state=state.words, words=words) if words else state.words
        self.context.log.say("run", Phrase("{run}: {told}", run=run.view.name, told=told))
        # Of any other run than the streamed one the driver knows nothing.
        mark = run.last_mark(self.context.link.progress) if run is self.streamed else {}
        run.move(state, words, **mark, **where, **more)

    def hold_without_journal(self, run: Run, error: JournalError) -> None:
        """Hold, and say why: without a journal nothing may run. Resume tries the disk again.

        Asked again at every look: a cycle start at the machine must not go on without a journal either.
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

    # ------------------------------------------------------------------ how it ends

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
            self._end(run, RunState.FINISHED, "", touch_off=_TOUCH_OFF)

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
