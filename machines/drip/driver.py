"""DNC drip feed with XON/XOFF (DC1/DC3) for Okuma-class controls. The handshake is done here and not in the port.

Why not the port's own XON/XOFF: a tty or a USB adapter queues hundreds of bytes that have passed the driver already;
at DC3 the kernel stops the bytes in its own queue, but not those in the adapter, and it hides when the control sent
DC3. An old control has room for few bytes after its DC3. So the port runs without handshake and this driver keeps so
little under way that in every case at most 16 bytes arrive after DC3:

    queued (8) + the bytes sent at a pace of at most 6 per 4 ms before DC3 is seen + the byte on the wire
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from machines.drip.feed import Pace
from machines.drip.one_way import OneWayDriver
from machines.driver import (
    Command,
    CommandDone,
    DriverFacts,
    MillState,
    Notice,
    ProgramLine,
    Require,
    Unlock,
    allow_always,
)
from machines.errors import MachineError, NotAllowedError, ProgramRefusedError
from phrases.phrase import Phrase

if TYPE_CHECKING:
    from machines.port import Port
    from machines.profile import LinkSettings

DC1, DC3 = 0x11, 0x13
BYTES_AFTER_STOP = 16
_QUEUED = 8
_BEFORE_SEEN = 6
_SEEN_AFTER_S = 0.004  # longest time until a byte from the control is seen here (USB adapter, scheduler)
_UNDER_WIRE_RATE = 0.98  # clocks of two UARTs may differ by 2 %: the queue must not grow over hours
_QUIET_AFTER_S = 60.0
_TAPE_MARK = b"%"

FACTS = DriverFacts(
    kind="DNC drip feed, XON/XOFF",
    capacity=f"the control says stop (DC3) and go on (DC1); at most {BYTES_AFTER_STOP} bytes follow a DC3",
    acknowledgement="none: progress is bytes that have left, execution is not visible",
    stop="sending stops; the control executes what its buffer holds: the operator presses feed hold",
    position="none",
    tried_on="only a simulated control (in memory and on a pty); never a real Okuma or other DNC control",
)


def refuse_text(text: bytes) -> Phrase | None:
    """Return why this block cannot be sent over a 7-bit line to such a control; None if it can."""
    for byte in text:
        if not 0x20 <= byte < 0x7F:
            return Phrase("byte 0x{byte:02x} is not printable 7-bit text", byte=byte)
    if text != text.upper():
        return Phrase("lower case: the control takes upper case only")
    if _TAPE_MARK in text and text.strip() != _TAPE_MARK:
        return Phrase("'%' inside a block would end the tape")
    return None


class DripDriver(OneWayDriver):
    """machines.driver.Driver over DC1/DC3; `port` must be open without any handshake of its own."""

    def __init__(self, port: Port, link: LinkSettings, *, planner_blocks: int = 0):
        pace = Pace(min(_UNDER_WIRE_RATE * link.wire_bytes_per_s, _BEFORE_SEEN / _SEEN_AFTER_S), _QUEUED)
        super().__init__(port, facts=FACTS, pace=pace, buffer_bytes=link.rx_bytes, planner_blocks=planner_blocks)
        self._open = False  # the last word of the control was DC1
        self._ever_open = False
        self._since_s = 0.0
        self._said_quiet = False
        self._said_parity = False
        self._tape_ended = False

    def connect(self) -> None:
        self._open = False
        self._channel.update(controller=FACTS.kind)
        self._channel.enter(MillState.IDLE, Phrase("line open; the control has not asked for anything yet"))

    def command(self, command: Command, require: Require = allow_always) -> None:
        """Unlock: the operator states that the control waits for bytes, e.g. because a DC1 was lost on the line."""
        if isinstance(command, Unlock):
            if self._feed is None:
                raise NotAllowedError(Phrase("there is no program under way that could wait for DC1"))
            require()
            before = self._open, self._ever_open
            self._open = self._ever_open = True
            try:
                if not self._held:
                    self._send_order(self._feed, require)
            except MachineError:  # too late: the line stays as it was
                self._open, self._ever_open = before
                raise
            self._since_s, self._said_quiet = self._port.clock(), False
            self._channel.events.append(CommandDone(command))
            return
        super().command(command, require)

    def _make_envelope(self) -> tuple[bytes, bytes]:
        self._ever_open, self._said_quiet, self._tape_ended = self._open, False, False
        self._since_s = self._port.clock()
        return b"%\r\n", _TAPE_MARK

    def _encode(self, line: ProgramLine) -> bytes:
        reason = refuse_text(line.text)
        if reason:
            raise ProgramRefusedError(line.number, line.text.decode("latin-1"), reason)
        if line.text.strip() == _TAPE_MARK:
            if self._feed is not None and self._feed.sent_line:
                self._tape_ended = True
            return b""  # the tape marks are written once, by the envelope
        if self._tape_ended:
            raise ProgramRefusedError(
                line.number, line.text.decode("latin-1"), Phrase("stands behind the '%' that ends the tape")
            )
        return line.text + b"\r\n"

    def _may_send(self) -> bool:
        return self._open

    def _describe_running(self) -> Phrase:
        if self._ever_open:
            return super()._describe_running()
        return Phrase("waits for the control's first DC1: start reading (DNC or tape mode, cycle start) at the control")

    def _receive(self, data: bytes, now_s: float) -> None:
        for byte in data:
            if byte & 0x80 and not self._said_parity:
                self._said_parity = True
                self._channel.events.append(
                    Notice(Phrase("the control sends with parity, the port reads 8 bits: check bytesize, parity"))
                )
            if byte & 0x7F == DC1:
                self._go_on(now_s)
            elif byte & 0x7F == DC3:  # DC2, DC4, NAK ... are for a tape punch and do not concern the sender
                self._stop(now_s)

    def _go_on(self, now_s: float) -> None:
        first = not self._ever_open
        self._open, self._ever_open, self._since_s, self._said_quiet = True, True, now_s, False
        if first and self._feed is not None and not self._held:
            self._channel.enter(MillState.RUN, self._describe_running())
            self._channel.events.append(Notice(Phrase("the control has asked for the program (DC1)")))

    def _stop(self, now_s: float) -> None:
        self._open, self._since_s = False, now_s

    def _tick(self, now_s: float) -> None:
        waiting = self._feed is not None and not self._feed.finished and not self._held and not self._open
        if waiting and not self._said_quiet and now_s - self._since_s > _QUIET_AFTER_S:
            self._said_quiet = True
            words = Phrase(
                "the control has not asked for the program (DC1) for {seconds:g} s: look at its screen",
                seconds=_QUIET_AFTER_S,
            )
            if self._ever_open:
                words = Phrase(
                    "the control has held the line (DC3) for {seconds:g} s: look at its screen", seconds=_QUIET_AFTER_S
                )
            self._channel.events.append(Notice(words))

    def abort(self) -> None:
        self._open = False  # a DC1 of the aborted reading must not start the next program
        super().abort()
