"""The common base of links that only take bytes: no answer per line, no position, and no stop except to stop sending.

Progress is counted in bytes sent; what the machine does with them is not known, and this driver claims no more than
that. A line counts as executed only when the far end's buffers cannot hold it any more.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from machines.drip.feed import ByteFeed, Pace
from machines.driver import (
    Command,
    CommandDone,
    DriverFacts,
    Event,
    FaultCause,
    Faulted,
    MillState,
    MillStatus,
    Notice,
    ProgramDone,
    ProgramLine,
    Require,
    StatusChannel,
    Stopped,
    StreamProgress,
    TrustPosition,
    allow_always,
)
from machines.errors import MachineError, NotAllowedError, PortError
from phrases.phrase import Phrase

if TYPE_CHECKING:
    from machines.port import Port

_END_GRACE_S = 0.5  # after the last byte, for a reaction of the far end


class OneWayDriver:
    """Base of the drip feed and of the serial Roland, which define the form of a block and when bytes may be sent."""

    protections: tuple[str, ...] = ()

    def __init__(self, port: Port, *, facts: DriverFacts, pace: Pace, buffer_bytes: int | None, planner_blocks: int):
        self._port = port
        self.facts = facts
        self._pace = pace
        self._buffer_bytes = buffer_bytes
        self._planner_blocks = planner_blocks
        self._channel = StatusChannel(MillStatus(buffer_bytes=buffer_bytes, controller=facts.kind))
        self._feed: ByteFeed | None = None
        self._held = False
        self._last_byte_s = 0.0

    # The differences between the two links.

    def _encode(self, line: ProgramLine) -> bytes:
        raise NotImplementedError

    def _make_envelope(self) -> tuple[bytes, bytes]:
        """Return bytes before the first and after the last block."""
        return b"", b""

    def _may_send(self) -> bool:
        """Return whether the far end takes bytes now."""
        return True

    def _receive(self, data: bytes, now_s: float) -> None:
        """Handle bytes received from the far end."""

    def _tick(self, now_s: float) -> None:
        """Do the periodic work of every turn of a poll."""

    def _describe_running(self) -> Phrase:
        return Phrase("sending; this link does not show what the machine does with the bytes")

    def _describe_held(self) -> Phrase:
        """Return how much the machine may still execute, in words."""
        known = self._buffer_bytes
        if known is None:
            return Phrase("everything in its buffer (size not known)")
        return Phrase("up to {count} bytes", count=known)

    # The interface.

    @property
    def status(self) -> MillStatus:
        return self._channel.status

    @property
    def progress(self) -> StreamProgress:
        return self._channel.progress

    def connect(self) -> None:
        self._channel.enter(MillState.IDLE, Phrase("line open; the link stays silent until a program is read"))

    def poll(self, timeout_s: float) -> tuple[Event, ...]:
        deadline_s = self._port.clock() + timeout_s
        while self.status.state is not MillState.DISCONNECTED:
            try:
                wait_s = self._turn()
                if self._channel.events:
                    break
                before_s = self._port.clock()
                wait_s = min(wait_s, deadline_s - before_s)
                data = self._port.read(max(0.0, wait_s))
                now_s = self._port.clock()
                if data:
                    self._receive(data, now_s)
            except PortError as error:
                self._lose(error.words)
                break
            if self._channel.events or now_s >= deadline_s or (not data and now_s < before_s + wait_s):
                break  # the last case: wake() was called
        self._book()
        return self._channel.take_events()

    def wake(self) -> None:
        self._port.wake()

    def urge(self, stop: str) -> bool:
        return False  # a one-way link has no byte that stops: the owner stops feeding

    def start(self, lines: Iterator[ProgramLine], require: Require = allow_always) -> None:
        if self.status.state is not MillState.IDLE:
            raise NotAllowedError(
                Phrase("a program can start only when the link is idle, it is {state}", state=self.status.state.words)
            )
        head, tail = self._make_envelope()
        self._feed = ByteFeed(lines, self._encode, head, tail, self._buffer_bytes, self._planner_blocks)
        self._held = False
        try:
            self._send_order(self._feed, require)
        except MachineError:
            self._feed = None
            raise

    def hold(self) -> None:
        """Send nothing more. Never HELD: whether the machine stands is not visible on this link."""
        if self._feed is None or self._held:
            return
        self._held = True
        words = Phrase(
            "sending has stopped; the machine still executes {held}: press feed hold at the machine",
            held=self._describe_held(),
        )
        self._channel.enter(MillState.HOLDING, words)
        self._channel.events.append(Notice(words))

    def resume(self, require: Require = allow_always) -> None:
        if self._feed is None or not self._held:
            raise NotAllowedError(
                Phrase("there is nothing to resume: the link is {state}", state=self.status.state.words)
            )
        self._send_order(self._feed, require)

    def _send_order(self, feed: ByteFeed, require: Require) -> None:
        """Write the first bytes of an order now, if the far end takes bytes. Raise MachineError if it is too late.

        If it takes none now, the bytes are sent when a person at its panel lets it ask for them.
        """
        now_s = self._port.clock()
        room = self._pace.room(now_s) if self._may_send() else 0
        piece = self._take_piece(feed, room, now_s)
        if self._feed is None:
            return  # the program cannot be read
        try:
            require()
        except MachineError:
            feed.put_back(piece)
            raise
        self._held = False
        self._channel.enter(MillState.RUN, self._describe_running())
        try:
            self._write_piece(piece, now_s)
        except PortError as error:
            self._lose(error.words)
            return
        self._book()
        try:
            require()
        except MachineError:
            self.hold()

    def abort(self) -> None:
        if self.status.state is MillState.DISCONNECTED:
            raise NotAllowedError(Phrase("the link is lost: stop the machine at its own panel"))
        self._end_stream()
        words = Phrase(
            "sending has ended; the machine may still execute {held}: reset it at its own panel",
            held=self._describe_held(),
        )
        self._channel.events += [Notice(words), Stopped(position_kept=False)]
        self._channel.update(position_trusted=False)
        self._channel.enter(MillState.IDLE, words)

    def command(self, command: Command, require: Require = allow_always) -> None:
        if not isinstance(command, TrustPosition):
            raise NotAllowedError(
                Phrase(
                    "{command} is not possible on this link: do it at the machine's panel",
                    command=type(command).__name__,
                )
            )
        self._channel.update(position_trusted=True)
        self._channel.events.append(CommandDone(command))

    def close(self) -> None:
        self._port.close()

    # Inside.

    def _turn(self) -> float:
        """Send the bytes that may be sent now; return the seconds until there is more to do."""
        now_s = self._port.clock()
        self._tick(now_s)
        feed = self._feed
        if feed is None:
            return 1e9
        if feed.finished:
            return self._finish(now_s)
        if self._held or not self._may_send():
            return 1e9
        room = self._pace.room(now_s)
        if room:
            self._write_piece(self._take_piece(feed, room, now_s), now_s)
        if self._feed is None:
            return 1e9
        return self._pace.wait_s(now_s, self._pace.most_queued // 2)

    def _take_piece(self, feed: ByteFeed, room: int, now_s: float) -> bytes:
        """Return the next bytes of the program, at most `room`. If it cannot be read, end it and return none."""
        try:
            return feed.take(room) if room else b""
        except (MachineError, OSError) as error:
            self._end_stream()
            self._channel.enter(MillState.IDLE, Phrase("sending has stopped"))
            self._channel.events.append(
                Faulted(FaultCause.PROGRAM_CHANGED, Phrase("{error}", error=str(error)), feed.sent_line, now_s)
            )
            return b""

    def _write_piece(self, piece: bytes, now_s: float) -> None:
        if piece:
            self._port.write(piece)
            self._pace.note_written(len(piece), now_s)
            self._last_byte_s = now_s

    def _finish(self, now_s: float) -> float:
        """Wait until all bytes that were handed over are sent, then report that."""
        end_s = self._last_byte_s + self._pace.wait_s(now_s, 0) + _END_GRACE_S
        if now_s < end_s or self._count_unsent(now_s):
            return max(end_s - now_s, 0.01)
        self._book()
        self._end_stream()
        words = Phrase(
            "every byte has left; the machine may still be cutting {held}: wait for its own end signal",
            held=self._describe_held(),
        )
        self._channel.events += [Notice(words), ProgramDone()]
        self._channel.enter(MillState.IDLE, words)
        return 1e9

    def _count_unsent(self, now_s: float) -> int:
        """Return bytes written that have not left the host yet."""
        return self._pace.count_queued(now_s)

    def _book(self) -> None:
        feed = self._feed
        if feed is None:
            return
        taken = max(0, feed.handed_bytes - self._count_unsent(self._port.clock()))
        feed.note_taken(taken)
        self._channel.progress = StreamProgress(
            sent_line=feed.sent_line,
            sent_offset=feed.sent_offset,
            answered_line=feed.answered_line,
            executed_line=feed.executed_line,
            bytes_in_flight=feed.handed_bytes - taken,
            lines_in_flight=feed.lines_in_flight,
            streaming=True,
        )

    def _end_stream(self) -> None:
        if self._feed is not None:
            self._book()
        self._feed, self._held = None, False
        self._channel.end_stream()

    def _lose(self, words: Phrase) -> None:
        now_s = self._port.clock()
        streaming, line = self._feed is not None, self.progress.sent_line
        self._feed = None
        self._channel.end_stream()
        self._channel.update(position_trusted=False, epoch=self.status.epoch + 1)
        self._channel.enter(MillState.DISCONNECTED, words)
        if streaming:
            words = Phrase("{words}; the machine still executes {held}", words=words, held=self._describe_held())
        self._channel.events.append(Faulted(FaultCause.PORT_LOST, words, line, now_s))
