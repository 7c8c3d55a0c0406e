"""Counting answers against lines: a lost or doubled answer shows while the program runs, not at its end.

Now and then no line is sent until every line under way is answered, and a little longer. With an answer lost the last
line never seems answered, and the mill stands Idle with it (stall.py); with one doubled an answer comes to no line.
The planner covers that pause with motion where its blocks are long enough. Where they never are (fine finishing), the
count is made all the same after COUNT_LATE_S: it costs some 0.03 s every COUNT_EVERY_S, 0.3 % of a full wire.
"""

from __future__ import annotations

from math import inf

COUNT_EVERY_S, COUNT_LATE_S, COUNT_RETRY_S = 10.0, 2.0, 0.25
# Motion that the planner must hold while the last answers come and the next lines go: on a serial line, on a network.
COUNT_COVER_S, COUNT_COVER_NETWORK_S = 0.1, 0.5
MOST_UNANSWERED = 5  # of '?' that came together the controller answers one
LISTEN_S = 0.3  # at most: a line that waits for room in the planner is answered when its oldest block has ended


class AnswerCount:
    """One stream's counts. `closed`: no new line now.

    A count goes: begin, emptied (every line is answered), ask (one '?' at poll_at_s), reported (as often as '?' are
    under way); what is answered until then without a line is one answer too many.
    """

    __slots__ = ("_listen_s", "_reports", "closed", "due_s", "poll_at_s")

    def __init__(self, now_s: float) -> None:
        self.due_s = now_s + COUNT_EVERY_S
        self.closed = False
        self.poll_at_s = inf
        self._listen_s = 0.0
        self._reports = 0

    def consider(self, covered_s: float, now_s: float, *, paced: bool) -> None:
        """Begin a count if it is due and covered, or long overdue. covered_s: motion that the planner holds."""
        if self.closed or now_s < self.due_s:
            return
        needed_s = COUNT_COVER_S if paced else COUNT_COVER_NETWORK_S
        if covered_s < needed_s and now_s < self.due_s + COUNT_LATE_S:
            return
        self.closed = True
        self._listen_s = min(LISTEN_S, covered_s / 3.0)

    def empty_window(self, now_s: float) -> None:
        """Every line under way is answered."""
        if self.closed and self.poll_at_s == inf and not self._reports:
            self.poll_at_s = now_s + self._listen_s

    def asks(self, now_s: float, unanswered: int) -> bool:
        """Whether a '?' is to be written now whose report ends the count. unanswered: '?' under way already."""
        if now_s < self.poll_at_s:
            return False
        self.poll_at_s = inf
        self._reports = min(unanswered, MOST_UNANSWERED) + 1
        return True

    def reported(self, now_s: float) -> None:
        """A report has come."""
        if self._reports:
            self._reports -= 1
            if not self._reports:
                self.closed = False
                self.due_s = now_s + COUNT_EVERY_S
