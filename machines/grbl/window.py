"""Character counting: bytes sent and not yet answered never exceed what the controller's receive buffer holds."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")

DEFAULT_RX_BYTES = 128  # GRBL 1.1 on an Uno, the smallest in the field; FluidNC's $I does not tell
# One byte less than reported: ring buffers that keep one slot free report either figure, and the documents say 127 for
# a buffer of 128. It costs under 1 % of the window and no throughput.
SPARE_BYTES = 1


def usable_bytes(rx_bytes: int | None) -> int:
    """How many bytes may be under way to a controller that reports this receive buffer (None: it does not tell)."""
    return (rx_bytes or DEFAULT_RX_BYTES) - SPARE_BYTES


class SendWindow(Generic[Item]):
    """Invariant: 0 <= used <= capacity. What is counted is the length of exactly the bytes that are written."""

    __slots__ = ("_waiting", "capacity", "used")

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.used = 0
        self._waiting: deque[tuple[int, Item]] = deque()

    def accepts(self, size: int) -> bool:
        return self.used + size <= self.capacity

    def sent(self, size: int, item: Item) -> None:
        """A line of `size` bytes, its end included, is on its way."""
        if self.used + size > self.capacity:
            raise AssertionError(f"{size} bytes more than the window of {self.capacity} takes ({self.used} under way)")
        self.used += size
        self._waiting.append((size, item))

    def answered(self) -> Item:
        """The oldest line was answered; IndexError if none waits."""
        size, item = self._waiting.popleft()
        self.used -= size
        return item

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def first(self) -> Item | None:
        """The line that the next answer belongs to."""
        return self._waiting[0][1] if self._waiting else None

    def clear(self) -> None:
        self._waiting.clear()
        self.used = 0
