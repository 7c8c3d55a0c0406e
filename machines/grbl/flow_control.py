"""Flow control: how many bytes may be under way, how soon they are on the wire, and whether every line is answered.

Counting answers against lines shows a lost or doubled answer while the program runs, not at its end. Now and then no
line is sent until every line under way is answered, and a little longer. With an answer lost the last line never seems
answered, and the mill stands Idle with it (timeouts.py); with one doubled, an answer belongs to no line. The planner
covers that pause with motion if its blocks are long enough. If they never are (fine finishing), the count is still made
after COUNT_LATE_S: it costs some 0.03 s every COUNT_EVERY_S, 0.3 % of a full wire.
"""

from __future__ import annotations

from collections import deque
from math import inf
from typing import Generic, TypeVar

from machines.grbl.link import DEFAULT_RX_BYTES

Item = TypeVar("Item")

# One byte less than reported: ring buffers that keep one slot free report either figure, and the documents say 127 for
# a buffer of 128. It costs under 1 % of the window and no throughput.
SPARE_BYTES = 1

AHEAD_S = 0.010  # most wire time that may wait before the wire: a '!' waits less than this and one poll
REFILL_S = 0.005  # if woken with this much still waiting, the wire does not fall idle

COUNT_EVERY_S, COUNT_LATE_S = 10.0, 2.0
# Motion that the planner must hold while the last answers come and the next lines go: on a serial line, on a network.
COUNT_COVER_S, COUNT_COVER_NETWORK_S = 0.1, 0.5
MOST_UNANSWERED = 5  # the controller answers one of several '?' that arrive together
LISTEN_S = 0.3  # at most: a line that waits for room in the planner is answered when its oldest block has ended


def usable_bytes(rx_bytes: int | None) -> int:
    """Return how many bytes may be under way to a controller that reports this receive buffer (None: it does not report
    one).
    """
    return (rx_bytes or DEFAULT_RX_BYTES) - SPARE_BYTES


class SendWindow(Generic[Item]):
    """Invariant: 0 <= used <= capacity. It counts exactly the bytes that are written."""

    __slots__ = ("_waiting", "capacity", "used")

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.used = 0
        self._waiting: deque[tuple[int, Item]] = deque()

    def accepts(self, size: int) -> bool:
        return self.used + size <= self.capacity

    def note_sent(self, size: int, item: Item) -> None:
        """Count a line of `size` bytes, its end included, as under way."""
        if self.used + size > self.capacity:
            raise AssertionError(f"{size} bytes more than the window of {self.capacity} takes ({self.used} under way)")
        self.used += size
        self._waiting.append((size, item))

    def take_answer(self) -> Item:
        """Take the oldest line off: it was answered. IndexError if none waits."""
        size, item = self._waiting.popleft()
        self.used -= size
        return item

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def first(self) -> Item | None:
        """The line that the next answer belongs to."""
        return self._waiting[0][1] if self._waiting else None


class Pacer:
    """Knows when the wire has sent all that was written, from its rate alone (None: not paced)."""

    __slots__ = ("_empty_at_s", "_rate")

    def __init__(self, wire_bytes_per_s: float | None) -> None:
        self._rate = wire_bytes_per_s
        self._empty_at_s = -inf

    @property
    def is_paced(self) -> bool:
        """The rate of the wire is known: a serial line, no network."""
        return self._rate is not None

    def budget(self, now_s: float) -> int:
        """Return bytes that may be written now."""
        if self._rate is None:
            return 1 << 30
        waiting_s = self._empty_at_s - now_s
        return int((AHEAD_S - waiting_s if waiting_s > 0.0 else AHEAD_S) * self._rate)

    def note_written(self, count: int, now_s: float) -> None:
        if self._rate is not None:
            start_s = self._empty_at_s if self._empty_at_s > now_s else now_s
            self._empty_at_s = start_s + count / self._rate

    @property
    def refill_at_s(self) -> float:
        """When to write again, if there is more to write."""
        return self._empty_at_s - REFILL_S


class AnswerCount:
    """One stream's counts. `closed`: no new line now.

    A count goes: begin, emptied (every line is answered), ask (one '?' at poll_at_s), reported (as often as '?' are
    under way); an answer until then that belongs to no line is one too many.
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

    def note_empty_window(self, now_s: float) -> None:
        """Note that every line under way is answered."""
        if self.closed and self.poll_at_s == inf and not self._reports:
            self.poll_at_s = now_s + self._listen_s

    def ask(self, now_s: float, unanswered: int) -> bool:
        """Return whether to write a '?' now whose report ends the count. unanswered: '?' already under way."""
        if now_s < self.poll_at_s:
            return False
        self.poll_at_s = inf
        self._reports = min(unanswered, MOST_UNANSWERED) + 1
        return True

    def take_report(self, now_s: float) -> None:
        """Take a report."""
        if self._reports:
            self._reports -= 1
            if not self._reports:
                self.closed = False
                self.due_s = now_s + COUNT_EVERY_S
