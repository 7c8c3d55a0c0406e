"""What time alone shows: patience that has run out, and when to count answers."""

from __future__ import annotations

from machines.driver import FaultCause, Faulted, Notice
from machines.grbl import stall
from machines.grbl.hail import Hail
from machines.grbl.hearing import SessionHearing, shown
from machines.grbl.states import Phase
from machines.grbl.streaming import Flight, Stream

COUNT_EVERY_S, COUNT_RETRY_S = 10.0, 1.0
ABSENT_S = 0.5  # longer than this between two looks, and it was we who slept: a suspended or starved computer
# Motion that the planner must hold while the last answers come and the next lines go: on a serial line, on a network.
COUNT_COVER_S, COUNT_COVER_NETWORK_S = 0.1, 0.5


class SessionWatching(SessionHearing):
    """Looks at the clock some twenty times a second."""

    def _watch(self, now_s: float) -> None:
        """What time alone shows."""
        if now_s > self._looked_at_s + ABSENT_S:
            self._patient_from_s = now_s  # the answers may lie in the port, unread
        self._looked_at_s = now_s
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
        silent_s = now_s - max(self.view.report_at_s, self._phase_at_s, self._patient_from_s)
        first = stream.first
        if silent_s > stall.REPORT_SILENCE_S and not (first is not None and first[1].writes_settings):
            self._fault(FaultCause.STALL, f"no answer to '?' for {silent_s:.1f} s", stream.first_line, now_s)
            return
        if now_s >= self._count_at_s and not self._paused:
            self._count(stream, now_s)
        waited_s = now_s - max(self._sign_at_s, self._patient_from_s)
        if self._paused or waited_s < stall.MARGIN_S or not (stream.window.used or stream.drained):
            return
        standing = self._standing_reports >= stall.IDLE_REPORTS and now_s > self._standing_at_s + stall.IDLE_S
        allowed_s = stall.longest_wait_s(
            first[1] if first is not None else None,
            stream.tracker.unproven_answered,
            self.settings,
            self.view.overrides,
            standing=standing,
        )
        if allowed_s is not None and waited_s > allowed_s:
            words = self._stall_words(first, waited_s, allowed_s, standing)
            if standing and first is not None:
                words += f" after line {stream.agreed_line} (if a line, it was not cut: look at the part from there on)"
            self._fault(FaultCause.STALL, words, stream.first_line, now_s)

    def _count(self, stream: Stream, now_s: float) -> None:
        """Let the controller answer everything before more is sent, where its planner holds motion for long enough.

        A lost reply, or two lines that became one, would else show at the end of the program only: here the answers
        stay one short, and the mill stands Idle with a line unanswered.
        """
        covered_s = stream.tracker.last_sent_s(self.planner_blocks - 2, self.view.overrides[0])
        needed_s = COUNT_COVER_S if self._pacer.paced else COUNT_COVER_NETWORK_S
        if stream.exhausted or stream.counting or covered_s < needed_s:
            self._count_at_s = now_s + COUNT_RETRY_S
        else:
            stream.counting = bool(stream.window.used)
            self._count_at_s = now_s + COUNT_EVERY_S

    @staticmethod
    def _stall_words(first: Flight | None, waited_s: float, allowed_s: float, standing: bool) -> str:
        if first is None:
            return f"every line is answered, but the mill neither moves nor comes to rest, for {waited_s:.1f} s now"
        words = f"line {first[0].number} '{shown(first[0].text)}' got no answer and nothing moved for {waited_s:.1f} s"
        if standing:
            return f"{words}; the mill reports Idle: a line or a reply was lost"
        return f"{words} (at most {allowed_s:.1f} s are explained by what is under way)"
