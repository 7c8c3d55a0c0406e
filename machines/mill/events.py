"""What a driver reports, and what becomes of it."""

from __future__ import annotations

from machines.driver import (
    CommandDone,
    Event,
    FaultCause,
    Faulted,
    Home,
    MillState,
    Notice,
    ProbeZ,
    ProgramDone,
    ReadSettings,
    Restarted,
    SetZero,
    StateChanged,
    Stopped,
)
from machines.errors import JournalError
from machines.mill.command_words import command_words
from machines.mill.following import MillFollowing
from machines.mill.orders import NOBODY
from machines.mill.run import Run
from machines.mill.standing import LINK_LOST
from machines.runs import RunState

_TOUCH_OFF = "a program has ended: if the tool is changed now, touch off Z again (probe or set zero)"


class MillEvents(MillFollowing):
    """Time passes here: `step` reads, decides, writes."""

    def step(self, timeout_s: float) -> None:
        """Read, decide, write; wait at most `timeout_s`."""
        driver = self._driver
        if driver is None:
            if self._link.open(timeout_s):
                self._look()
            else:
                self._publish()
            return
        events = driver.poll(timeout_s)
        for event in events:
            self._on(event)
        if events or self._clock() >= self._look_at_s:
            self._look()

    def _on(self, event: Event) -> None:
        run = self._driven
        try:
            if isinstance(event, Faulted):
                self._note_fault(event, run)
            elif isinstance(event, ProgramDone) and run is not None and run.live:
                self._ended(run, RunState.FINISHED, "", touch_off=_TOUCH_OFF)
            elif isinstance(event, Stopped):
                self._stopped(event)
            elif isinstance(event, Restarted):
                self._note_restart(event)
            elif isinstance(event, CommandDone):
                self._note_command(event)
            elif isinstance(event, Notice):
                self._say("notice", event.words)
            elif isinstance(event, StateChanged):
                self._say("state", event.after.value)
        except JournalError as error:
            if run is None:
                self._say("journal", str(error))
            else:
                self._journal_failed(run, error)

    def _note_fault(self, event: Faulted, run: Run | None) -> None:
        words = f"{event.cause.value}: {event.words}"
        self._say("fault", words)
        lost = event.cause is FaultCause.PORT_LOST
        try:
            if run is not None and run.live and self._driver is not None:
                going_on = lost and run.state is not RunState.STOPPING
                self._hold_asked = self._recovering = False
                self._change(run, RunState.INTERRUPTED, words, self._driver.status, self._driver.progress,
                             cause=event.cause.value, fault_line=event.line,
                             adrift=LINK_LOST if going_on else "")  # fmt: skip
                run.journal.hasten()
        finally:
            if lost or self.status.state is MillState.DISCONNECTED:
                if self._abort_asked:
                    self._link.latched = "abort"
                self._drop_link(event.words)

    def _drop_link(self, words: str) -> None:
        self._driven = None
        self._parser_state = None
        self._forget_place()
        self._link.drop(words)
        self._publish()

    def _ended(self, run: Run, state: RunState, words: str, **more: object) -> None:
        assert self._driver is not None
        self._change(
            run, state, words, self._driver.status, self._driver.progress, ended_s=round(self._wall(), 3), **more
        )
        self._hold_asked = self._recovering = False
        if state is RunState.FINISHED:
            self._driven = None
        run.journal.hasten()
        run.let_go()

    def _stopped(self, event: Stopped) -> None:
        run = self._active
        kept = "" if event.position_kept else "position lost or never confirmed"
        self._say("state", f"stopped{f': {kept}' if kept else ''}")
        asked, self._abort_asked = self._abort_asked, False
        if run is not None and (run.state is RunState.STOPPING or (asked and run.state is RunState.INTERRUPTED)):
            self._ended(run, RunState.ABORTED, "aborted by the operator")

    def _note_restart(self, event: Restarted) -> None:
        """All runs that could be recovered learn that the controller has forgotten its position."""
        self._parser_state = None
        self._say("link", f"controller restarted: {event.banner}")
        self._note_touch()
        if not self.status.position_trusted:
            self._forget_place()
            for run in self._recoverable():
                run.write("restarted", restarted=True)
                self._rest(run)

    def _forget_place(self) -> None:
        self._zeroed, self._homed = "", False

    def _note_command(self, event: CommandDone) -> None:
        command = event.command
        words = command_words(event, from_mm=self._jog_from_mm, at_mm=self.status.machine_mm)
        given = self._commander
        caller = given[1] if given is not None and given[0] is command else NOBODY
        self._say("command", words, event.answer, caller)
        if event.failure:
            return
        if isinstance(command, ReadSettings):
            self._parser_state = str(event.answer.get("parser_state", "")) or None
        axes = command.axes if isinstance(command, SetZero) else "Z" if isinstance(command, ProbeZ) else ""
        if isinstance(command, Home):
            self._homed = True
        if "Z" in axes:
            self._note_touch_off()
        if axes:
            self._zeroed = "".join(sorted({*self._zeroed, *axes}))
            for run in self._recoverable():
                vouched = "".join(sorted({*str(run.record.get("zeroed", "")), *axes}))
                run.write("zeroed", zeroed=vouched)
                self._rest(run)
            for run in (one for one in self._runs.values() if one.state is RunState.PARKED):
                run.write("zeroed", warnings=run.lasting_warnings)  # its start asks again, at the new zero
            self._publish()
