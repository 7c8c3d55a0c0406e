"""Keeps the queue before the wire short, so that a realtime byte written now is on the wire soon."""

from __future__ import annotations

from math import inf

AHEAD_S = 0.010  # most wire time that may wait before the wire: a '!' waits less than this and one poll
REFILL_S = 0.005  # woken with this much still waiting, the wire does not fall idle


class Pacer:
    """Knows when the wire has sent all that was written, from its rate alone (None: not paced)."""

    __slots__ = ("_empty_at_s", "_rate")

    def __init__(self, wire_bytes_per_s: float | None) -> None:
        self._rate = wire_bytes_per_s
        self._empty_at_s = -inf

    @property
    def paced(self) -> bool:
        """The rate of the wire is known: a serial line, no network."""
        return self._rate is not None

    def budget(self, now_s: float) -> int:
        """Bytes that may be written now."""
        if self._rate is None:
            return 1 << 30
        waiting_s = self._empty_at_s - now_s
        return int((AHEAD_S - waiting_s if waiting_s > 0.0 else AHEAD_S) * self._rate)

    def wrote(self, count: int, now_s: float) -> None:
        if self._rate is not None:
            start_s = self._empty_at_s if self._empty_at_s > now_s else now_s
            self._empty_at_s = start_s + count / self._rate

    @property
    def refill_at_s(self) -> float:
        """When to write again, if there is more to write."""
        return self._empty_at_s - REFILL_S
