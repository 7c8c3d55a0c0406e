"""What time alone shows: patience that has run out, and when to count answers."""

from __future__ import annotations

from machines.driver import FaultCause, Faulted, Notice
from machines.grbl import timeouts as stall
from machines.grbl.greeting import Greeting
from machines.grbl.hearing import SessionHearing, shown
from machines.grbl.states import Phase
from machines.grbl.streaming import Flight
from machines.grbl.timeouts import OFFER_S, PERSON_S, TELL_S


class SessionWatching(SessionHearing):
    """Looks at the clock some twenty times a second."""

    def _watch(self, now_s: float) -> None:
        """What time alone shows."""
        self._patience.look(now_s)
        phase = self.phase
        silent = phase in (Phase.HAILING, Phase.STOPPING) and self._patience.silent_s >= OFFER_S
        self._offers_reset = silent and not (phase is Phase.HAILING and self._hail.speaks)
        if phase is Phase.HAILING:
            self._watch_hail(now_s)
        elif self._errand is not None:
            self._errand.watch(self._patience.spent_s)
            self._after_errand(now_s)
        elif phase is Phase.STREAMING:
            self._watch_stream(now_s)
        elif phase is Phase.STOPPING:
            self._watch_stop(now_s)
        elif phase is Phase.CLEARING:
            self._watch_reset(now_s)
        elif phase is Phase.READY:
            silent_s = self._patience.silent_s
            if silent_s > stall.READY_SILENCE_S:
                self._events.append(Notice(f"no answer to '?' for {silent_s:.0f} s"))
                self.view.report = None
                self._hail = Greeting(recognised=True)
                self._move(Phase.HAILING, now_s)

    def _watch_reset(self, now_s: float) -> None:
        reset = self._reset
        assert reset is not None
        waited_s = self._patience.spent_s - self._phase_spent_s
        if not reset.repeats:
            if waited_s > stall.BANNER_S:
                self._events.append(Notice("no banner after the reset: asking again whether the mill stands"))
                self._put_hold()
                self._hold_at_s = now_s
                self._move(Phase.STOPPING, now_s)
        elif not reset.ours and waited_s > PERSON_S:
            words = f"nothing answers, not even {reset.sent} resets: mill off, another port, or another baud rate"
            self._close(words, now_s, Faulted(FaultCause.DEVICE, words, 0, now_s))
        elif waited_s > stall.BANNER_S and not self._silence_told:
            self._silence_told = True
            words = "no answer to {} resets after the alarm: is an emergency stop pressed, is the mill without power?"
            self._events.append(Notice(words.format(reset.sent)))

    def _watch_hail(self, now_s: float) -> None:
        waited_s = self._patience.spent_s - self._phase_spent_s
        if self._hail.recognised or waited_s < self.options.identify_s:
            return
        self._end_errand("not connected")
        words = self._hail.verdict()
        self._close(words, now_s, Faulted(FaultCause.DEVICE, words, 0, now_s))

    def _watch_stream(self, now_s: float) -> None:
        stream = self._stream
        assert stream is not None
        silent_s = self._patience.silent_s
        first = stream.first
        if silent_s > stall.REPORT_SILENCE_S:
            self._late_answers = True
            self._fault(FaultCause.STALL, f"no answer to '?' for {silent_s:.1f} s", stream.first_line, now_s)
            return
        if silent_s > TELL_S and not self._silence_told:
            self._silence_told = True
            self._events.append(
                Notice(
                    f"no answer to '?' for {silent_s:.0f} s: where the mill is, is not known; hold and stop are "
                    f"written all the same; after {stall.REPORT_SILENCE_S:.0f} s the run is interrupted"
                )
            )
        if not self._paused and not stream.exhausted and now_s >= stream.count.due_s:
            covered_s = stream.tracker.last_sent_s(self.planner_blocks - 2, self.view.overrides[0])
            stream.count.consider(covered_s, now_s, paced=self._pacer.paced)
        heard_s = self._patience.heard_s
        waited_s = heard_s - self._sign_heard_s
        if self._paused or waited_s < stall.MARGIN_S or not (stream.window.used or stream.drained):
            return
        standing = self._standing_reports >= stall.IDLE_REPORTS and heard_s > self._standing_heard_s + stall.IDLE_S
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

    @staticmethod
    def _stall_words(first: Flight | None, waited_s: float, allowed_s: float, standing: bool) -> str:
        if first is None:
            return f"every line is answered, but the mill neither moves nor comes to rest, for {waited_s:.1f} s now"
        words = f"line {first[0].number} '{shown(first[0].text)}' got no answer and nothing moved for {waited_s:.1f} s"
        if standing:
            return f"{words}; the mill reports Idle: a line or a reply was lost"
        return f"{words} (at most {allowed_s:.1f} s are explained by what is under way)"
