"""How a session stops: '!' before everything else, reset only at standstill, and what ends with it."""

from __future__ import annotations

from machines.driver import (
    CommandDone,
    Event,
    FaultCause,
    Faulted,
    MillState,
    Notice,
    Restarted,
    Stopped,
)
from machines.grbl import replies
from machines.grbl import timeouts as stall
from machines.grbl.greeting import Greeting
from machines.grbl.known import SessionKnown
from machines.grbl.resetting import ResetSequence
from machines.grbl.runner import ErrandRunner
from machines.grbl.states import Phase, may_move, stands

BUSY_S = 0.05  # between status requests while the mill is being stopped
HOLD_AGAIN_S = 0.4
TOOL_DONE = b"\xa3"
STARTING = b"~" + TOOL_DONE  # realtime bytes that can start motion
HELD = "a hold came before it had ended: it is not taken up again"
NOT_SENT = "a stop came before it was sent"


class SessionStopping(SessionKnown):
    """Faults, holds and aborts."""

    def _move(self, phase: Phase, now_s: float) -> None:
        if not may_move(self.phase, phase):
            raise AssertionError(f"no way from {self.phase.value} to {phase.value}")
        self.phase = phase
        self._phase_at_s = now_s
        self._phase_spent_s = self._patience.spent_s
        self._patience.begin()
        self._poll_at_s = self._watch_at_s = now_s
        self._stop_reports = self._idle_reports = 0
        self._offers_reset = self._silence_told = False
        if phase is not Phase.CLEARING:
            self._reset = None

    def _close(self, words: str, now_s: float, event: Event | None) -> None:
        self.failure = words
        self._urgent.clear()
        self._text.clear()
        self._hold_wanted = self._paused = False
        self._held_line = ""
        self._tell_restart()
        self.view.position_lost()
        self._move(Phase.CLOSED, now_s)
        if event is not None:
            self._events.append(event)

    def _fault(self, cause: FaultCause, words: str, line: int, now_s: float) -> None:
        """The stream is dead from here on, and '!' goes out before anything else."""
        if self.phase is not Phase.STREAMING:
            return
        self._put_hold()
        self._events.append(Faulted(cause, words, line, now_s))
        self._stop(now_s)

    def _put_hold(self) -> None:
        """'!' before everything that waits to be written; what could start motion again is dropped."""
        self._urgent = bytearray(b"!" + self._urgent.translate(None, STARTING))

    def _drop_motion(self) -> None:
        """Nothing that is not written yet may start motion after a stop: no resume, no line of a command."""
        self._urgent = self._urgent.translate(None, STARTING)
        if self._text and self._errand is not None and self._errand.command is not None:
            self._text.clear()
            self._give_up_errand(NOT_SENT)

    def _give_up_errand(self, words: str) -> None:
        self._end_errand(words)
        if self.phase is Phase.ERRAND:
            self._move(Phase.READY, self._phase_at_s)

    def _stop(self, now_s: float) -> None:
        self._text.clear()
        self._steer = None
        self._reset = None
        self._hold_at_s = now_s
        self._move(Phase.STOPPING, now_s)

    def _hold_again(self, now_s: float) -> None:
        self._put_hold()
        self._hold_at_s = now_s

    def _clear(self, now_s: float) -> None:
        """Reset at standstill: planner and receive buffer are emptied, the position is kept."""
        self._begin_reset(ResetSequence.at_standstill(now_s), now_s)

    def _begin_reset(self, reset: ResetSequence, now_s: float) -> None:
        self._end_stream()
        self._text.clear()
        self._urgent = bytearray((b"!" if b"!" in self._urgent else b"") + reset.take(now_s))
        if self.phase is not Phase.CLEARING:
            self._move(Phase.CLEARING, now_s)
        self._reset = reset
        self._phase_at_s = now_s
        self._poll_at_s = now_s + BUSY_S

    def _tell_restart(self) -> None:
        """Restarted, and Stopped if it ends a stop: told with the verdict on the position."""
        if self._restart is None:
            return
        (banner, stops), self._restart = self._restart, None
        kept = self.view.judge_place()
        self._events.append(Restarted(banner))
        if stops:
            self._events.append(Stopped(position_kept=kept))

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
            if stream is not None and self.view.work_mm is not None and report.state in ("Idle", "Hold"):
                stream.tracker.stands_at(self.view.work_mm, exact_mm=self._exact_mm())
            self._clear(now_s)

    def hold(self, now_s: float) -> None:
        """Stop motion. What is not written yet is dropped; a command is ended; a program waits for a resume."""
        self._drop_motion()
        phase = self.phase
        self._hold_wanted = phase is not Phase.CLEARING
        if phase in (Phase.CLOSED, Phase.CLEARING):
            return  # carried out with the first report; or on the way to a reset, which leaves nothing to hold
        if self.state is MillState.HOMING:
            self._reset_homing(now_s)
            return
        self._put_hold()
        if self._errand is not None:
            self._hold_errand(self._errand, now_s)
        self._paused = True
        self._hold_seen = False
        self._hold_reports = -self._patience.unanswered
        self._hold_at_s = self._poll_at_s = now_s

    def _hold_errand(self, errand: ErrandRunner, now_s: float) -> None:
        """A held controller reads no line: a command ends here, the handshake begins anew when the mill is let go."""
        if self.phase is Phase.IDENTIFYING:
            self._hail_again(now_s)
        else:
            self._held_line = errand.asked
            self._give_up_errand(HELD)

    def _hail_again(self, now_s: float) -> None:
        self._end_errand("held")
        self._text.clear()
        self._hail = Greeting(recognised=True)
        self._move(Phase.HAILING, now_s)

    def _reset_homing(self, now_s: float) -> None:
        """A homing cycle obeys no hold; its position means nothing yet, so a reset loses nothing."""
        self._end_errand("homing was stopped")
        self.view.position_lost()
        self._clear(now_s)

    @property
    def is_quiet(self) -> bool:
        """Nothing moves, and nothing that was sent can make it move."""
        report = self.view.report
        at_rest = self.phase in (Phase.READY, Phase.IDENTIFYING, Phase.HAILING) and report is not None
        return at_rest and report is not None and report.state in ("Idle", "Alarm")

    def abort(self, now_s: float) -> None:
        self._drop_motion()
        phase, report = self.phase, self.view.report
        if phase is Phase.CLOSED:
            self._abort_wanted = True
            return
        if phase is Phase.HAILING and report is None:
            self._abort_wanted = True
            self._put_hold()  # a mill that is not heard may hear
            if self._offers_reset:
                self._begin_reset(ResetSequence.by_a_person(now_s), now_s)
            return
        self._abort_wanted = False
        if phase in (Phase.STOPPING, Phase.CLEARING):
            return
        if self.state is MillState.HOMING:
            self._reset_homing(now_s)
            return
        if self.is_quiet:
            self._events.append(Stopped(position_kept=self.view.trusted))
            return
        self._end_errand("aborted")
        self._put_hold()
        self._late_answers = True
        self._stop(now_s)
