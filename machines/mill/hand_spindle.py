"""The spindle outside programs: a person switches it on and off, and it goes off when that person is not in control.

Switched on by an order, it may turn as long as the person who gave the order has control and nobody holds or aborts the
mill; then it is switched off, as soon as the controller takes it. While it may turn no program starts, and nothing is
probed. Only an order switches it on: `watch` sends an end of a jog, M5, or a reset of a mill that stands.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from machines.driver import (
    Command,
    CommandDone,
    Event,
    JogCancel,
    MillState,
    ProbeCorner,
    ProbeZ,
    Reset,
    Restarted,
    SendBlock,
    Spindle,
    allow_always,
)
from machines.errors import MachineError, NotAllowedError
from machines.gcode.text import strip_block
from machines.mill.commands import Commands
from machines.mill.orders import Order
from machines.mill.view import MillContext
from phrases.phrase import Phrase

AGAIN_S = 0.5  # between two tries to switch it off
_OFF: dict[MillState, Command] = {MillState.IDLE: Spindle(None), MillState.JOG: JogCancel()}
_OFF |= dict.fromkeys(
    (MillState.ALARM, MillState.HELD, MillState.CHECK, MillState.DOOR), Reset()
)  # M5 is not read then
_TURNS = re.compile(rb"M0*[34](?!\d)")


@dataclass(eq=False)
class HandSpindle:
    """rpm : slowest and fastest speed of this mill; None: its spindle is not switched by hand from here"""

    context: MillContext
    commands: Commands
    rpm: tuple[float, float] | None
    _order: Order | None = None  # the order under which it may turn; None: nobody has switched it on
    _ending: bool = False
    _try_at_s: float = float("-inf")

    @property
    def may_turn(self) -> bool:
        """Whether somebody has switched it on and it is not yet known to be off again."""
        return self._order is not None

    def require_off(self, doing: str) -> None:
        if self.may_turn:
            raise NotAllowedError(
                Phrase("{doing}: the spindle was switched on by hand; switch it off first", doing=doing)
            )

    def switch(self, rpm: float | None, order: Order) -> None:
        """Switch it on or off by a person's order. NotAllowedError."""
        if rpm is not None:
            self._require_speed(rpm)
        if (live := self.context.runs.live) is not None:
            raise NotAllowedError(Phrase("Spindle: {run} is on the mill; the program has the spindle", run=live.name))
        self.send(Spindle(rpm), order)

    def _require_speed(self, rpm: float) -> None:
        if self.rpm is None:
            raise NotAllowedError(Phrase("Spindle: this mill's spindle is not switched from here"))
        low, high = self.rpm
        if not max(low, 1.0) <= rpm <= high:
            words = Phrase("Spindle: {rpm:g} rpm; this mill turns at {low:g} to {high:g}", rpm=rpm, low=low, high=high)
            raise NotAllowedError(words)

    def send(self, command: Command, order: Order) -> None:
        """Send a command, which may be one that switches the spindle on, such as a line with M3."""
        if isinstance(command, (ProbeZ, ProbeCorner)):
            self.require_off(Phrase("Probe"))
        before = self._order
        if _switches_on(command):
            self._order = order  # before its first byte: a write that fails may have sent it
        try:
            self.commands.send(command, order)
        except MachineError:
            self._order = before  # refused: none of it was sent
            raise

    def take(self, event: Event) -> None:
        """Note that the controller has switched it off."""
        off = isinstance(event, CommandDone) and event.command == Spindle(None) and not event.failure
        if off or isinstance(event, Restarted):
            self._order, self._ending = None, False

    def watch(self) -> None:
        """Switch it off if the person who switched it on has lost control or the mill was stopped. Never waits."""
        order, link = self._order, self.context.link
        if order is None:
            return
        ends = link.driver is None or not order.has_control
        if ends and not self._ending:
            self._ending = True
            self.context.log.say(
                "notice", Phrase("the spindle is switched off: the mill was stopped, or control of it ended")
            )
        driver, now_s = link.driver, self.context.clock()
        if not self._ending or driver is None or now_s < self._try_at_s:
            return
        if (command := _OFF.get(driver.status.state)) is not None:
            self._try_at_s = now_s + AGAIN_S
            try:
                driver.command(command, allow_always)
            except MachineError:
                self._try_at_s = now_s  # the link is busy: at the next look

    def end(self) -> None:
        """End everybody's use of it: the owner is about to close."""
        self._ending = self.may_turn


def _switches_on(command: Command) -> bool:
    match command:
        case Spindle(rpm=rpm):
            return rpm is not None
        case SendBlock(text=text):
            return _TURNS.search(strip_block(text.encode("ascii", "replace"))) is not None
        case _:
            return False
