"""How a session stops: '!' before everything else, reset only at standstill, and what ends with it."""

from __future__ import annotations

from machines.driver import (
    CommandDone,
    Event,
    FaultCause,
    Faulted,
    MillState,
    Notice,
    Stopped,
)
from machines.grbl import replies, stall
from machines.grbl.known import SessionKnown
from machines.grbl.states import Phase, may_move, stands

BUSY_S = 0.05  # between status requests while the mill is being stopped
HOLD_AGAIN_S = 0.4


class SessionStopping(SessionKnown):
    """Faults, holds and aborts."""

    def _move(self, phase: Phase, now_s: float) -> None:
        if not may_move(self.phase, phase):
            raise AssertionError(f"no way from {self.phase.value} to {phase.value}")
        self.phase = phase
        self._phase_at_s = now_s
        self._poll_at_s = self._watch_at_s = now_s
        self._stop_reports = self._idle_reports = 0

    def _close(self, words: str, now_s: float, event: Event | None) -> None:
        self.failure = words
        self._urgent.clear()
        self._text.clear()
        self._hold_wanted = self._paused = False
        self.view.position_lost()
        self._move(Phase.CLOSED, now_s)
        if event is not None:
            self._events.append(event)

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

    def _watch_stop(self, now_s: float) -> None:
        report = self.view.report
        if now_s > self._hold_at_s + HOLD_AGAIN_S and not (report is not None and report.state in ("Hold", "Door")):
            self._hold_again(now_s)
        if now_s > self._phase_at_s + stall.HOLD_S:
            self._phase_at_s = now_s
            self._events.append(Notice("the mill does not confirm the hold: use its own stop button"))

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
        self._paused = self._hold_wanted = True
        self._hold_seen = False
        self._hold_at_s = now_s
        self._poll_at_s = now_s

    def _reset_homing(self, now_s: float) -> None:
        """A homing cycle obeys no hold; its position means nothing yet, so a reset loses nothing."""
        self._end_errand("homing was stopped")
        self.view.position_lost()
        self._clear(now_s)

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
