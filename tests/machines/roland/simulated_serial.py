"""A simulated Roland mill on RS-232 in simulated time: it drops CTS when its buffer is nearly full and works slowly.

The object is the port of the driver under test as well as the mill. The tty queue between them goes on sending as
long as CTS is up, whatever the driver does: that is what makes a hold late if the driver queues too much.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from math import inf

from tests.machines.simulated_port import SimulatedPort


@dataclass(slots=True, kw_only=True)
class SimulatedSerialMill(SimulatedPort):
    """margin_bytes : room left when CTS drops (a UART's FIFO may still send some)
    fifo_bytes   : bytes that leave after CTS has dropped
    command_s    : time one `;`-terminated command takes
    """

    buffer_bytes: int = 2048
    margin_bytes: int = 64
    fifo_bytes: int = 16
    command_s: float = 0.05

    received: bytearray = field(default_factory=bytearray)
    executed: list[bytes] = field(default_factory=list)
    overruns: int = 0
    most_unsent: int = 0
    _queue: deque[int] = field(default_factory=deque)
    _buffer: bytearray = field(default_factory=bytearray)
    _next_byte_s: float = inf
    _command_ends_s: float = inf
    _after_cts: int = 0

    @property
    def cts(self) -> bool:
        return self.buffer_bytes - len(self._buffer) > self.margin_bytes

    def unsent_bytes(self) -> int:
        return len(self._queue)

    def write(self, data: bytes) -> None:
        self.require_plugged()
        self._queue += data
        self.most_unsent = max(self.most_unsent, len(self._queue))
        self._schedule()

    def read(self, timeout_s: float) -> bytes:
        self.require_plugged()
        end_s = self.now_s + max(timeout_s, 1e-6)
        while not self._woken:
            at_s = min(self._next_byte_s, self._command_ends_s, end_s)
            self._step(at_s)
            if at_s >= end_s:
                break
        self._woken = False
        return b""

    def run_dry(self) -> None:
        while min(self._next_byte_s, self._command_ends_s) < inf:
            self._step(min(self._next_byte_s, self._command_ends_s))

    def _schedule(self) -> None:
        self._after_cts = 0 if self.cts else self._after_cts
        may = bool(self._queue) and (self.cts or self._after_cts < self.fifo_bytes)
        if may and self._next_byte_s == inf:
            self._next_byte_s = self.now_s + 1 / self.bytes_per_s
        elif not may:
            self._next_byte_s = inf

    def _step(self, to_s: float) -> None:
        self.now_s = max(self.now_s, to_s)
        if self._next_byte_s <= self.now_s:
            self._next_byte_s = inf
            self._after_cts += not self.cts
            self._arrive(self._queue.popleft())
        if self._command_ends_s <= self.now_s:
            self._command_ends_s = inf
        while self._command_ends_s == inf and (end := self._buffer.find(b";")) >= 0:
            self.executed.append(bytes(self._buffer[:end]).strip())
            del self._buffer[: end + 1]
            self._command_ends_s = self.now_s + self.command_s
        self._schedule()

    def _arrive(self, byte: int) -> None:
        if len(self._buffer) >= self.buffer_bytes:
            self.overruns += 1
            return
        self.received.append(byte)
        self._buffer.append(byte)
