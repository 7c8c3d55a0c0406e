"""What is written when: realtime bytes first, then a command's line, then as much of the program as the wire takes."""

from __future__ import annotations

from dataclasses import dataclass

from machines.driver import FaultCause
from machines.errors import MachineError, ProgramRefusedError
from machines.grbl.commands import CommandChannel
from machines.grbl.flow_control import Pacer
from machines.grbl.link import QUICK_S, GrblLink
from machines.grbl.resetting import BUSY_S, ResetControl
from machines.grbl.states import Phase
from machines.grbl.stopping import StopControl
from machines.grbl.stream_monitor import StreamMonitor
from machines.grbl.streaming import Stream, Streamer
from phrases.phrase import Phrase

HAIL_S = 0.25  # between status requests while nobody has answered


@dataclass(slots=True, eq=False)
class Transmitter:
    """Gives the bytes to write, as few at a time as keep the wire busy: a realtime byte waits behind no more."""

    link: GrblLink
    streamer: Streamer
    commands: CommandChannel
    resets: ResetControl
    stops: StopControl
    monitor: StreamMonitor
    pacer: Pacer

    def poll(self, now_s: float) -> None:
        """Put a reset and a '?' on their way where they are due."""
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
        """Return the bytes to write now, those that act at once first. May wait for the disk of the program."""
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
        """When `poll` and `take_output` want to be called at the latest."""
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
