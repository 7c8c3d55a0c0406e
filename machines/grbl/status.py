"""The reports of a session: state, status, facts, protections. Changes nothing."""

from __future__ import annotations

from dataclasses import dataclass

from machines.driver import DriverFacts, MillState, MillStatus
from machines.errors import MillCode
from machines.grbl.commands import CommandChannel
from machines.grbl.link import SILENT, GrblLink
from machines.grbl.replies import alarm_words
from machines.grbl.states import Phase, detail_words, mill_state, stands
from machines.grbl.streaming import Streamer
from machines.grbl.timeouts import SLOW_LINK_S
from machines.grbl.tracking import SEGMENTS
from phrases.phrase import NO_WORDS, Phrase


@dataclass(slots=True, eq=False)
class StatusReporter:
    """Words and figures for the operator, from the parts of a session."""

    link: GrblLink
    streamer: Streamer
    commands: CommandChannel

    @property
    def state(self) -> MillState:
        """The one word for the operator."""
        link = self.link
        phase, report = link.phase, link.view.report
        if phase is Phase.CLOSED:
            return MillState.DISCONNECTED
        if link.view.alarm:
            return MillState.ALARM
        if phase is Phase.COMMAND and self.commands.homes:
            return MillState.HOMING
        if phase is Phase.IDENTIFYING or report is None:
            return MillState.HOLDING if phase is Phase.STOPPING else MillState.CONNECTING
        state = mill_state(report)
        if phase is Phase.HAILING and state in (MillState.IDLE, MillState.ALARM):
            return MillState.CONNECTING
        if phase in (Phase.STOPPING, Phase.CLEARING):
            return MillState.HELD if stands(report) else MillState.HOLDING
        if state in (MillState.RUN, MillState.JOG) and link.hold_wanted:
            return MillState.HOLDING
        if state is MillState.IDLE and link.hold_under_way:
            return MillState.HOLDING  # '!' holds an idle controller as well
        if state is MillState.HELD and not link.hold_wanted and self.streamer.waits_for_person:
            return MillState.TOOL
        if link.paused and state is MillState.CHECK:
            return MillState.HELD
        return state

    @property
    def status(self) -> MillStatus:
        link, view, state = self.link, self.link.view, self.state
        report = view.report
        return MillStatus(
            state=state,
            detail=self._detail(state),
            code=self._code(state),
            alarm=self._alarm(state),
            machine_mm=view.machine_mm,
            work_mm=view.work_mm,
            work_offset_mm=view.work_offset_mm,
            feed_mm_per_min=view.feed_mm_per_min,
            spindle_rpm=(0.0 if view.spindle_stopped else report.spindle) if report else None,
            spindle_on=view.spindle_on,
            overrides=view.overrides,
            pins=report.pins if report else "",
            position_trusted=view.trusted,
            complete=not view.waits_for_fields,
            controller=link.controller,
            buffer_bytes=self.streamer.window_bytes if view.identified else None,
            epoch=link.epoch,
        )

    def _alarm(self, state: MillState) -> int:
        """Number of the alarm that keeps the mill locked, 0 if none is known."""
        view = self.link.view
        return view.alarm or (view.locked_by if state is MillState.ALARM else 0)

    def _code(self, state: MillState) -> str:
        link = self.link
        if link.phase is Phase.CLOSED:
            return ""
        if link.offers_reset:
            return MillCode.SILENT
        if link.view.alarm and link.phase is Phase.CLEARING:
            return MillCode.LOCKED_UNTIL_RESET
        return MillCode.LOCKED if self._alarm(state) else ""

    def _detail(self, state: MillState) -> Phrase:
        link, view = self.link, self.link.view
        if link.phase is Phase.CLOSED:
            return link.failure
        if link.offers_reset:
            return SILENT
        if view.alarm:
            alarm = alarm_words(view.alarm)
            if link.phase is not Phase.CLEARING:
                return alarm
            return Phrase("{alarm}; waiting until the controller accepts a reset", alarm=alarm)
        if state is MillState.CONNECTING:
            return link.greeting.words if link.phase is Phase.HAILING else Phrase("reading version and settings")
        if link.phase in (Phase.STOPPING, Phase.CLEARING):
            return Phrase("stopping: buffers are cleared when the mill stands still")
        if state is MillState.TOOL:
            return Phrase("the program waits for a person (M0, M1 or a tool change): resume when ready")
        if state is MillState.ALARM and view.locked_by:
            return alarm_words(view.locked_by)
        return detail_words(view.report) if view.report else Phrase("")

    def slow_link_words(self) -> Phrase:
        """Describe the effect of a slow link on a program; NO_WORDS if the link is not slow."""
        round_trip_s = self.link.silence.round_trip_s
        if round_trip_s < SLOW_LINK_S:
            return NO_WORDS
        return Phrase(
            "the link takes {round_trip_s:.1f} s for an answer: at most {rate:.0f} bytes of a program go out in a "
            "second; where its lines are short, the mill waits between them",
            round_trip_s=round_trip_s,
            rate=self.streamer.window_bytes / round_trip_s,
        )

    @property
    def facts(self) -> DriverFacts:
        streamer, settings = self.streamer, self.link.view.settings
        segments = SEGMENTS[settings.firmware]
        ahead = streamer.planner_blocks + segments + 1
        return DriverFacts(
            kind="GRBL 1.1, grblHAL or FluidNC over a byte stream",
            capacity=f"counted bytes, at most {streamer.window_bytes} under way "
            + ("(receive buffer by $I, less one)" if settings.rx_bytes else "(assumed: the controller does not tell)")
            + (f"; {slow}" if (slow := self.slow_link_words()) else ""),
            acknowledgement=f"ok = parsed and queued, counted as up to {ahead} blocks before it is executed "
            f"({streamer.planner_blocks} in the planner, {segments} segments, 1 to spare)",
            stop="feed hold '!' at once, before everything else; reset only from standstill",
            position=f"status report, {1.0 / self.link.options.run_poll_s:g} per second while a program runs",
            tried_on="GRBL 1.1h compiled for a host with UART pacing, and the simulated mill of this project, which is "
            "modelled on it and on measurements of a grblHAL; FluidNC only as a simulation",
        )

    @property
    def protections(self) -> tuple[str, ...]:
        link, words = self.link, list[str]()
        if not link.view.identified or link.phase is Phase.CLOSED:
            return ()
        if self.streamer.echoes:
            words.append("echo: every line the controller has read is compared with the line sent")
        if corridor := self._corridor_words():
            words.append(corridor)
        if link.view.rx_used is not None:
            words.append("the bytes in the controller's buffer (Bf:) are held against those under way")
        if link.view.settings.soft_limits:
            words.append("soft limits of the controller ($20=1)")
        if link.view.settings.hard_limits:
            words.append("limit switches of the controller ($21=1)")
        return tuple(words)

    def _corridor_words(self) -> str:
        """Describe the check of positions that is or will be active; nothing about positions that cannot be
        compared.
        """
        if self.state is MillState.CHECK:
            return ""
        what = (
            f"reported positions are held against the path {1.0 / self.link.options.run_poll_s:g} times a second, "
            f"corridor {self.streamer.corridor_mm:.3f} mm; a wrong move is noticed after it has begun, "
            "one that is over between two reports is not"
        )
        if self.link.phase is not Phase.STREAMING:
            return f"while a program runs: {what}"
        stream = self.streamer.stream
        return what if stream is not None and stream.compared else ""
