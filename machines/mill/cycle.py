"""The cycle of a mill's owner: reads the driver's reports, acts on them, and compares run and mill."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from machines.driver import (
    CommandDone,
    Event,
    Faulted,
    FrameChanged,
    MillState,
    Notice,
    ProgramDone,
    ReadSettings,
    Restarted,
    StateChanged,
    Stopped,
    allow_always,
)
from machines.errors import JournalError, NotAllowedError
from machines.mill.commands import Commands
from machines.mill.hand_spindle import HandSpindle
from machines.mill.link import AWAY, get_settings
from machines.mill.run_control import RunControl, UnattendedRuns
from machines.mill.view import MillContext
from phrases.phrase import Phrase

LOOK_S = 0.05
PLACE_S = 5.0  # some links never report the mill's position


@dataclass(eq=False)
class MillCycle:
    """Reads the driver and passes on its reports. Sends only queries, and what `HandSpindle.watch` sends."""

    context: MillContext
    control: RunControl
    commands: Commands
    spindle: HandSpindle
    unattended: UnattendedRuns
    publish: Callable[[], None]
    _look_at_s: float = float("-inf")

    def step(self, timeout_s: float) -> None:
        """Read, decide, write; wait at most `timeout_s`."""
        driver = self.context.link.driver
        if driver is None:
            if self.context.link.open(timeout_s):
                self.look()
            else:
                self.publish()
            return
        events = driver.poll(timeout_s)
        for event in events:
            self._handle(event)
        if events or self.context.clock() >= self._look_at_s:
            self.look()

    def look(self) -> None:
        """Compare run and mill, mark the journal, update the snapshot."""
        self._look_at_s = self.context.clock() + LOOK_S
        status = self.context.link.status
        if status.state not in AWAY:
            self.context.link.note_seen()
        if not status.position_trusted:
            self.context.link.setup.homed = False
        self.control.follow()
        self.unattended.watch()
        self.spindle.watch()
        self.publish()

    def read_settings(self) -> dict[str, Any] | None:
        """Return settings, offsets and parser state, read now; None if the link does not report them or the mill is
        not idle.
        """
        driver = self.context.link.driver
        if driver is None or driver.status.state not in (MillState.IDLE, MillState.ALARM):
            return None
        wanted = ReadSettings()
        try:
            driver.command(wanted, allow_always)
        except NotAllowedError:
            return None
        answer: dict[str, Any] | None = None
        ended_s: float | None = None
        stops = self.context.orders.stops
        while self.context.link.driver is driver and self.context.orders.stops == stops:
            for event in driver.poll(0.05):
                self._handle(event)
                if isinstance(event, CommandDone) and event.command == wanted:
                    ended_s = self.context.clock()
                    answer = None if event.failure else dict(event.answer)
            if ended_s is None:
                continue  # the driver ends it: it knows the delay of its answers
            # The work position comes with the offset, the spindle with the overrides: each only in some reports.
            whole = driver.status.work_mm is not None and driver.status.complete
            if answer is None or whole or self.context.clock() >= ended_s + PLACE_S:
                break
        return answer

    def _handle(self, event: Event) -> None:
        run = self.control.streamed
        self.spindle.take(event)
        try:
            match event:
                case Faulted():
                    self.control.note_fault(event)
                case ProgramDone():
                    self.control.note_end()
                case Stopped():
                    self.control.note_stop(event)
                case Restarted():
                    self._note_restart(event)
                case FrameChanged():
                    self._note_frame(event)
                case CommandDone():
                    self.commands.note_end(event)
                case Notice():
                    self.context.log.say("notice", event.words)
                case StateChanged():
                    self.context.log.say("state", event.after.value)
        except JournalError as error:
            if run is None:
                self.context.log.say("journal", error.words)
            else:
                self.control.hold_without_journal(run, error)
        self.publish()

    def _note_restart(self, event: Restarted) -> None:
        link, runs = self.context.link, self.context.runs
        self.context.log.say("link", Phrase("controller restarted: {banner}", banner=event.banner))
        if event.place_kept:
            runs.note_reset(link.status, link.setup.parser_state, get_settings(link.driver))
        else:
            link.setup.forget_place()
            runs.note_restart()
        link.setup.parser_state = None
        self.unattended.note_touch()

    def _note_frame(self, event: FrameChanged) -> None:
        self.context.log.say("notice", event.words)
        self.context.link.setup.forget_place()
        self.context.runs.note_frame_change()
