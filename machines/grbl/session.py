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
from dataclasses import dataclass

from machines.driver import (
    CheckMode,
    Command,
    CommandDone,
    DriverFacts,
    Event,
    Faulted,
    FaultCause,
    Home,
    JogCancel,
    MillState,
    MillStatus,
    Notice,
    Override,
    ProgramDone,
    ProgramLine,
    Reset,
    Restarted,
    StateChanged,
    Stopped,
    StreamProgress,
    TrustPosition,
)
from machines.errors import MachineError, NotAllowedError, ProgramRefusedError
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.grbl import echo, overrides, replies, stall
from machines.grbl.codes import CRITICAL_ALARMS, POSITION_LOST_ALARMS, alarm_words, error_words
from machines.grbl.errands import errand_for, identify
from machines.grbl.hail import Hail
from machines.grbl.pacing import Pacer
from machines.grbl.permits import check_command
from machines.grbl.runner import ErrandRunner
from machines.grbl.settings import ControllerSettings
from machines.grbl.states import Phase, detail_words, may_move, mill_state, stands
from machines.grbl.streaming import Stream
from machines.grbl.tracking import SHORT_BLOCKS_BEYOND_PLANNER, Place, Tracker
from machines.grbl.view import MachineView
from machines.grbl.window import usable_bytes

DEFAULT_PLANNER_BLOCKS = 15
HAIL_S, BUSY_S, WATCH_S = 0.25, 0.05, 0.05
IDLE_REPORTS = 2  # one Idle may be reported between the `ok` of a move and its start
HOLD_AGAIN_S = 0.4
TOOL_DONE = b"\xa3"


@dataclass(frozen=True, slots=True, kw_only=True)
class GrblOptions:
    """poll_s: time between status requests; rx_bytes: receive buffer, None = ask $I; corridor_mm: how far a reported
    position may be off the programmed path, on top of rounding, steps and arc chords ($12); identify_s: patience with a
    port on which nothing like a controller answers."""

    poll_s: float = 0.2
    rx_bytes: int | None = None
    corridor_mm: float = 0.010
    identify_s: float = 6.0
    dialect: str = "grbl"


class GrblSession:
    """One link to one controller, over all its restarts."""

    def __init__(self, options: GrblOptions | None = None, *, wire_bytes_per_s: float | None = None) -> None:
        self.options = options or GrblOptions()
        self.phase = Phase.CLOSED
        self.view = MachineView()
        self.controller = ""
        self.epoch = 0
        self.failure = ""  # why the session is CLOSED, in words
        self._pacer = Pacer(wire_bytes_per_s)
        self._splitter = replies.LineSplitter()
        self._urgent = bytearray()
        self._text = bytearray()
        self._events: list[Event] = []
        self._shown = MillState.DISCONNECTED
        self._hail = Hail()
        self._errand: ErrandRunner | None = None
        self._stream: Stream | None = None
        self._progress = StreamProgress()
        self._banner = ""
        self._echoes = False
        self._corridor = False  # positions of this stream were compared at least once
        self._tolerance_mm = 0.0
        self._modes = ""  # [GC:] words, or what the last program has left
        self._hold_wanted = self._abort_wanted = False
        self._paused = False  # no new lines: held, door, or told so
        self._banner_due_s = 0.0  # until then a banner is the answer to $C
        self._steer: tuple[Override, float] | None = None
        self._steer_reports = 0
        self._answer_at_s = self._phase_at_s = self._hold_at_s = self._poll_at_s = self._watch_at_s = 0.0
        self._idle_reports = 0
        self._stop_reports = 0

    # ------------------------------------------------------------------ what is known

    @property
    def settings(self) -> ControllerSettings:
        return self.view.settings

    @property
    def window_bytes(self) -> int:
        return usable_bytes(self.options.rx_bytes or self.settings.rx_bytes)

    @property
    def planner_blocks(self) -> int:
        return self.settings.planner_blocks or DEFAULT_PLANNER_BLOCKS

    @property
    def progress(self) -> StreamProgress:
        if self._stream is None:
            return self._progress
        return self._stream.progress(streaming=self.phase is Phase.STREAMING)

    @property
    def state(self) -> MillState:
        """The one word for the operator."""
        phase, report = self.phase, self.view.report
        if phase is Phase.CLOSED:
            return MillState.DISCONNECTED
        if self.view.alarm:
            return MillState.ALARM
        if phase is Phase.ERRAND and self._errand is not None and isinstance(self._errand.command, Home):
            return MillState.HOMING
        if phase is Phase.IDENTIFYING or report is None:
            return MillState.HOLDING if phase is Phase.STOPPING else MillState.CONNECTING
        state = mill_state(report)
        if phase is Phase.HAILING and state in (MillState.IDLE, MillState.ALARM):
            return MillState.CONNECTING
        if phase in (Phase.STOPPING, Phase.CLEARING):
            return MillState.HELD if stands(report) else MillState.HOLDING
        if state in (MillState.RUN, MillState.JOG) and self._hold_wanted:
            return MillState.HOLDING
        if state is MillState.HELD and not self._hold_wanted and self._waits_for_person():
            return MillState.TOOL
        if self._paused and state is MillState.CHECK:
            return MillState.HELD
        return state

    def _waits_for_person(self) -> bool:
        first = self._stream.first if self._stream else None
        return first is not None and first[1].withholds_ok

    @property
    def status(self) -> MillStatus:
        view, state = self.view, self.state
        report = view.report
        return MillStatus(
            state=state,
            detail=self._detail(state),
            machine_mm=view.machine_mm,
            work_mm=view.work_mm,
            work_offset_mm=view.work_offset_mm,
            feed_mm_per_min=view.feed_mm_per_min,
            spindle_rpm=report.spindle if report else None,
            spindle_on=view.spindle_on,
            overrides=view.overrides,
            pins=report.pins if report else "",
            position_trusted=view.trusted,
            controller=self.controller,
            buffer_bytes=self.window_bytes if view.identified else None,
            epoch=self.epoch,
        )

    def _detail(self, state: MillState) -> str:
        if self.phase is Phase.CLOSED:
            return self.failure
        if self.view.alarm:
            return alarm_words(self.view.alarm)
        if state is MillState.CONNECTING:
            return self._hail.words if self.phase is Phase.HAILING else "reading version and settings"
        if self.phase in (Phase.STOPPING, Phase.CLEARING):
            return "stopping: buffers are cleared when the mill stands"
        if state is MillState.TOOL:
            return "the program waits for a person (M0, M1 or a tool change): resume when ready"
        return detail_words(self.view.report) if self.view.report else ""

    @property
    def facts(self) -> DriverFacts:
        return DriverFacts(
            kind="GRBL 1.1, grblHAL or FluidNC over a byte stream",
            capacity=f"counted bytes, at most {self.window_bytes} under way "
            + (
                "(receive buffer by $I, less one)"
                if self.settings.rx_bytes
                else "(assumed: the controller does not tell)"
            ),
            acknowledgement=f"ok = parsed and queued, up to {self.planner_blocks + SHORT_BLOCKS_BEYOND_PLANNER} blocks before it is executed",
            stop="feed hold '!' at once, before everything else; reset only from standstill",
            position=f"status report, {1.0 / self.options.poll_s:g} per second",
            tried_on="the simulated mill of this project; modelled on measurements of GRBL 1.1h and the grblHAL simulator",
        )

    @property
    def protections(self) -> tuple[str, ...]:
        words: list[str] = []
        if not self.view.identified or self.phase is Phase.CLOSED:
            return ()
        if self._echoes:
            words.append("echo: every line the controller has read is compared with the line sent")
        if self._corridor:  # of the program now, or the last one
            words.append(
                f"corridor: reported positions are compared with the programmed path {1.0 / self.options.poll_s:g} times "
                f"a second, tolerance {self._tolerance_mm:.3f} mm; a wrong move is noticed after it has begun"
            )
        if self.settings.soft_limits:
            words.append("soft limits of the controller ($20=1)")
        if self.settings.hard_limits:
            words.append("limit switches of the controller ($21=1)")
        return tuple(words)

    # ------------------------------------------------------------------ in and out

    def connect(self, now_s: float) -> None:
        """Begin the handshake."""
        if self.phase is not Phase.CLOSED:
            raise NotAllowedError(f"connect: the link is {self.phase.value} already")
        self._splitter.clear()
        self._urgent.clear()
        self._text.clear()
        self.view.new_epoch(position_kept=False)
        self.failure, self._banner, self._echoes = "", "", False
        self._hail = Hail()
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

    def _close(self, words: str, now_s: float, event: Event | None) -> None:
        self.failure = words
        self._urgent.clear()
        self._text.clear()
        self._hold_wanted = self._paused = False
        self.view.position_lost()
        self._move(Phase.CLOSED, now_s)
        if event is not None:
            self._events.append(event)

    def receive(self, data: bytes, now_s: float) -> None:
        """Bytes have come."""
        if self.phase is Phase.CLOSED:
            return
        stream = self._stream
        for line in self._splitter.take(data):
            # The short way for nearly every line there is.
            if line == b"ok" and stream is not None and self.phase is Phase.STREAMING and not self._echoes:
                if stream.window.used:
                    stream.answered()
                    self._answer_at_s = now_s
                    self._idle_reports = 0
                    continue
            self._line(line, now_s)
            stream = self._stream
        if self.phase is Phase.HAILING:
            self._hail.unended(self._splitter.rest)

    def tick(self, now_s: float) -> None:
        """Time has passed."""
        if now_s >= self._poll_at_s and self.phase is not Phase.CLOSED:
            self._urgent += b"?"
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
            self._answer_at_s = now_s  # the wait for an answer begins
        return data

    @property
    def next_deadline_s(self) -> float:
        """When `tick` and `output` want to be called at the latest."""
        due_s = self._poll_at_s if self._poll_at_s < self._watch_at_s else self._watch_at_s
        stream = self._stream
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
        return self.options.poll_s

    def _move(self, phase: Phase, now_s: float) -> None:
        if not may_move(self.phase, phase):
            raise AssertionError(f"no way from {self.phase.value} to {phase.value}")
        self.phase = phase
        self._phase_at_s = now_s
        self._poll_at_s = self._watch_at_s = now_s
        self._stop_reports = self._idle_reports = 0

    # ------------------------------------------------------------------ replies

    def _line(self, line: bytes, now_s: float) -> None:
        reply = replies.parse(line)
        if isinstance(reply, replies.Banner):
            self._restarted(reply.text, now_s)
        elif self.phase is Phase.HAILING:
            self._hailed(reply, line, now_s)
        elif isinstance(reply, replies.Status):
            self._reported(reply, now_s)
        elif isinstance(reply, replies.Ok):
            self._answered(0, now_s)
        elif isinstance(reply, replies.ErrorReply):
            self._answered(reply.number, now_s)
        elif isinstance(reply, replies.AlarmReply):
            self._alarmed(reply.number, now_s)
        elif isinstance(reply, replies.Echo):
            self._echoed(reply.text, now_s)
        elif isinstance(reply, replies.Message):
            self._events.append(Notice(f"controller: {reply.text}"))
        elif isinstance(reply, replies.Push | replies.Setting):
            if self._errand is not None:
                self._errand.heard(reply)
        elif isinstance(reply, replies.Garbled):
            self._garbled(reply.raw, now_s)

    def _hailed(self, reply: replies.Reply, line: bytes, now_s: float) -> None:
        """Before the handshake only a status report, an alarm or a banner means anything."""
        self._hail.heard(reply, line)
        if isinstance(reply, replies.Message):
            self._events.append(Notice(f"controller: {reply.text}"))
        elif isinstance(reply, replies.AlarmReply):
            self.view.alarmed(reply.number)
            if reply.number in CRITICAL_ALARMS:
                self._events.append(Notice(alarm_words(reply.number)))
        elif isinstance(reply, replies.Status):
            self.view.take(reply, now_s)
            self._hail.recognised = True
            if self._abort_wanted:
                self.abort(now_s)
            elif self._hold_wanted:
                self._urgent += b"!"
                self._hold_wanted = reply.state in ("Run", "Jog")
            elif reply.state in ("Idle", "Alarm", "Check"):
                self._move(Phase.IDENTIFYING, now_s)
                self._errand = ErrandRunner(identify(self._banner), None, self._write, now_s)

    def _write(self, text: bytes) -> None:
        self._text += text

    def _answered(self, error: int, now_s: float) -> None:
        if self._errand is not None:
            if self._errand.answered(error, now_s):
                self._after_errand(now_s)
            return
        stream = self._stream
        if stream is None or self.phase is not Phase.STREAMING:
            return  # answers to lines of a stream that is dead already
        self._answer_at_s = now_s
        self._idle_reports = 0
        words = error_words(error) if error else "ok"
        if not stream.window.used:
            self._fault(FaultCause.REPLY_COUNT, f"{words} came although every line was answered already", 0, now_s)
        elif self._echoes and not stream.echoed:
            line = stream.first_line
            self._fault(FaultCause.ECHO, f"line {line} was answered ({words}) without its echo", line, now_s)
        elif error:
            assert stream.first is not None
            block = stream.first[0]
            self._fault(
                FaultCause.ERROR_REPLY,
                f"line {block.number} '{_shown(block.text)}' was refused: {words}",
                block.number,
                now_s,
            )
        else:
            stream.answered()

    def _echoed(self, text: bytes, now_s: float) -> None:
        stream = self._stream
        if stream is None or self.phase is not Phase.STREAMING:
            self._echoes = True
            return
        first = stream.first
        if first is None:
            self._fault(FaultCause.ECHO, f"the controller has read '{_shown(text)}', which was not sent", 0, now_s)
        elif stream.echoed or echo.differs(first[0].text, text):
            number = first[0].number
            self._fault(
                FaultCause.ECHO,
                f"line {number} was sent as '{_shown(first[0].text)}', but read as '{_shown(text)}'",
                number,
                now_s,
            )
        else:
            self._echoes = stream.echoed = True

    def _alarmed(self, number: int, now_s: float) -> None:
        self.view.alarmed(number)
        words = alarm_words(number)
        if self._errand is not None:
            self._end_errand(words)
            if self.phase is Phase.ERRAND:
                self._move(Phase.READY, now_s)
        if self.phase is Phase.STREAMING:
            self._fault(FaultCause.ALARM, words, self._stream.first_line if self._stream else 0, now_s)
        else:
            self._events.append(Notice(words))
        if number in CRITICAL_ALARMS and self.phase is not Phase.CLEARING:
            # Stands already and hears nothing but a reset; what it holds must not survive.
            self._clear(now_s)

    def _garbled(self, raw: bytes, now_s: float) -> None:
        if self.phase is Phase.STREAMING:
            line = self._stream.first_line if self._stream else 0
            self._fault(
                FaultCause.GARBLED_REPLY,
                f"'{_shown(raw)}' is nothing a controller says: damaged on the way",
                line,
                now_s,
            )
        elif self.phase is not Phase.CLEARING:
            self._events.append(Notice(f"not understood: '{_shown(raw)}'"))

    def _restarted(self, banner: str, now_s: float) -> None:
        """A banner: a new epoch. Everything the controller held is gone."""
        ours = self.phase is Phase.CLEARING
        checked_off = not ours and now_s < self._banner_due_s
        kept = (ours and self.view.alarm not in POSITION_LOST_ALARMS) or checked_off
        self._banner_due_s = 0.0
        was_streaming, line = self.phase is Phase.STREAMING, self._stream.first_line if self._stream else 0
        known = self.controller
        self.epoch += 1
        self._banner, self.controller = banner, _name(banner)
        self._urgent.clear()
        self._text.clear()
        self._echoes = False
        self._hold_wanted = self._paused = self._abort_wanted = False
        self._steer = None
        self.view.new_epoch(position_kept=kept)
        stopping = self.phase is Phase.STOPPING
        self._end_errand("" if checked_off else "the controller restarted")
        self._end_stream()
        self._hail = Hail(recognised=bool(known))
        self._hail.banner = True
        self._move(Phase.HAILING, now_s)
        if was_streaming:
            words = f"the controller restarted by itself ('{banner}'): reset button, power or a reset line"
            self._events.append(Faulted(FaultCause.RESET, words, line, now_s))
        self._events.append(Restarted(banner))
        if ours or stopping:
            self._events.append(Stopped(position_kept=kept))

    # ------------------------------------------------------------------ reports

    def _reported(self, report: replies.Status, now_s: float) -> None:
        view = self.view
        view.take(report, now_s)
        if self._errand is not None:
            self._errand.reported(idle=report.state in ("Idle", "Check"), machine_mm=view.machine_mm, now_s=now_s)
            self._after_errand(now_s)
        if self._steer is not None:
            self._steer_override(report, now_s)
        if report.state in ("Hold", "Door", "Sleep", "Tool"):
            self._paused = True
            self._answer_at_s = now_s  # waiting for a person is not a stall
        elif report.state in ("Run", "Idle") and self._paused and not self._hold_wanted:
            self._paused = False
        if self.phase is Phase.STREAMING:
            self._follow(report, now_s)
        elif self.phase is Phase.STOPPING:
            self._settle(report, now_s)

    def _follow(self, report: replies.Status, now_s: float) -> None:
        """Compare a report with the program under way."""
        stream = self._stream
        assert stream is not None
        if report.state in ("Alarm", "Sleep") and not self.view.alarm:
            words = f"the controller reports '{report.state}' in the middle of a program"
            self._fault(FaultCause.ALARM, words, stream.first_line, now_s)
            return
        if report.state in ("Run", "Hold", "Idle"):
            self._look(stream, now_s)
            if self.phase is not Phase.STREAMING:
                return
        if report.state in ("Idle", "Check") and not stream.window.used:
            self._idle_reports += 1
            if self._idle_reports >= IDLE_REPORTS:
                stream.tracker.all_executed()
                if stream.drained:
                    self._finish(stream, report, now_s)
        else:
            self._idle_reports = 0

    def _look(self, stream: Stream, now_s: float) -> None:
        position = self.view.work_mm
        if position is None:
            return
        sight = stream.tracker.reported(position)
        if sight.place is Place.ON_PATH:
            self._corridor = True
        elif sight.place is Place.OFF_PATH:
            at = " ".join(f"{axis}{value:.3f}" for axis, value in zip("XYZ", position, strict=True))
            self._fault(
                FaultCause.OFF_PATH,
                f"the mill reports {at}, {sight.distance_mm:.3f} mm from the nearest line that can be under way "
                f"(line {sight.line}; allowed {self._tolerance_mm:.3f} mm): a byte was damaged or a step lost",
                sight.line,
                now_s,
            )
        elif sight.place is Place.UNANSWERED:
            self._fault(
                FaultCause.REPLY_COUNT,
                f"the mill is on line {sight.line}, but line {stream.first_line} was never answered: a reply was lost",
                stream.first_line,
                now_s,
            )

    def _finish(self, stream: Stream, report: replies.Status, now_s: float) -> None:
        """Everything is sent, answered and executed: where does the mill stand?"""
        last, position = stream.tracker.last_move, self.view.work_mm
        if (
            report.state == "Idle"
            and last is not None
            and position is not None
            and isinstance(self._end_of(last), tuple)
        ):
            end = self._end_of(last)
            away = max((abs(p - e) for p, e in zip(position, end, strict=True) if e is not None), default=0.0)
            if away > self._tolerance_mm:
                self._fault(
                    FaultCause.OFF_PATH,
                    f"the program is done, but the mill stands {away:.3f} mm from its end",
                    stream.answered_line,
                    now_s,
                )
                return
        self._end_stream()
        self._move(Phase.READY, now_s)
        self._events.append(ProgramDone())

    @staticmethod
    def _end_of(step: object) -> tuple[float | None, float | None, float | None]:
        end: tuple[float | None, float | None, float | None] = getattr(step, "end_mm", (None, None, None))
        return (None, None, None) if getattr(step, "probes", False) else end

    def _settle(self, report: replies.Status, now_s: float) -> None:
        """While stopping: is it certain that the mill stands?"""
        stream = self._stream
        if stream is not None and report.state in ("Run", "Hold"):
            position = self.view.work_mm
            if position is not None:
                stream.tracker.reported(position)
        if not stands(report):
            self._stop_reports = 0
            return
        # A standing Hold is certain. Idle may be a report from before the '!', or before the next queued line.
        self._stop_reports += 1
        needed = 2 if report.state == "Hold" else 6
        if report.state == "Idle" and self._stop_reports < needed and not now_s < self._hold_at_s + HOLD_AGAIN_S:
            self._hold_again(now_s)
        if self._stop_reports >= needed:
            self._clear(now_s)

    # ------------------------------------------------------------------ faults and stopping

    def _fault(self, cause: FaultCause, words: str, line: int, now_s: float) -> None:
        """The stream is dead from here on, and '!' goes out before anything else."""
        if self.phase is not Phase.STREAMING:
            return
        self._urgent[:0] = b"!"
        self._events.append(Faulted(cause, words, line, now_s))
        self._stop(now_s)

    def _stop(self, now_s: float) -> None:
        self._text.clear()
        self._steer = None
        self._hold_at_s = now_s
        self._move(Phase.STOPPING, now_s)

    def _hold_again(self, now_s: float) -> None:
        self._urgent += b"!"
        self._hold_at_s = now_s

    def _clear(self, now_s: float) -> None:
        """Reset at standstill: planner and receive buffer are emptied, the position is kept."""
        self._end_stream()
        self._text.clear()
        self._urgent = bytearray(b"!\x18" if b"!" in self._urgent else b"\x18")
        self._move(Phase.CLEARING, now_s)
        self._poll_at_s = now_s + BUSY_S

    def _end_stream(self) -> None:
        if self._stream is not None:
            if self.phase is Phase.STREAMING and self._stream.drained:
                state = self._modes_after
                self._modes = state if state else self._modes
            self._progress = self._stream.progress(streaming=False)
            self._stream = None

    @property
    def _modes_after(self) -> str:
        return self._interpreter.state.words(with_motion=False) if self._stream is not None else ""

    def _end_errand(self, words: str) -> None:
        if self._errand is not None:
            self._errand.fail(words)
            if self._errand.command is not None:
                self._events.append(CommandDone(self._errand.command, words))
            self._errand = None
        if self._steer is not None:
            self._events.append(CommandDone(self._steer[0], words))
            self._steer = None

    def _watch(self, now_s: float) -> None:
        """What time alone shows."""
        phase = self.phase
        if phase is Phase.HAILING:
            self._watch_hail(now_s)
        elif self._errand is not None:
            self._errand.watch(now_s)
            self._after_errand(now_s)
        elif phase is Phase.STREAMING:
            self._watch_stream(now_s)
        elif phase is Phase.STOPPING:
            self._watch_stop(now_s)
        elif phase is Phase.CLEARING:
            if now_s > self._phase_at_s + stall.BANNER_S:
                self._events.append(Notice("no banner after the reset: asking again whether the mill stands"))
                self._urgent += b"!"
                self._hold_at_s = now_s
                self._move(Phase.STOPPING, now_s)
        elif phase is Phase.READY:
            silent_s = now_s - max(self.view.report_at_s, self._phase_at_s)
            if silent_s > stall.REPORT_SILENCE_S + 1.0:
                self._events.append(Notice(f"no answer to '?' for {silent_s:.0f} s"))
                self.view.report = None
                self._hail = Hail(recognised=True)
                self._move(Phase.HAILING, now_s)

    def _watch_hail(self, now_s: float) -> None:
        if self._hail.recognised or now_s < self._phase_at_s + self.options.identify_s:
            return
        self._end_errand("not connected")
        words = self._hail.verdict()
        self._close(words, now_s, Faulted(FaultCause.DEVICE, words, 0, now_s))

    def _watch_stream(self, now_s: float) -> None:
        stream = self._stream
        assert stream is not None
        silent_s = now_s - max(self.view.report_at_s, self._phase_at_s)
        first = stream.first
        if silent_s > stall.REPORT_SILENCE_S and not (first is not None and first[1].writes_settings):
            self._fault(FaultCause.STALL, f"no answer to '?' for {silent_s:.1f} s", stream.first_line, now_s)
            return
        waited_s = now_s - self._answer_at_s
        if first is None or self._paused or waited_s < stall.MARGIN_S:
            return
        line, step = first
        allowed_s = stall.longest_wait_s(step, stream.tracker.unproven_answered, self.settings, self.view.overrides)
        if allowed_s is not None and waited_s > allowed_s:
            idle = self.view.report is not None and self.view.report.state == "Idle"
            self._fault(
                FaultCause.STALL,
                f"line {line.number} '{_shown(line.text)}' got no answer for {waited_s:.1f} s (at most {allowed_s:.1f} s "
                f"are explained by the motion before it)"
                + ("; the mill reports Idle: a line or a reply was lost" if idle else ""),
                line.number,
                now_s,
            )

    def _watch_stop(self, now_s: float) -> None:
        report = self.view.report
        if now_s > self._hold_at_s + HOLD_AGAIN_S and not (report is not None and report.state in ("Hold", "Door")):
            self._hold_again(now_s)
        if now_s > self._phase_at_s + stall.HOLD_S:
            self._phase_at_s = now_s
            self._events.append(Notice("the mill does not confirm the hold: use its own stop button"))

    # ------------------------------------------------------------------ errands

    def _after_errand(self, now_s: float) -> None:
        errand = self._errand
        if errand is None or not errand.ended:
            return
        self._errand = None
        outcome = errand.outcome
        if outcome is not None:
            if outcome.settings is not None:
                self.view.settings = outcome.settings
                self._modes = outcome.settings.parser_state or self._modes
            self.view.vouch(outcome.vouched)
        if self.phase is Phase.IDENTIFYING:
            self._identified(errand, now_s)
            return
        if self.phase is Phase.ERRAND:
            self._move(Phase.READY, now_s)
        if errand.command is not None:
            answer = outcome.answer if outcome is not None else {}
            self._events.append(CommandDone(errand.command, errand.failure, answer))

    def _identified(self, errand: ErrandRunner, now_s: float) -> None:
        if errand.failure:
            words = f"something answers, but it is not a GRBL controller: {errand.failure}"
            self._close(words, now_s, Faulted(FaultCause.DEVICE, words, 0, now_s))
            return
        self.view.identified = True
        self.controller = self.controller or f"Grbl {self.settings.version.partition('.')[0]}"
        if self.settings.version:
            self.controller = _controller_words(self._banner, self.settings)
        self._move(Phase.READY, now_s)

    # ------------------------------------------------------------------ what the operator asks for

    def start(self, lines: Iterator[ProgramLine], now_s: float) -> None:
        state = self.state
        if self.phase is not Phase.READY or state not in (MillState.IDLE, MillState.CHECK):
            raise NotAllowedError(f"start: the mill is {state.value}, it must be idle")
        settings, view = self.settings, self.view
        steps = settings.step_mm or (0.01, 0.01, 0.01)
        self._tolerance_mm = (
            self.options.corridor_mm
            + 1.7321 * view.report_step_mm
            + 0.5 * sum(step * step for step in steps) ** 0.5
            + (settings.arc_tolerance_mm or 0.002)
        )
        modes = self._modes.split()
        self._interpreter = Interpreter(
            ModalState(
                position_mm=view.work_mm or (None, None, None),
                units="G20" if "G20" in modes else "G21",
                distance="G91" if "G91" in modes else "G90",
            ),
            dialect=self.options.dialect,
        )
        tracker = Tracker(planner_blocks=self.planner_blocks, tolerance_mm=self._tolerance_mm)
        self._stream = Stream(lines, capacity=self.window_bytes, interpret=self._interpreter.take, tracker=tracker)
        self._corridor = False
        self._answer_at_s = now_s
        self._paused = self._hold_wanted = False
        self._move(Phase.STREAMING, now_s)

    def hold(self, now_s: float) -> None:
        if self.phase is Phase.CLOSED or (self.phase is Phase.HAILING and self.view.report is None):
            self._hold_wanted = True  # carried out with the first report
            return
        if self.phase is Phase.CLEARING:
            return
        if self.state is MillState.HOMING:
            self._reset_homing(now_s)
            return
        self._urgent[:0] = b"!"
        self._paused = True
        self._hold_wanted = True
        self._poll_at_s = now_s

    def _reset_homing(self, now_s: float) -> None:
        """A homing cycle obeys no hold; its position means nothing yet, so a reset loses nothing."""
        self._end_errand("homing was stopped")
        self.view.position_lost()
        self._clear(now_s)

    def resume(self, now_s: float) -> None:
        state, report = self.state, self.view.report
        ready = self.phase in (Phase.HAILING, Phase.READY, Phase.ERRAND, Phase.STREAMING) and report is not None
        if not ready or state not in (MillState.HELD, MillState.TOOL, MillState.DOOR):
            raise NotAllowedError(f"resume: the mill is {state.value}, it must be held")
        assert report is not None
        if report.state == "Door" and report.sub:
            raise NotAllowedError(f"resume: {detail_words(report)}")
        self._hold_wanted = self._abort_wanted = False
        self._answer_at_s = now_s
        if report.state == "Check":
            self._paused = False
            return
        self._urgent += (TOOL_DONE if report.state == "Tool" else b"") + b"~"
        self._poll_at_s = now_s + 0.05

    def abort(self, now_s: float) -> None:
        phase, report = self.phase, self.view.report
        if phase is Phase.CLOSED or (phase is Phase.HAILING and report is None):
            self._abort_wanted = True
            return
        self._abort_wanted = False
        if phase in (Phase.STOPPING, Phase.CLEARING):
            return
        if self.state is MillState.HOMING:
            self._reset_homing(now_s)
            return
        quiet = phase in (Phase.READY, Phase.IDENTIFYING, Phase.HAILING) and report is not None
        if quiet and report is not None and report.state in ("Idle", "Alarm"):
            self._events.append(Stopped(position_kept=self.view.trusted))
            return
        self._end_errand("aborted")
        self._urgent[:0] = b"!"
        self._stop(now_s)

    def command(self, command: Command, now_s: float) -> None:
        check_command(command, self.state, self.phase, self.settings)
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
            self._clear(now_s)
        elif isinstance(command, CheckMode) and command.on == (self.state is MillState.CHECK):
            self._events.append(CommandDone(command))
        else:
            errand = errand_for(command, self.settings)
            assert errand is not None
            self._move(Phase.ERRAND, now_s)
            if isinstance(command, CheckMode) and not command.on:
                self._banner_due_s = now_s + stall.BANNER_S
            self._errand = ErrandRunner(errand, command, self._write, now_s)
            self._after_errand(now_s)

    def _steer_override(self, report: replies.Status, now_s: float) -> None:
        assert self._steer is not None
        command, until_s = self._steer
        self._steer_reports += 1
        if report.overrides is None and self._steer_reports < overrides.PATIENCE_REPORTS:
            return
        shown = overrides.reported(command.what, self.view.overrides)
        steps = overrides.next_bytes(command.what, shown, command.percent)
        if not steps and (report.overrides is not None or self.view.override_reports):
            self._steer = None
            self._events.append(CommandDone(command))
        elif now_s > until_s:
            self._steer = None
            self._events.append(CommandDone(command, f"{command.what} override stays at {shown} %"))
        elif self._steer_reports >= 2:
            self._urgent += steps
            self._steer_reports = 0


def _shown(text: bytes) -> str:
    words = text.decode("ascii", "backslashreplace")
    return words if len(words) <= 80 else words[:77] + "..."


def _name(banner: str) -> str:
    return banner.partition("[")[0].strip()


def _controller_words(banner: str, settings: ControllerSettings) -> str:
    name = {"grbl": "Grbl", "grblhal": "grblHAL", "fluidnc": "FluidNC"}[settings.firmware]
    return f"{name} {settings.version.partition(':')[0]}".strip() if settings.version else _name(banner)
