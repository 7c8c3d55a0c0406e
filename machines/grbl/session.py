"""The protocol core: bytes and time in, bytes, events and deadlines out. No thread, no port, no clock.

Rules that hold at every moment:
- Only `ok` and `error:n` that come after the handshake belong to the stream; a banner ends the epoch and with it the
  stream: the controller has forgotten everything.
- The first sign of a fault puts '!' before everything else that is waiting to be written, in the call that saw it. The
  lines that the controller still holds are cleared by a reset, and that only when it reports standstill: a reset in
  motion loses the position.
- Nothing is sent by itself that can start motion.

Its parts know only those before them: link (shared state), streaming (the program under way), commands, status,
stopping (hold, fault, abort, resets), monitoring (is the program carried out?), handshake. The transmitter writes
realtime bytes first, then a command's line, then as much of the program as the wire takes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

from machines.driver import (
    Command,
    CommandDone,
    Event,
    FaultCause,
    MillState,
    ProgramLine,
    Require,
    Reset,
    StateChanged,
    allow_always,
)
from machines.errors import MachineError, NotAllowedError, ProgramRefusedError
from machines.grbl import replies
from machines.grbl.commands import CommandChannel, OverrideControl
from machines.grbl.flow_control import Pacer
from machines.grbl.handshake import Handshake
from machines.grbl.link import QUICK_S, GrblLink, GrblOptions
from machines.grbl.permits import check_command, check_start
from machines.grbl.states import Phase
from machines.grbl.status import StatusReporter
from machines.grbl.stopping import BUSY_S, ResetControl, StopControl
from machines.grbl.stream_monitor import StreamMonitor
from machines.grbl.streaming import Stream, Streamer
from machines.grbl.timeouts import OFFER_S
from phrases.phrase import Phrase

HAIL_S = 0.25  # between status requests while nobody has answered


@dataclass(slots=True, eq=False)
class Transmitter:
    """Gives the bytes to write: at a time only as many as keep the wire busy, so that a realtime byte never waits
    behind more.
    """

    link: GrblLink
    streamer: Streamer
    commands: CommandChannel
    resets: ResetControl
    stops: StopControl
    monitor: StreamMonitor
    pacer: Pacer

    def poll(self, now_s: float) -> None:
        """Queue a reset and a '?' when they are due."""
        link, stream, reset = self.link, self.streamer.stream, self.resets.sequence
        if reset is not None:
            link.urgent += reset.take(now_s)
        asks = False
        if stream is not None and stream.count.closed:
            if not stream.window.used:
                stream.count.note_empty_window(now_s)
            asks = stream.count.ask(now_s, link.silence.unanswered)
        if (asks or now_s >= link.poll_at_s) and link.phase is not Phase.CLOSED:
            link.urgent += b"?"
            link.silence.unanswered += 1
            link.poll_at_s = now_s + self._poll_every_s()

    def _poll_every_s(self) -> float:
        link, stream = self.link, self.streamer.stream
        if link.phase is Phase.HAILING:
            return HAIL_S
        if link.phase in (Phase.STOPPING, Phase.CLEARING):
            return BUSY_S
        drained = stream is not None and stream.drained
        if self.commands.override.active or drained or link.view.waits_for_fields:
            return min(QUICK_S, link.options.poll_s)
        return link.options.run_poll_s if link.phase is Phase.STREAMING else link.options.poll_s

    def take_output(self, now_s: float) -> bytes:
        """Return the bytes to write now, realtime bytes first. May wait for the disk of the program."""
        stream = self._stream_to_send
        program = self._take_program(stream, now_s) if stream is not None else b""
        return self.take_urgent(now_s) + program

    def take_urgent(self, now_s: float) -> bytes:
        """Return the realtime bytes that wait, and a command's line behind them. Waits for nothing."""
        link = self.link
        self.commands.override.queue_step()
        if not link.urgent and not link.text:
            return b""
        data = bytes(link.urgent) + bytes(link.text)
        link.urgent.clear()
        link.text.clear()
        self.pacer.note_written(len(data), now_s)
        return data

    def _take_program(self, stream: Stream, now_s: float) -> bytes:
        budget = self.pacer.budget(now_s)
        if budget <= 0:
            stream.wants_wire = True
            return b""
        data = self._fill(stream, budget, now_s)
        self.pacer.note_written(len(data), now_s)
        return data

    @property
    def _stream_to_send(self) -> Stream | None:
        """The program of which lines may be written now."""
        link = self.link
        return self.streamer.stream if link.phase is Phase.STREAMING and not link.paused else None

    def _fill(self, stream: Stream, budget: int, now_s: float) -> bytes:
        idle = not stream.window.used
        try:
            data = stream.fill(budget)
        except MachineError as error:
            words = error.words
            if isinstance(error, ProgramRefusedError):
                words = Phrase("block refused before it was sent: {words}", words=words)
            self.stops.raise_fault(FaultCause.PROGRAM_CHANGED, words, 0, now_s)
            return b""
        if idle and data:
            self.monitor.note_sent()
        return data

    @property
    def next_deadline_s(self) -> float:
        """The latest time for the next call of `poll` and `take_output`."""
        stream, reset = self.streamer.stream, self.resets.sequence
        due_s = self.link.poll_at_s
        if reset is not None and reset.due_s < due_s:
            due_s = reset.due_s
        if stream is None:
            return due_s
        if stream.count.poll_at_s < due_s:
            due_s = stream.count.poll_at_s
        if stream.wants_wire and self._stream_to_send is not None and self.pacer.refill_at_s < due_s:
            due_s = self.pacer.refill_at_s
        return due_s


WATCH_S = 0.05


class GrblSession:
    """One link to one controller, over all its restarts: gives every reply, tick and order to the part it concerns."""

    def __init__(self, options: GrblOptions | None = None, *, wire_bytes_per_s: float | None = None) -> None:
        self.link = link = GrblLink(options or GrblOptions())
        self.streamer = streamer = Streamer(link)
        self.commands = commands = CommandChannel(link, OverrideControl(link))
        self.reporter = StatusReporter(link, streamer, commands)
        self.resets = resets = ResetControl(link, streamer)
        self.stops = stops = StopControl(link, streamer, commands, self.reporter, resets)
        self._handshake = Handshake(link, streamer, commands, resets, stops)
        pacer = Pacer(wire_bytes_per_s)
        self._monitor = StreamMonitor(link, streamer, stops, pacer)
        self._transmitter = Transmitter(link, streamer, commands, resets, stops, self._monitor, pacer)
        self._splitter = replies.LineSplitter()
        self._shown = MillState.DISCONNECTED

    def connect(self, now_s: float) -> None:
        """Begin the handshake."""
        if self.link.phase is not Phase.CLOSED:
            raise NotAllowedError(Phrase("connect: the link is {phase} already", phase=self.link.phase.value))
        self._splitter.clear()
        self._handshake.begin(now_s)

    def lose(self, words: Phrase, now_s: float) -> None:
        """Give the link up: the port is gone."""
        self._close(words, words, now_s, FaultCause.PORT_LOST)

    def close(self, now_s: float) -> None:
        """Give the link up; nothing is written any more."""
        self._close(Phrase("closed"), Phrase("link closed"), now_s, None)

    def _close(self, words: Phrase, command_words: Phrase, now_s: float, cause: FaultCause | None) -> None:
        if self.link.phase is Phase.CLOSED:
            return
        line = self.streamer.first_line
        self.commands.end(command_words)
        self.streamer.end()
        self.link.close(words, now_s, cause, line)

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes that have come."""
        link, streamer = self.link, self.streamer
        if link.phase is Phase.CLOSED:
            return
        stream = streamer.stream
        for line in self._splitter.take(data):
            if (
                line == b"ok"
                and stream is not None
                and link.phase is Phase.STREAMING
                and stream.window.used
                and not streamer.echoes
            ):
                self._monitor.take_ok(stream)
            else:
                self._take_line(line, now_s)
                stream = streamer.stream
        if link.phase is Phase.HAILING:
            link.greeting.count_unended(self._splitter.rest)

    def _take_line(self, line: bytes, now_s: float) -> None:
        reply = replies.parse(line)
        if isinstance(reply, replies.Banner):
            self._handshake.take_banner(reply.text, now_s)
        elif self.link.phase is Phase.HAILING:
            self._handshake.take_reply(reply, line, now_s)
        elif isinstance(reply, replies.Status):
            self._take_report(reply, now_s)
        elif isinstance(reply, replies.Ok):
            self._take_answer(0, now_s)
        elif isinstance(reply, replies.ErrorReply):
            self._take_answer(reply.number, now_s)
        elif isinstance(reply, replies.AlarmReply):
            self.stops.take_alarm(reply.number, now_s)
        elif isinstance(reply, replies.Echo):
            self._monitor.take_echo(reply.text, now_s)
        elif isinstance(reply, replies.Message):
            self.resets.take_message(reply.text, now_s)
        elif isinstance(reply, replies.Push | replies.Setting):
            self.commands.take_reply(reply)
        elif isinstance(reply, replies.Garbled):
            self.commands.take_odd_line(reply.raw)
            self._monitor.take_garbled(reply.raw, now_s)

    def _take_answer(self, error: int, now_s: float) -> None:
        if self.commands.busy:
            self.commands.take_answer(error, now_s)
        elif self.link.phase is Phase.STREAMING:
            self._monitor.take_answer(error, now_s)
        else:  # the answer to a line of a program that is being stopped, or of a command that a hold has ended
            self.commands.held_line = ""
            self.streamer.take_late_answer(error)

    def _take_report(self, report: replies.Status, now_s: float) -> None:
        link = self.link
        link.silence.take_report()
        link.offers_reset = False
        moved = link.view.take(report)
        self._monitor.note_report(report, now_s, moved=moved)
        self.commands.take_report(report, now_s)
        self.stops.take_report(report, now_s)
        if link.phase is Phase.STREAMING:
            self._monitor.compare(report, now_s)

    def tick(self, now_s: float) -> None:
        """Do what is due by now."""
        self._transmitter.poll(now_s)
        if now_s >= self.link.watch_at_s:
            self.link.watch_at_s = now_s + WATCH_S
            self._watch(now_s)

    def _watch(self, now_s: float) -> None:
        """Check the clock for faults that only time shows."""
        link, phase = self.link, self.link.phase
        link.silence.look(now_s)
        silent = phase in (Phase.HAILING, Phase.STOPPING) and link.silence.silent_s >= OFFER_S
        link.offers_reset = silent and not (phase is Phase.HAILING and link.greeting.speaks)
        if phase in (Phase.HAILING, Phase.READY):
            self._handshake.watch(now_s)
        elif phase in (Phase.IDENTIFYING, Phase.COMMAND):
            self.commands.watch(now_s)
        elif phase is Phase.STREAMING:
            self._monitor.watch(now_s)
        elif phase in (Phase.STOPPING, Phase.CLEARING):
            self.stops.watch(now_s)

    def output(self, now_s: float) -> bytes:
        """Return the bytes to write now, realtime bytes first."""
        return self._transmitter.take_output(now_s)

    def urgent_output(self, now_s: float) -> bytes:
        """Return the bytes that act at once and the line of a command, without lines of the program."""
        return self._transmitter.take_urgent(now_s)

    @property
    def next_deadline_s(self) -> float:
        """The latest time for the next call of `tick` and `output`."""
        if self.link.phase is Phase.CLOSED:
            return inf
        return min(self._transmitter.next_deadline_s, self.link.watch_at_s)

    def take_events(self) -> tuple[Event, ...]:
        """Return what has happened since the last call."""
        events, state = self.link.events, self.reporter.state
        if state is not self._shown:
            events.insert(0, StateChanged(self._shown, state))
            self._shown = state
        if not events:
            return ()
        taken = tuple(events)
        events.clear()
        return taken

    def start(self, lines: Iterator[ProgramLine], now_s: float) -> None:
        """Begin a program where the mill stands."""
        check_start(self.reporter.state, self.link.phase, self.link.view.settings)
        self.streamer.start(lines, now_s)
        self._monitor.begin()

    def take_back_start(self, now_s: float) -> None:
        """Undo a start of which no byte has been written."""
        if self.link.phase is Phase.STREAMING:
            self.streamer.stream = None
            self.link.enter(Phase.READY, now_s)

    def hold(self, now_s: float) -> None:
        self.stops.hold(now_s)

    def resume(self, now_s: float) -> None:
        self.stops.resume(now_s)
        self._monitor.note_sign()

    def abort(self, now_s: float, *, hold_sent: bool = False) -> None:
        self.stops.abort(now_s, hold_sent=hold_sent)

    def command(self, command: Command, now_s: float, require: Require = allow_always) -> None:
        """Begin a command; ends with CommandDone. require : checked again before a later line that acts"""
        state, link = self.reporter.state, self.link
        seen, silent = link.view, link.offers_reset
        check_command(
            command,
            state,
            link.phase,
            seen.settings,
            machine_mm=seen.machine_mm,
            trusted=seen.trusted,
            silent=silent,
        )
        if isinstance(command, Reset):
            self.link.events.append(CommandDone(command))
            self.resets.begin_for_person(now_s)
        else:
            self.commands.carry_out(command, state, now_s, require)
