"""A mill as its owner sees it: one driver, one journal, at most one live run. Single-threaded: everything is `step`.

Nothing here moves the mill by itself. A lost link is opened again with growing patience, and then the only things sent
unasked are questions and a hold or an abort that somebody had asked for while the link was away. Every start and every
recovery needs a person's confirmation.

The parts, each on top of the one before: mill_core (what is known), mill_following (the run follows the mill),
mill_events (what a driver reports), mill_starting (start and recover); here are the controls and the end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from machines.driver import Command, Jog, JogCancel, MillState, Override, ReadSettings
from machines.errors import JournalError, MachineError, NotAllowedError
from machines.mill.orders import NOBODY, Caller, Stop
from machines.mill.run import Run
from machines.mill.starting import MillStarting
from machines.mill.view import LogEntry, MillSnapshot
from machines.runs import RunState

__all__ = ["LogEntry", "Mill", "MillSnapshot"]

T = TypeVar("T")

_MOVES = frozenset({MillState.RUN, MillState.HOLDING, MillState.JOG, MillState.HOMING})
_QUIET = frozenset({MillState.IDLE, MillState.ALARM, MillState.CHECK, MillState.SLEEP})
_MOVES_NOTHING = (ReadSettings, Override, JogCancel)


class Mill(MillStarting):
    """One mill and the folder its runs live in."""

    def carry_out(self, doing: str, act: Callable[[Mill], T], caller: Caller, *, needs_lease: bool = False) -> T:
        """Carry out an order under the caller's grant; the log says whose it was and what came of it.

        The grant is looked at now, and again when nothing but the wire is left. OrderRefusedError, or that of `act`.
        """
        try:
            self._permit = self.orders.redeem(caller.grant, doing, needs_lease=needs_lease)
            self._caller = caller
            answer = act(self)
        except MachineError as error:
            self._say("order", f"{doing}: refused: {error}", caller=caller)
            self._publish()
            raise
        finally:
            self._permit, self._caller = None, NOBODY
        self._say("order", f"{doing}: taken", caller=caller)
        self._publish()
        return answer

    def carry_out_stop(self, stop: Stop, caller: Caller) -> None:
        """Hold, abort or end a jog, whoever asks; the log says who."""
        self._say("order", stop.value, caller=caller)
        {Stop.HOLD: self.hold, Stop.ABORT: self.abort, Stop.JOG_CANCEL: self.cancel_jog}[stop]()

    def publish(self) -> None:
        """Renew the snapshot."""
        self._publish()

    def cancel_jog(self) -> None:
        """End a jog, keeping the position. Nothing to do without a link."""
        if self._driver is not None and not self._link.away:
            self.command(JogCancel())

    def hold(self) -> None:
        """Stop motion, keeping the position. Always taken: without a link it is carried out when the link is back."""
        try:
            self._link.order("hold")
        finally:
            run = self._live()
            if run is not None and run.state in (RunState.RUNNING, RunState.RECOVERING):
                self._hold_asked = True
                self._noted(run, RunState.HOLDING, "")
            self._look()

    def resume(self) -> None:
        """Go on after a hold."""
        driver = self._driver
        if self._link.latched and self._link.away:
            raise NotAllowedError(
                f"resume: the mill is not connected; the {self._link.latched} is carried out first when it is back"
            )
        if driver is None:
            raise NotAllowedError(f"resume: the mill is disconnected ({self._link.problem}); allowed when it is held")
        run = self._live()
        if run is not None:
            if run.state not in (RunState.HELD, RunState.HOLDING):
                raise NotAllowedError(f"resume: run {run.id} is {run.state.value}; allowed when it is held")
            run.journal.repair()
            run.journal.append("resume", wall_s=round(self._wall(), 3))
            self._journal_words = ""
        self._require_permit()
        driver.resume()
        self._hold_asked = False
        self._look()

    def abort(self) -> None:
        """End the run: hold, and from standstill clear what the controller holds. Always taken, as `hold` is."""
        run = self._active
        if run is not None and run.state is RunState.PARKED:
            self._take_back(run)
            if self.status.state in _QUIET:
                return
        self._abort_asked = True
        try:
            self._link.order("abort")  # before anything that waits for a disk
        finally:
            if run is not None and run.live and run.state is not RunState.STOPPING:
                self._noted(run, RunState.STOPPING, "")
            self._look()

    def _take_back(self, run: Run) -> None:
        """A run that has not begun."""
        try:
            run.move(RunState.ABORTED, "taken back before its start", ended_s=round(self._wall(), 3))
        except JournalError as error:
            self._say("journal", str(error))
        run.let_go()
        self._look()

    def command(self, command: Command) -> None:
        """Home, unlock, jog, probe, zero, override ...: the answer comes as an entry of the log."""
        self._open()
        driver = self._driver
        if driver is None:
            raise NotAllowedError(f"{type(command).__name__}: the mill is disconnected ({self._link.problem})")
        if not isinstance(command, _MOVES_NOTHING) and self._live() is None:
            self._watch_adrift(driver.status)
            try:
                self._note_touch()
            except JournalError as error:
                raise NotAllowedError(f"{type(command).__name__}: {error}; an interrupted run rests on it") from None
        stood_mm = driver.status.machine_mm
        self._require_permit()
        driver.command(command)
        self._commander = (command, self._caller)
        if isinstance(command, Jog):
            self._jog_from_mm = stood_mm
        self._look()

    # ------------------------------------------------------------------ ending

    def may_close(self, *, detach: bool = False) -> None:
        """NotAllowedError while the mill moves under a live run, unless it may go on unwatched."""
        run = self._live()
        if detach or run is None or self.status.state not in _MOVES:
            return
        raise NotAllowedError(f"stop: run {run.id} is {run.state.value}, the mill {self.status.state.value}; hold it, "
                              "or say that it may go on without us (detach)")  # fmt: skip

    def close(self, *, detach: bool = False) -> None:
        """Let go of port, journal and folder. The mill keeps what it holds; a live run will be found interrupted."""
        if self._closed:
            return
        self.may_close(detach=detach)
        self._closed = True
        try:
            self._link.close()
        finally:
            for run in self._runs.values():
                run.close()
            self._lock.release()

    def note_failure(self, error: BaseException) -> None:
        """The owner thread ends because of this: hold what moves or may move, and leave the words behind."""
        self._say("fault", f"the agent failed: {type(error).__name__}: {error}")
        if self._driver is not None and (self._live() is not None or self.status.state in _MOVES):
            try:
                self._link.order("hold")
            except MachineError as refused:
                self._say("fault", f"hold: {refused}")
        self._publish()
