"""Holds reports against the program under way: on the path, off it, done."""

from __future__ import annotations

from machines.driver import FaultCause, ProgramDone
from machines.grbl import replies
from machines.grbl.states import Phase
from machines.grbl.stopping import HOLD_AGAIN_S, SessionStopping
from machines.grbl.streaming import Stream
from machines.grbl.tracking import Place

IDLE_REPORTS = 2  # one Idle may be reported between the `ok` of a move and its start


class SessionFollowing(SessionStopping):
    """Reports while a program runs."""

    def _note_running(self, now_s: float) -> None:
        """The mill runs although a hold was asked for: someone pressed cycle start, or the '!' was lost."""
        if self._hold_seen and now_s > self._hold_at_s + HOLD_AGAIN_S:
            self._hold_wanted = self._paused = False
        elif now_s > self._hold_at_s + HOLD_AGAIN_S:
            self._hold_again(now_s)

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
            stream.tracker.distrust_positions()
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
