"""The run follows the mill: its state, its place, its journal. What happens without being asked for is here."""

from __future__ import annotations

from typing import Any

from machines.driver import MillState, MillStatus, StreamProgress
from machines.errors import JournalError, MachineError
from machines.gcode.program import ProgramReader
from machines.mill.core import MillCore
from machines.mill.link import AWAY
from machines.mill.run import Run
from machines.mill.standing import adrift, ashore, proven_line
from machines.preflight.preflight import Preflight
from machines.runs import RECOVERABLE, RunState

LOOK_S = 0.05
_STANDS = frozenset({MillState.HELD, MillState.DOOR, MillState.TOOL, MillState.SLEEP})
_MOVING = frozenset({RunState.RUNNING, RunState.RECOVERING})


class MillFollowing(MillCore):
    """Compares run and mill, many times a second."""

    def _look(self) -> None:
        """Compare run and mill, mark the journal, renew the snapshot."""
        self._look_at_s = self._clock() + LOOK_S
        driver = self._driver
        if driver is None:
            self._publish()
            return
        status, progress, run = driver.status, driver.progress, self._driven
        if status.state not in AWAY:
            self._link.seen()
        if not status.position_trusted:
            self._homed = False
        if run is not None:
            try:
                self._follow(run, status, progress)
            except JournalError as error:
                self._journal_failed(run, error)
        if self._live() is None:
            self._watch_adrift(status)
        self._publish()

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
            self._change(run, wanted, status.detail if wanted is RunState.HELD else "", status, progress)

    def _change(
        self, run: Run, state: RunState, words: str, status: MillStatus, progress: StreamProgress, **more: Any
    ) -> None:
        """A state change goes to the journal together with how far the run has come."""
        where = {"machine_mm": status.machine_mm, "work_mm": status.work_mm, "wall_s": round(self._wall(), 3)}
        words = words or (self._journal_words if state in (RunState.HOLDING, RunState.HELD) else "")
        self._say("run", f"{run.view.name}: {state.value}{f' ({words})' if words else ''}")
        mark = run.last_mark(progress) if run is self._driven else {}  # else the driver speaks of another stream
        run.move(state, words, **mark, **where, **more)

    def _noted(self, run: Run, state: RunState, words: str) -> None:
        """A change that was asked for. A disk that refuses does not stop a stop."""
        progress = self._driver.progress if self._driver is not None else StreamProgress()
        try:
            self._change(run, state, words, self.status, progress)
        except JournalError as error:
            self._say("journal", str(error))

    def _journal_failed(self, run: Run, error: JournalError) -> None:
        """Without a journal nothing may run: hold, and say why. Resume tries the disk again.

        Asked again at every look: a cycle start at the machine must not go on without a journal either.
        """
        words = f"held because {error}; make room, then resume"
        if not self._journal_words:
            self._journal_words = words
            self._say("journal", words)
        if not run.live or run.state is RunState.STOPPING:
            return
        if self.status.state not in _STANDS and not self._hold_asked:
            self._hold_asked = True
            self._order("hold")
        if run.state in _MOVING:
            run.record.update(state=RunState.HOLDING.value, words=words)

    def _order(self, what: str) -> None:
        """Hold or abort on our own account; a driver that refuses is told of, not raised."""
        try:
            self._link.order(what)
        except MachineError as error:
            self._say("fault", f"{what}: {error}")

    # ------------------------------------------------------------------ runs whose mill went on alone

    def _watch_adrift(self, status: MillStatus) -> None:
        place_mm = self._standstill.reached(status, self._clock())
        driver = self._driver
        if place_mm is None or driver is None:
            return
        for run in adrift(self._recoverable()):
            try:
                self._book_place(run, place_mm)
            except MachineError as error:  # the program is gone, or the disk refuses: what was known stays
                self._say("journal", f"{run.view.name}: {error}")
                run.record["adrift"] = ""

    def _book_place(self, run: Run, place_mm: tuple[float, float, float]) -> None:
        """Take over how far the mill has come without us; the first standstill after the link is back counts."""
        assert self._driver is not None
        _, reader = run.load(self._folders, lambda facts: self._reader(run, facts))
        line = proven_line(run, reader, self._driver, place_mm)
        if line is not None and line > run.executed_line:
            self._say("run", f"{run.view.name}: the mill went on to the end of line {line} before it stood still")
            ashore(run, executed_line=line, stood_mm=place_mm)
            run.journal.hasten()
        else:
            ashore(run)
        self._rest(run)

    def _note_touch(self, but: Run | None = None) -> None:
        """Something is done to the mill that may move it or its zero."""
        for run in adrift(self._recoverable()):
            if run is not but:
                ashore(run)
                self._rest(run)

    def _reader(self, run: Run, facts: Preflight) -> ProgramReader:
        return ProgramReader(run.path, facts.index)
