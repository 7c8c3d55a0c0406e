"""The run on the mill: held, resumed, aborted, ended, and kept in step with what the mill does."""

from __future__ import annotations

from typing import Any

from machines.codes import MillCode
from machines.driver import FaultCause, Faulted, MillState, MillStatus, Stopped, StreamProgress
from machines.errors import JournalError, NotAllowedError, WrongStateError
from machines.mill.orders import Order
from machines.mill.run import LINK_LOST, Run
from machines.mill.view import MillContext
from machines.runs import RECOVERABLE, RunState

_STANDS = frozenset({MillState.HELD, MillState.DOOR, MillState.TOOL, MillState.SLEEP})
_QUIET = frozenset({MillState.IDLE, MillState.ALARM, MillState.CHECK, MillState.SLEEP})
_MOVING = frozenset({RunState.RUNNING, RunState.RECOVERING})
_TOUCH_OFF = "a program has ended: if the tool is changed now, touch off Z again (probe or set zero)"


class RunControl:
    """Owns what was asked of the live run, and its state.

    streamed : the run that the present driver has streamed, while its tail is still reported
    """

    def __init__(self, context: MillContext) -> None:
        self._link = context.link
        self._runs = context.runs
        self._say = context.log.say
        self._clock = context.clock
        self._wall = context.wall_clock
        self.streamed: Run | None = None
        self._hold_asked = False
        self._abort_asked = False
        self._recovering = False
        self._journal_words = ""

    def note_start(self, run: Run) -> None:
        """The driver streams this run from now on."""
        self._runs.active = self.streamed = run
        self._hold_asked = self._abort_asked = False
        self._recovering = run.state is RunState.RECOVERING
        self._journal_words = ""
        self._say("run", f"{run.view.name}: {run.state.value}, confirmed by {run.record['operator']}")

    # ------------------------------------------------------------------ what a person asks for

    def hold(self) -> None:
        """Stop motion, keeping the position; without a link as soon as it is back."""
        try:
            self._link.order("hold")
        finally:
            run = self._runs.live
            if run is not None and run.state in _MOVING:
                self._hold_asked = True
                self._note_asked(run, RunState.HOLDING)

    def resume(self, order: Order) -> None:
        """Go on after a hold."""
        driver = self._link.driver
        if self._link.latched and self._link.away:
            raise NotAllowedError(
                f"resume: the mill is not connected; the {self._link.latched} is carried out first when it is back"
            )
        if driver is None:
            words = f"resume: the mill is disconnected ({self._link.problem}); allowed when it is held"
            raise WrongStateError(words, MillCode.MILL_STATE, self._link.status.state)
        run = self._runs.live
        if run is not None:
            if run.state not in (RunState.HELD, RunState.HOLDING):
                words = f"resume: run {run.id} is {run.state.value}; allowed when it is held"
                raise WrongStateError(words, MillCode.RUN_STATE, run.state)
            run.journal.repair()
            run.journal.append("resume", wall_s=round(self._wall(), 3))
            self._journal_words = ""
        order.require()
        driver.resume()
        self._hold_asked = False

    def abort(self) -> None:
        """End the run: hold, and from standstill clear what the controller holds."""
        run = self._runs.active
        if run is not None and run.state is RunState.PARKED:
            self._take_back(run)
            if self._link.status.state in _QUIET:
                return
        self._abort_asked = True
        try:
            self._link.order("abort")  # before anything that waits for a disk
        finally:
            if run is not None and run.live and run.state is not RunState.STOPPING:
                self._note_asked(run, RunState.STOPPING)

    def _take_back(self, run: Run) -> None:
        """A run that has not begun."""
        try:
            ended_s = round(self._wall(), 3)
            run.move(RunState.ABORTED, "taken back before its start", code=MillCode.TAKEN_BACK, ended_s=ended_s)
        except JournalError as error:
            self._say("journal", str(error))
        run.let_go()

    def _note_asked(self, run: Run, state: RunState) -> None:
        """A change that was asked for. A disk that refuses does not stop a stop."""
        try:
            self._change(run, state)
        except JournalError as error:
            self._say("journal", str(error))

    # ------------------------------------------------------------------ what the mill does

    def follow(self) -> None:
        """Compare the run with the mill, and mark its journal."""
        run, driver = self.streamed, self._link.driver
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
            run.follow(progress, status, self._clock(), self._wall(), moving=status.state is MillState.RUN)
            if run.journal.failure:
                raise JournalError(run.journal.failure)

    def _mirror(self, run: Run, state: RunState, status: MillStatus, progress: StreamProgress) -> None:
        """The run's state follows the mill's: a button on the machine holds a run as well as a call does."""
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
        """A state change goes to the journal together with how far the run has come."""
        status = self._link.status
        where: dict[str, Any] = {
            "machine_mm": status.machine_mm,
            "work_mm": status.work_mm,
            "wall_s": round(self._wall(), 3),
        }
        words = words or (self._journal_words if state in (RunState.HOLDING, RunState.HELD) else "")
        self._say("run", f"{run.view.name}: {state.value}{f' ({words})' if words else ''}")
        # Of any other run than the streamed one the driver knows nothing.
        mark = run.last_mark(self._link.progress) if run is self.streamed else {}
        run.move(state, words, **mark, **where, **more)

    def hold_without_journal(self, run: Run, error: JournalError) -> None:
        """Without a journal nothing may run: hold, and say why. Resume tries the disk again.

        Asked again at every look: a cycle start at the machine must not go on without a journal either.
        """
        words = f"held because {error}; make room, then resume"
        if not self._journal_words:
            self._journal_words = words
            self._say("journal", words)
        if not run.live or run.state is RunState.STOPPING:
            return
        if self._link.status.state not in _STANDS and not self._hold_asked:
            self._hold_asked = True
            self._link.hold_unasked()
        if run.state in _MOVING:
            run.record.update(state=RunState.HOLDING.value, words=words)

    # ------------------------------------------------------------------ how it ends

    def note_fault(self, event: Faulted) -> None:
        """The live run is interrupted; a link that is lost is dropped."""
        run, words = self.streamed, f"{event.cause.value}: {event.words}"
        self._say("fault", words)
        lost = event.cause is FaultCause.PORT_LOST
        try:
            if run is not None and run.live and self._link.driver is not None:
                going_on = lost and run.state is not RunState.STOPPING
                self._hold_asked = self._recovering = False
                self._change(run, RunState.INTERRUPTED, words, code=event.cause.value,
                             values={"detail": event.words, "alarm": event.alarm},
                             cause=event.cause.value, fault_line=event.line,
                             adrift=LINK_LOST if going_on else "")  # fmt: skip
                run.journal.hasten()
        finally:
            if lost or self._link.status.state is MillState.DISCONNECTED:
                if self._abort_asked:
                    self._link.latched = "abort"
                self.streamed = None
                self._link.drop(event.words)

    def note_end(self) -> None:
        """The streamed program has been executed to its end."""
        if self.streamed is not None and self.streamed.live:
            run = self.streamed
            self._end(run, RunState.FINISHED, "", touch_off=_TOUCH_OFF)

    def note_stop(self, event: Stopped) -> None:
        """The mill stands with empty buffers: a run that was to be aborted is."""
        run = self._runs.active
        kept = "" if event.position_kept else "position lost or never confirmed"
        self._say("state", f"stopped{f': {kept}' if kept else ''}")
        asked, self._abort_asked = self._abort_asked, False
        if run is not None and (run.state is RunState.STOPPING or (asked and run.state is RunState.INTERRUPTED)):
            self._end(run, RunState.ABORTED, "aborted by the operator", code=MillCode.ABORTED)

    def _end(self, run: Run, state: RunState, words: str, **more: object) -> None:
        self._change(run, state, words, ended_s=round(self._wall(), 3), **more)
        self._hold_asked = self._recovering = False
        if state is RunState.FINISHED:
            self.streamed = None
        run.journal.hasten()
        run.let_go()
