"""Drives a GRBL controller over a port: reads, lets the session decide, writes. All decisions are in session.py."""

from __future__ import annotations

from collections.abc import Iterator

from machines.driver import (
    Command,
    DriverFacts,
    Event,
    FaultCause,
    Faulted,
    MillStatus,
    ProgramLine,
    Require,
    StreamProgress,
    allow_always,
)
from machines.errors import MachineError, NotAControllerError, PortError
from machines.grbl.commands import JOG_CANCEL
from machines.grbl.link import GrblOptions
from machines.grbl.session import GrblSession
from machines.grbl.settings import ControllerSettings
from machines.grbl.states import Phase
from machines.port import Port

FEED_HOLD = b"!"


class GrblDriver:
    """machines.driver.Driver around one port. Its time is the port's clock."""

    def __init__(self, port: Port, *, options: GrblOptions | None = None) -> None:
        self._port = port
        self._session = GrblSession(options, wire_bytes_per_s=port.wire_bytes_per_s)
        self.failure: MachineError | None = None  # why the link was given up
        self._urged = False  # a '!' was sent that the session does not know about

    @property
    def facts(self) -> DriverFacts:
        return self._session.reporter.facts

    @property
    def status(self) -> MillStatus:
        return self._session.reporter.status

    @property
    def progress(self) -> StreamProgress:
        return self._session.streamer.progress

    @property
    def protections(self) -> tuple[str, ...]:
        return self._session.reporter.protections

    @property
    def settings(self) -> ControllerSettings:
        return self._session.link.view.settings

    @property
    def offers_reset(self) -> bool:
        """Whether nothing answers and a `Reset` may help: after ALARM:1 and ALARM:2 GRBL accepts nothing else."""
        return self._session.link.offers_reset

    def connect(self) -> None:
        self.failure = None
        self._session.connect(self._port.clock())

    def poll(self, timeout_s: float) -> tuple[Event, ...]:
        """Write what is due, wait for input until the next deadline, decide, write."""
        port, session = self._port, self._session
        try:
            now_s = port.clock()
            self._write(now_s)
            wait_s = session.next_deadline_s - now_s
            if wait_s > timeout_s:
                wait_s = timeout_s
            data = port.read(wait_s if wait_s > 0.0 else 0.0)
            now_s = port.clock()
            if data:
                session.receive(data, now_s)
            self._write(now_s)
        except PortError as error:
            self.failure = error
            session.lose(error.words, port.clock())
        return self._name_fault(session.take_events())

    def _write(self, now_s: float) -> None:
        session = self._session
        session.tick(now_s)
        data = session.output(now_s)
        if data:
            self._port.write(data)

    def _name_fault(self, events: tuple[Event, ...]) -> tuple[Event, ...]:
        """Add the name of the port to the error of a link on which no controller answers."""
        for event in events:
            if isinstance(event, Faulted) and event.cause is FaultCause.DEVICE:
                self.failure = NotAControllerError(self._port.url, event.words)
                named = Faulted(event.cause, self.failure.words, event.line, event.at_s)
                return tuple(named if one is event else one for one in events)
        return events

    def wake(self) -> None:
        self._port.wake()

    def urge(self, stop: str) -> bool:
        """Write a realtime byte; it may stand anywhere in the stream, in the middle of a line too.

        An abort of a mill that stands idle needs none: '!' would leave it in Hold.
        """
        if stop == "jog-cancel":
            return self._port.write_realtime(JOG_CANCEL)
        if stop == "abort" and self._session.stops.is_quiet:
            return True
        self._urged = True  # set before the byte is sent: the owner's own call may come at once
        return self._port.write_realtime(FEED_HOLD)

    def start(self, lines: Iterator[ProgramLine], require: Require = allow_always) -> None:
        """Stream these blocks. Read the first of them from the disk before the last check of the order."""
        session, now_s = self._session, self._port.clock()
        session.start(lines, now_s)
        self._write_urgent()
        first = session.output(now_s)
        try:
            require()
        except MachineError:
            session.take_back_start(now_s)
            raise
        self._send_order(first, require)

    def hold(self) -> None:
        self._urged = self._urged and self._session.link.phase is Phase.CLEARING  # otherwise the session knows about it
        self._session.hold(self._port.clock())
        self._write_urgent()

    def resume(self, require: Require = allow_always) -> None:
        require()
        self._session.resume(self._port.clock())
        self._send_order(self._session.output(self._port.clock()), require)

    def abort(self) -> None:
        hold_sent, self._urged = self._urged, False
        self._session.abort(self._port.clock(), hold_sent=hold_sent)
        self._write_urgent()

    def _write_urgent(self) -> None:
        """Write urgent bytes now, not at the next poll."""
        self._write_now(self._session.urgent_output(self._port.clock()))

    def command(self, command: Command, require: Require = allow_always) -> None:
        require()
        self._session.command(command, self._port.clock(), require)
        self._send_order(self._session.output(self._port.clock()), require)

    def _send_order(self, first: bytes, require: Require) -> None:
        """Write the first bytes of an order that `require` has just allowed.

        A stop that comes after that check may have written its byte before these bytes: then send one more hold.
        """
        self._write_now(first)
        try:
            require()
        except MachineError:
            self.hold()

    def _write_now(self, data: bytes) -> None:
        try:
            if data:
                self._port.write(data)
        except PortError as error:
            self.failure = error
            self._session.lose(error.words, self._port.clock())

    def close(self) -> None:
        self._session.close(self._port.clock())
        self._port.close()
