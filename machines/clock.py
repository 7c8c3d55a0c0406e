"""The clocks of limits. One question decides between them: may WE still act, or has SOMEBODY ELSE failed?

May we still act? An order's age, a grant, a lease that we hold: `suspend_aware_clock_s`. The world went on while this
process was paused or the computer slept: an order from before is old, and others may have taken over.

Has somebody else failed? A disk, a controller, a link, a thread, a child: `RunningTime`, and `Timeout` over it. It
counts only time in which this process was looking. While we were stopped (SIGSTOP, a frozen container, a suspended
laptop, a starved host) we could not have seen the sign that we waited for, so that time counts against nobody.
"""

from __future__ import annotations

import time
from collections.abc import Callable

LOOK_S = 0.25  # five times the interval between two looks of a computer that is not busy
TURN_S = 1.0  # four times the longest wait of a port's owner for input


def suspend_aware_clock_s() -> float:
    """Return the seconds of a clock that nobody sets and that also runs while the computer is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


class RunningTime:
    """Seconds in which we looked: the time between two looks counts up to `most_s`, however far apart they are.

    most_s  : more than the time between two looks of a healthy loop, and less than any limit on this time, so that
              nobody is blamed at the first look after a pause
    spent_s : never decreases
    """

    __slots__ = ("_looked_at_s", "_most_s", "spent_s")

    def __init__(self, now_s: float = 0.0, *, most_s: float = LOOK_S) -> None:
        self.spent_s = 0.0
        self._looked_at_s = now_s
        self._most_s = most_s

    def look(self, now_s: float) -> float:
        """Count the time since the last look; return the sum."""
        self.spent_s += min(max(now_s - self._looked_at_s, 0.0), self._most_s)
        self._looked_at_s = now_s
        return self.spent_s


def make_running_clock(clock: Callable[[], float] = time.monotonic, *, most_s: float = TURN_S) -> Callable[[], float]:
    """Return a clock of running time for the owner of a port: all its limits use it."""
    running = RunningTime(clock(), most_s=most_s)
    return lambda: running.look(clock())


class Timeout:
    """A limit to how long somebody else may give no sign, in running time. Read it in every turn of the wait.

    most_s : as in `RunningTime`; half the limit if that is shorter, so that one look is never enough
    """

    __slots__ = ("_begun_s", "_clock", "_running", "seconds")

    def __init__(self, seconds: float, *, most_s: float = LOOK_S, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds = seconds
        self._clock = clock
        self._running = RunningTime(clock(), most_s=min(most_s, seconds / 2.0))
        self._begun_s = 0.0

    def restart(self) -> None:
        """Restart the wait: a sign has come."""
        self._begun_s = self._running.look(self._clock())

    @property
    def waited_s(self) -> float:
        return self._running.look(self._clock()) - self._begun_s

    @property
    def is_over(self) -> bool:
        return self.waited_s >= self.seconds
