"""Time passes here: what a driver reports is read and acted on, and run and mill are compared many times a second."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from machines.driver import (
    CommandDone,
    Event,
    Faulted,
    MillState,
    Notice,
    ProgramDone,
    ReadSettings,
    Restarted,
    StateChanged,
    Stopped,
)
from machines.errors import JournalError, NotAllowedError
from machines.mill.commands import Commands
from machines.mill.link import AWAY
from machines.mill.run_control import RunControl
from machines.mill.unattended import UnattendedRuns
from machines.mill.view import MillContext

LOOK_S = 0.05
ASK_S = 5.0


class MillCycle:
    """Reads the driver and hands on what it reports. Sends nothing but questions."""

    def __init__(
        self,
        context: MillContext,
        control: RunControl,
        commands: Commands,
        unattended: UnattendedRuns,
        publish: Callable[[], None],
    ) -> None:
        self._link = context.link
        self._runs = context.runs
        self._say = context.log.say
        self._orders = context.orders
        self._clock = context.clock
        self._control = control
        self._commands = commands
        self._unattended = unattended
        self._publish = publish
        self._look_at_s = float("-inf")

    def step(self, timeout_s: float) -> None:
        """Read, decide, write; wait at most `timeout_s`."""
        driver = self._link.driver
        if driver is None:
            if self._link.open(timeout_s):
                self.look()
            else:
                self._publish()
            return
        events = driver.poll(timeout_s)
        for event in events:
            self._handle(event)
        if events or self._clock() >= self._look_at_s:
            self.look()

    def look(self) -> None:
        """Compare run and mill, mark the journal, renew the snapshot."""
        self._look_at_s = self._clock() + LOOK_S
        status = self._link.status
        if status.state not in AWAY:
            self._link.seen()
        if not status.position_trusted:
            self._link.setup.homed = False
        self._control.follow()
        self._unattended.watch()
        self._publish()

    def read_settings(self) -> dict[str, Any] | None:
        """Settings, offsets and parser state, read now; None where the link does not tell or the mill is not idle."""
        driver = self._link.driver
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
        stops = self._orders.stops
        while (
            self._clock() < until_s
            and self._link.driver is driver
            and self._orders.stops == stops
            and not (ended and driver.status.work_mm is not None)
        ):
            for event in driver.poll(0.05):
                self._handle(event)
                if isinstance(event, CommandDone) and event.command == wanted:
                    ended = True
                    answer = None if event.failure else dict(event.answer)
            if ended and answer is None:
                break
        return answer

    def _handle(self, event: Event) -> None:
        run = self._control.streamed
        try:
            match event:
                case Faulted():
                    self._control.note_fault(event)
                case ProgramDone():
                    self._control.note_end()
                case Stopped():
                    self._control.note_stop(event)
                case Restarted():
                    self._note_restart(event)
                case CommandDone():
                    self._commands.note_end(event)
                case Notice():
                    self._say("notice", event.words)
                case StateChanged():
                    self._say("state", event.after.value)
        except JournalError as error:
            if run is None:
                self._say("journal", str(error))
            else:
                self._control.hold_without_journal(run, error)
        self._publish()

    def _note_restart(self, event: Restarted) -> None:
        self._link.setup.parser_state = None
        self._say("link", f"controller restarted: {event.banner}")
        self._unattended.note_touch()
        if not self._link.status.position_trusted:
            self._link.setup.forget_place()
            self._runs.note_restart()
