"""A program as bytes for a link that gives no answers: the line of each byte, and the rate of handing them over."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import ceil

from machines.driver import ProgramLine

SETTLED_BLOCKS = 2  # blocks beyond the planner that may be neither in the buffer nor executed: running, just parsed


@dataclass(slots=True)
class ByteFeed:
    """Turns blocks into bytes, hands them over in pieces of any size, and keeps a record of where each line ends.

    encode         : makes the bytes of a block with its line end (raises an error for a bad block)
    head, tail     : bytes before the first and after the last block
    buffer_bytes   : bytes that the far end can hold unexecuted; None: not known, so nothing counts as executed
    planner_blocks : blocks it may hold beyond that buffer
    """

    lines: Iterator[ProgramLine]
    encode: Callable[[ProgramLine], bytes]
    head: bytes = b""
    tail: bytes = b""
    buffer_bytes: int | None = None
    planner_blocks: int = 0

    handed_bytes: int = 0
    sent_line: int = 0
    sent_offset: int = 0
    answered_line: int = 0
    executed_line: int = 0
    _pending: bytes = b""
    _book: deque[tuple[int, int]] = field(default_factory=deque)  # (bytes up to the end of the line, line)
    _taken_book: deque[tuple[int, int]] = field(default_factory=deque)  # taken, perhaps not executed
    _last: deque[int] = field(default_factory=deque)  # lines out of the buffer, perhaps still in the planner
    _total: int = 0
    _ended: bool = False

    def __post_init__(self) -> None:
        self._pending, self._total = self.head, len(self.head)

    @property
    def finished(self) -> bool:
        """Every byte has been handed over."""
        return self._ended and not self._pending

    def take(self, most: int) -> bytes:
        """Return the next bytes, at most `most`; b"" at the end. Reads one block ahead, so that `finished` is known."""
        while len(self._pending) <= most and not self._ended:
            line = next(self.lines, None)
            if line is None:
                self._ended = True
                self._pending += self.tail
                break
            text = self.encode(line)
            self._pending += text
            self._total += len(text)
            if text and line.number:
                self._book.append((self._total, line.number))
                self.sent_line, self.sent_offset = line.number, line.offset
        piece, self._pending = self._pending[:most], self._pending[most:]
        self.handed_bytes += len(piece)
        return piece

    def put_back(self, piece: bytes) -> None:
        """Take back bytes that were taken last and not written."""
        self._pending = piece + self._pending
        self.handed_bytes -= len(piece)

    def note_taken(self, count: int) -> None:
        """Note that the first `count` bytes have left for the far end."""
        while self._book and self._book[0][0] <= count:
            end, self.answered_line = self._book.popleft()
            if self.buffer_bytes is not None:
                self._taken_book.append((end, self.answered_line))
        if self.buffer_bytes is None:
            return
        while self._taken_book and self._taken_book[0][0] <= count - self.buffer_bytes:
            self._last.append(self._taken_book.popleft()[1])
            if len(self._last) > self.planner_blocks + SETTLED_BLOCKS:
                self.executed_line = self._last.popleft()

    @property
    def lines_in_flight(self) -> int:
        return len(self._book)


@dataclass(slots=True)
class Pace:
    """Estimates how many bytes wait between us and the wire, from the bytes written and the wire's rate.

    bytes_per_s : kept a little under the wire's rate, so that the estimate errs to the safe side and never drifts
    most_queued : bytes that may wait; they go out even after the far end has sent its stop
    """

    bytes_per_s: float
    most_queued: int
    _queued: float = 0.0
    _at_s: float = 0.0

    def count_queued(self, now_s: float) -> int:
        self._queued = max(0.0, self._queued - (now_s - self._at_s) * self.bytes_per_s)
        self._at_s = now_s
        return ceil(self._queued - 1e-9)

    def room(self, now_s: float) -> int:
        return max(0, self.most_queued - self.count_queued(now_s))

    def note_written(self, count: int, now_s: float) -> None:
        self.count_queued(now_s)
        self._queued += count

    def wait_s(self, now_s: float, queued: int) -> float:
        """Return the seconds until at most `queued` bytes wait."""
        self.count_queued(now_s)
        return max(0.0, (self._queued - queued) / self.bytes_per_s)
