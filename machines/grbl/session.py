"""The protocol core: bytes and time in, bytes, events and deadlines out. No thread, no port, no clock.

Rules that hold at every moment:
- Only `ok` and `error:n` that come after the handshake belong to the stream; a banner ends the epoch and with it the
  stream: the controller has forgotten everything.
- The first sign of a fault puts '!' before everything else that is waiting to be written, in the call that saw it. The
  lines that the controller still holds are cleared by a reset, and that only when it reports standstill: a reset in
  motion loses the position.
- Nothing is sent by itself that can start motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

from machines.driver import (
    CheckMode,
    Command,
    CommandDone,
    Event,
    FaultCause,
    Faulted,
    JogCancel,
    MillState,
    Override,
    ProgramLine,
    Reset,
    StateChanged,
    TrustPosition,
)
from machines.errors import MachineError, NotAllowedError, ProgramRefusedError
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.grbl import overrides
from machines.grbl import timeouts as stall
from machines.grbl.counting import AnswerCount
from machines.grbl.errands import errand_for
from machines.grbl.greeting import Greeting
from machines.grbl.known import GrblOptions
from machines.grbl.permits import check_command
from machines.grbl.resetting import ResetSequence
from machines.grbl.runner import ErrandRunner
from machines.grbl.states import Phase, detail_words
from machines.grbl.stopping import BUSY_S, TOOL_DONE
from machines.grbl.streaming import Stream
from machines.grbl.tracking import SEGMENTS, Tracker
from machines.grbl.watching import SessionWatching

HAIL_S, WATCH_S = 0.25, 0.05
RESUME_POLL_S = 0.05


class GrblSession(SessionWatching):
    """One link to one controller, over all its restarts."""

    def connect(self, now_s: float) -> None:
        """Begin the handshake."""
        if self.phase is not Phase.CLOSED:
            raise NotAllowedError(f"connect: the link is {self.phase.value} already")
        self._splitter.clear()
        self._urgent.clear()
        self._text.clear()
        self.view.new_epoch(position_kept=False)
        self.view.judge_place()
        self.view.locked_by = 0
        self.view.spindle_on = None  # no banner has stopped it: whoever was here before may have left it on
        self.failure, self._banner, self._echoes = "", "", False
        self._hail = Greeting()
        self._move(Phase.HAILING, now_s)

    def lost(self, words: str, now_s: float) -> None:
        """The port is gone."""
        if self.phase is Phase.CLOSED:
            return
        line = self._stream.first_line if self._stream else 0
        self._end_errand(words)
        self._end_stream()
        self._close(words, now_s, Faulted(FaultCause.PORT_LOST, words, line, now_s))

    def close(self, now_s: float) -> None:
        """Give the link up; nothing is written any more."""
        if self.phase is not Phase.CLOSED:
            self._end_errand("link closed")
            self._end_stream()
            self._close("closed", now_s, None)

    def receive(self, data: bytes, now_s: float) -> None:
        """Bytes have come."""
        if self.phase is Phase.CLOSED:
            return
        stream = self._stream
        for line in self._splitter.take(data):
            # The short way for nearly every line there is.
            if (
                line == b"ok"
                and stream is not None
                and self.phase is Phase.STREAMING
                and stream.window.used
                and not self._echoes
            ):
                stream.answered()
                self._sign_heard_s = self._patience.heard_s
                self._idle_reports = self._standing_reports = 0
            else:
                self._line(line, now_s)
                stream = self._stream
        if self.phase is Phase.HAILING:
            self._hail.count_unended(self._splitter.rest)

    def tick(self, now_s: float) -> None:
        """Time has passed."""
        phase, stream = self.phase, self._stream
        if self._reset is not None:
            self._urgent += self._reset.take(now_s)
        asks = False
        if stream is not None and stream.count.closed:
            if not stream.window.used:
                stream.count.empty_window(now_s)
            asks = stream.count.asks(now_s, self._patience.unanswered)
        if (asks or now_s >= self._poll_at_s) and phase is not Phase.CLOSED:
            self._urgent += b"?"
            self._patience.unanswered += 1
            self._poll_at_s = now_s + self._poll_every_s()
        if now_s >= self._watch_at_s:
            self._watch_at_s = now_s + WATCH_S
            self._watch(now_s)

    def output(self, now_s: float) -> bytes:
        """Bytes to write now, those that act at once first."""
        stream = self._stream
        if not self._urgent and not self._text:
            if stream is None or self._paused or self.phase is not Phase.STREAMING:
                return b""
            budget = self._pacer.budget(now_s)
            if budget <= 0:
                stream.wants_wire = True
                return b""
            data = self._fill(stream, budget, now_s)
            if not self._urgent:
                self._pacer.wrote(len(data), now_s)
                return data
        data = bytes(self._urgent) + bytes(self._text)
        self._urgent.clear()
        self._text.clear()
        self._pacer.wrote(len(data), now_s)
        if self.phase is Phase.STREAMING and stream is not None and not self._paused:
            more = self._fill(stream, self._pacer.budget(now_s), now_s)
            self._pacer.wrote(len(more), now_s)
            data += more
            if self._urgent:
                data, self._urgent = bytes(self._urgent) + data, bytearray()
        return data

    def _fill(self, stream: Stream, budget: int, now_s: float) -> bytes:
        idle = not stream.window.used
        try:
            data = stream.fill(budget)
        except ProgramRefusedError as error:
            self._fault(FaultCause.PROGRAM_CHANGED, f"block refused before it was sent: {error}", 0, now_s)
            return b""
        except MachineError as error:
            self._fault(FaultCause.PROGRAM_CHANGED, str(error), 0, now_s)
            return b""
        if idle and data:
            self._sign_heard_s = self._patience.heard_s  # the wait for an answer begins
            self._standing_reports = 0
        return data

    @property
    def next_deadline_s(self) -> float:
        """When `tick` and `output` want to be called at the latest."""
        if self.phase is Phase.CLOSED:
            return inf
        due_s = self._poll_at_s if self._poll_at_s < self._watch_at_s else self._watch_at_s
        stream = self._stream
        if self._reset is not None and self._reset.due_s < due_s:
            due_s = self._reset.due_s
        if stream is not None and stream.count.poll_at_s < due_s:
            due_s = stream.count.poll_at_s
        if stream is not None and stream.wants_wire and self.phase is Phase.STREAMING and not self._paused:
            return min(due_s, self._pacer.refill_at_s)
        return due_s

    def take_events(self) -> tuple[Event, ...]:
        """What has happened since the last call."""
        state = self.state
        if state is not self._shown:
            self._events.insert(0, StateChanged(self._shown, state))
            self._shown = state
        if not self._events:
            return ()
        events = tuple(self._events)
        self._events.clear()
        return events

    def _poll_every_s(self) -> float:
        if self.phase is Phase.HAILING:
            return HAIL_S
        if self.phase in (Phase.STOPPING, Phase.CLEARING):
            return BUSY_S
        stream = self._stream
        if self._steer is not None or (stream is not None and stream.drained) or self.view.work_offset is None:
            return min(0.1, self.options.poll_s)
        return self.options.run_poll_s if self.phase is Phase.STREAMING else self.options.poll_s

    def start(self, lines: Iterator[ProgramLine], now_s: float) -> None:
        state = self.state
        if self.phase is not Phase.READY or state not in (MillState.IDLE, MillState.CHECK):
            raise NotAllowedError(f"start: the mill is {state.value}, it must be idle")
        settings, view = self.settings, self.view
        if settings.laser_mode:
            raise NotAllowedError(
                "start: laser mode is on ($32=1): the spindle would stop wherever the mill stands, and the next cut go "
                "with a dead one; send '$32=0' to mill"
            )
        self._tolerance_mm = self._corridor_mm()
        modes = self._modes.split()
        self._interpreter = Interpreter(
            ModalState(
                position_mm=view.work_mm or (None, None, None),
                units="G20" if "G20" in modes else "G21",
                distance="G91" if "G91" in modes else "G90",
            ),
            dialect=self.options.dialect,
        )
        tracker = Tracker(
            planner_blocks=self.planner_blocks,
            tolerance_mm=self._tolerance_mm,
            segments=SEGMENTS[settings.firmware],
            least_block_mm=1.7321 * max(settings.step_mm or (0.01,)),  # then some axis makes a step
        )
        self._stream = Stream(
            lines,
            capacity=self.window_bytes,
            interpret=self._interpreter.take,
            tracker=tracker,
            count=AnswerCount(now_s),
        )
        self._corridor = False
        self._sign_heard_s = self._patience.heard_s
        self._paused = self._hold_wanted = self._late_answers = False
        self._move(Phase.STREAMING, now_s)

    def resume(self, now_s: float) -> None:
        state, report = self.state, self.view.report
        ready = self.phase in (Phase.HAILING, Phase.READY, Phase.ERRAND, Phase.STREAMING) and report is not None
        if not ready or state not in (MillState.HELD, MillState.TOOL, MillState.DOOR):
            raise NotAllowedError(f"resume: the mill is {state.value}, it must be held")
        assert report is not None
        if report.state == "Door" and report.sub:
            raise NotAllowedError(f"resume: {detail_words(report)}")
        if self._held_line:
            raise NotAllowedError(
                f"resume: '{self._held_line}' was ended by the hold and is not taken up again; send a reset (from "
                "standstill the position is kept), then give the command anew"
            )
        self._hold_wanted = self._abort_wanted = False
        self._sign_heard_s = self._patience.heard_s
        if report.state == "Check":
            self._paused = False
            return
        self._urgent += (TOOL_DONE if report.state == "Tool" else b"") + (b"" if b"~" in self._urgent else b"~")
        self._poll_at_s = min(self._poll_at_s, now_s + RESUME_POLL_S)  # nobody who presses often postpones it

    def command(self, command: Command, now_s: float) -> None:
        if isinstance(command, JogCancel):
            self._drop_motion()
        check_command(command, self.state, self.phase, self.settings, silent=self._offers_reset)
        if isinstance(command, TrustPosition):
            self.view.vouch("XYZ")
            self._events.append(CommandDone(command))
        elif isinstance(command, JogCancel):
            self._urgent += b"\x85"
            self._events.append(CommandDone(command))
        elif isinstance(command, Override):
            if self._steer is not None:
                self._events.append(CommandDone(self._steer[0], "replaced by a newer override"))
            self._steer = (command, now_s + overrides.GIVE_UP_S)
            self._steer_reports = overrides.PATIENCE_REPORTS
            self._poll_at_s = now_s
        elif isinstance(command, Reset):
            self._events.append(CommandDone(command))
            if self._offers_reset:
                self._begin_reset(ResetSequence.by_a_person(now_s), now_s)
            else:
                self._clear(now_s)
        elif isinstance(command, CheckMode) and command.on == (self.state is MillState.CHECK):
            self._events.append(CommandDone(command))
        else:
            errand = errand_for(command, self.settings)
            assert errand is not None
            self._hold_wanted = self._paused = False
            self._move(Phase.ERRAND, now_s)
            if isinstance(command, CheckMode) and not command.on:
                self._banner_due_s = now_s + stall.BANNER_S
            self._errand = ErrandRunner(errand, command, self._write, self._patience.spent_s)
            self._after_errand(now_s)


__all__ = ["GrblOptions", "GrblSession"]
