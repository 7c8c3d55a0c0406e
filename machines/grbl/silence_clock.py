"""Time that counts while something is awaited: only such in which we and the link could have heard.

A wall clock runs while our process waits for a processor, while the computer sleeps, and while replies wait in a driver
or a network. None of that is silence of the mill. So our own time passes in looks, each worth LOOK_S at most, and the
link's in reports: between two of them as much of our time as passed, REPORT_S at most. Answers and reports come in the
order in which they were made; a report that is here shows that no earlier answer is still on its way.
"""

from __future__ import annotations

LOOK_S = 0.25  # five times what lies between two looks of a computer that is not busy
REPORT_S = 0.25  # a report is due ten times a second


class SilenceClock:
    """spent_s: our own time; heard_s: the link's. Both only go on."""

    __slots__ = ("_looked_at_s", "_reported_s", "heard_s", "spent_s", "unanswered")

    def __init__(self) -> None:
        self.spent_s = self.heard_s = 0.0
        self.unanswered = 0  # '?' written since the last report
        self._looked_at_s = 0.0
        self._reported_s = 0.0

    def look(self, now_s: float) -> None:
        """We look at the clock."""
        self.spent_s += min(max(now_s - self._looked_at_s, 0.0), LOOK_S)
        self._looked_at_s = now_s

    def report_came(self) -> None:
        self.heard_s += min(self.spent_s - self._reported_s, REPORT_S)
        self._reported_s = self.spent_s
        self.unanswered = 0

    def begin(self) -> None:
        """A wait for reports begins now."""
        self._reported_s = self.spent_s

    @property
    def silent_s(self) -> float:
        """How much of our time has passed without a report."""
        return self.spent_s - self._reported_s
