"""When 0x18 goes out, and again, until the banner: a reset that nobody has answered is none."""

from __future__ import annotations

from math import inf

RESET = b"\x18"
# After ALARM:1 and ALARM:2 GRBL 1.1 stands still for 500 ms, forgets a reset that came meanwhile, says so and waits.
MESSAGE = "Reset to continue"
MESSAGE_S = 0.6  # where the message is lost on the way
AGAIN_S = 0.25
SLOW_AFTER_S, SLOW_S = 10.0, 1.0  # an emergency stop that is still pressed, a mill without power: ask less often


class ResetSequence:
    """One reset on its way. `take` gives the byte whenever it is due; the banner ends the sequence from outside."""

    def __init__(self, now_s: float, *, first_s: float = 0.0, again_s: float = inf, ours: bool = True) -> None:
        """ours: sent to a mill that stands, so that the position is kept"""
        self.ours = ours
        self.sent = 0
        self.due_s = now_s + first_s
        self._again_s = again_s
        self._begun_s = now_s

    @staticmethod
    def at_standstill(now_s: float) -> ResetSequence:
        """Once: where no banner comes, the session looks again whether the mill stands."""
        return ResetSequence(now_s)

    @staticmethod
    def after_critical_alarm(now_s: float) -> ResetSequence:
        """When the controller has said that it waits for one, or must have; then until it hears."""
        return ResetSequence(now_s, first_s=MESSAGE_S, again_s=AGAIN_S)

    @staticmethod
    def by_a_person(now_s: float) -> ResetSequence:
        """To a controller that answers nothing: whether it stands is not known, so the position is not kept."""
        return ResetSequence(now_s, again_s=AGAIN_S, ours=False)

    @property
    def repeats(self) -> bool:
        return self._again_s < inf

    def message_came(self, now_s: float) -> None:
        """The controller says that it waits."""
        if self.repeats:
            self.due_s = now_s

    def take(self, now_s: float) -> bytes:
        """The byte if it is due, else nothing."""
        if now_s < self.due_s:
            return b""
        self.sent += 1
        slow = self.repeats and now_s > self._begun_s + SLOW_AFTER_S
        self.due_s = now_s + (SLOW_S if slow else self._again_s)
        return RESET
