"""The memory of a session, and its answers: state, status, facts, protections. The deciding is in session.py."""

from __future__ import annotations

from dataclasses import dataclass

from machines.driver import (
    DriverFacts,
    Event,
    Home,
    MillState,
    MillStatus,
    Override,
    StreamProgress,
)
from machines.gcode.interpreter import Interpreter
from machines.grbl import replies
from machines.grbl.codes import alarm_words
from machines.grbl.greeting import SILENT, Greeting
from machines.grbl.pacing import Pacer
from machines.grbl.resetting import ResetSequence
from machines.grbl.runner import ErrandRunner
from machines.grbl.settings import ControllerSettings
from machines.grbl.silence_clock import SilenceClock
from machines.grbl.states import Phase, detail_words, mill_state, stands
from machines.grbl.streaming import Stream
from machines.grbl.tracking import SEGMENTS
from machines.grbl.view import MachineView
from machines.grbl.window import usable_bytes

DEFAULT_PLANNER_BLOCKS = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class GrblOptions:
    """poll_s, run_poll_s: between status requests, and while a program runs; rx_bytes: receive buffer, None = ask $I;
    corridor_mm: how far a reported position may be off the programmed path, on top of rounding, steps and arc chords
    ($12); identify_s: patience with a port on which nothing like a controller answers."""

    poll_s: float = 0.2
    run_poll_s: float = 0.1
    rx_bytes: int | None = None
    corridor_mm: float = 0.010
    identify_s: float = 6.0
    dialect: str = "grbl"


class SessionKnown:
    """What a session remembers, and what that means to whoever asks. Changes nothing."""

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
        self._hail = Greeting()
        self._errand: ErrandRunner | None = None
        self._stream: Stream | None = None
        self._progress = StreamProgress()
        self._interpreter = Interpreter()
        self._banner = ""
        self._echoes = False
        self._corridor = False  # positions of this stream were compared at least once
        self._tolerance_mm = 0.0
        self._modes = ""  # [GC:] words, or what the last program has left
        self._hold_wanted = self._abort_wanted = False
        self._hold_seen = False  # the mill has reported standing since the last hold
        self._hold_reports = 0  # reports since then: the first may have been made before it
        self._held_line = ""  # of an errand that a hold has ended: the controller may still carry it out
        self._reset: ResetSequence | None = None  # under way, in CLEARING
        self._offers_reset = False  # nothing answers, and a person may send a reset
        self._restart: tuple[str, bool] | None = None  # banner that waits for its first report, and: it ends a stop
        self._late_answers = False  # of a stream that is being stopped: they still count
        self._paused = False  # no new lines: held, door, or told so
        self._banner_due_s = 0.0  # until then a banner is the answer to $C
        self._steer: tuple[Override, float] | None = None
        self._steer_reports = 0
        self._patience = SilenceClock()
        self._phase_spent_s = 0.0  # of our own time, when the phase began
        self._silence_told = False
        self._sign_heard_s = 0.0  # of the link's time: the last answer, new position, proven step or hold
        self._phase_at_s = self._hold_at_s = self._poll_at_s = self._watch_at_s = 0.0
        self._idle_reports = 0
        self._standing_reports = 0  # Idle in a row, with no answer between
        self._standing_heard_s = 0.0  # of the link's time, when the first of them came
        self._stop_reports = 0

    # ------------------------------------------------------------------ what is known

    @property
    def settings(self) -> ControllerSettings:
        return self.view.settings

    @property
    def offers_reset(self) -> bool:
        """Nothing answers: it may be a controller after a limit alarm, and a person may send it a reset (`Reset`)."""
        return self._offers_reset

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
            spindle_rpm=(0.0 if view.spindle_stopped else report.spindle) if report else None,
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
        if self._offers_reset:
            return SILENT
        if self.view.alarm:
            waits = "; waits for the controller to take a reset" if self._reset is not None else ""
            return alarm_words(self.view.alarm) + waits
        if state is MillState.CONNECTING:
            return self._hail.words if self.phase is Phase.HAILING else "reading version and settings"
        if self.phase in (Phase.STOPPING, Phase.CLEARING):
            return "stopping: buffers are cleared when the mill stands"
        if state is MillState.TOOL:
            return "the program waits for a person (M0, M1 or a tool change): resume when ready"
        if state is MillState.ALARM and self.view.locked_by:
            return alarm_words(self.view.locked_by)
        return detail_words(self.view.report) if self.view.report else ""

    @property
    def facts(self) -> DriverFacts:
        segments = SEGMENTS[self.settings.firmware]
        ahead = self.planner_blocks + segments + 1
        return DriverFacts(
            kind="GRBL 1.1, grblHAL or FluidNC over a byte stream",
            capacity=f"counted bytes, at most {self.window_bytes} under way "
            + (
                "(receive buffer by $I, less one)"
                if self.settings.rx_bytes
                else "(assumed: the controller does not tell)"
            ),
            acknowledgement=f"ok = parsed and queued, counted as up to {ahead} blocks before it is executed "
            f"({self.planner_blocks} in the planner, {segments} segments, 1 to spare)",
            stop="feed hold '!' at once, before everything else; reset only from standstill",
            position=f"status report, {1.0 / self.options.run_poll_s:g} per second while a program runs",
            tried_on="GRBL 1.1h compiled for a host with UART pacing, and the simulated mill of this project, which is "
            "modelled on it and on measurements of a grblHAL; FluidNC only as a simulation",
        )

    @property
    def protections(self) -> tuple[str, ...]:
        words: list[str] = []
        if not self.view.identified or self.phase is Phase.CLOSED:
            return ()
        if self._echoes:
            words.append("echo: every line the controller has read is compared with the line sent")
        if corridor := self._corridor_words():
            words.append(corridor)
        if self.settings.soft_limits:
            words.append("soft limits of the controller ($20=1)")
        if self.settings.hard_limits:
            words.append("limit switches of the controller ($21=1)")
        return tuple(words)

    def _corridor_words(self) -> str:
        """What is done, or will be: nothing is said of positions that cannot be compared."""
        if self.state is MillState.CHECK:
            return ""
        per_second, tolerance_mm = 1.0 / self.options.run_poll_s, self._corridor_mm()
        what = (
            f"reported positions are held against the path {per_second:g} times a second, "
            f"corridor {tolerance_mm:.3f} mm; a wrong move is noticed after it has begun, "
            "one that is over between two reports is not"
        )
        if self.phase is not Phase.STREAMING:
            return f"while a program runs: {what}"
        return what if self._corridor else ""

    def _exact_mm(self) -> float:
        """How far a report of a mill that stands at a point may be from that point: a step and the last digit."""
        steps = self.settings.step_mm or (0.01, 0.01, 0.01)
        return 1.7321 * self.view.report_step_mm + 0.5 * sum(step * step for step in steps) ** 0.5

    def _corridor_mm(self) -> float:
        """How far a reported position may be off: the option, and what rounding, steps and chords add."""
        steps = self.settings.step_mm or (0.01, 0.01, 0.01)
        return (
            self.options.corridor_mm
            + 1.7321 * self.view.report_step_mm
            + 0.5 * sum(step * step for step in steps) ** 0.5
            + (self.settings.arc_tolerance_mm or 0.002)
        )
