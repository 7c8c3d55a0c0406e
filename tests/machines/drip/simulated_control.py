"""A simulated DNC control behind a serial line, in simulated time: a small buffer, DC1/DC3, slow blocks.

It does what makes drip feeds fail: it stops the sender late (few bytes before its buffer is full), after every 252
characters and after `%`, its words reach the host late, and a byte that finds the buffer full is lost and counted.
The object is the port of the driver under test as well as the control.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from math import inf

from tests.machines.simulated_port import SimulatedPort

DC1, DC3 = b"\x11", b"\x13"


@dataclass(slots=True, kw_only=True)
class SimulatedControl(SimulatedPort):
    """margin_bytes  : room left when DC3 is sent
    latency_s     : from the control's wire to the reader (USB adapter)
    line_s        : time a block takes to execute
    planner_lines : blocks it reads ahead, out of the buffer and not yet begun
    stop_every    : DC3 after this many characters, as OSP does; 0 never
    ready_at_s    : when the operator presses start and the first DC1 goes out
    resend_s      : DC3 sent, pause until DC1 may follow
    parity_bit    : words of the control carry even parity in bit 7 (read with 8 bits by a wrong setting)
    """

    buffer_bytes: int = 1024
    margin_bytes: int = 16
    latency_s: float = 0.0
    line_s: float = 0.02
    planner_lines: int = 0
    stop_every: int = 252
    ready_at_s: float = 1.0
    resend_s: float = 0.05
    parity_bit: bool = False

    received: bytearray = field(default_factory=bytearray)
    executed: list[bytes] = field(default_factory=list)
    overruns: int = 0
    early: int = 0  # bytes before the first DC1
    most_after_stop: int = 0
    stops: int = 0
    _buffer: bytearray = field(default_factory=bytearray)
    _wire: deque[tuple[float, int]] = field(default_factory=deque)  # byte and when it arrives at the control
    _words: deque[tuple[float, bytes]] = field(default_factory=deque)  # DC1/DC3 and when the reader sees them
    _wire_free_s: float = 0.0
    _block_ends_s: float = inf
    _stopped: bool = True
    _since_stop: int = 0
    _after_stop: int = 0
    _may_resume_s: float = 0.0
    _started: bool = False
    _tape_marks: int = 0
    _planner: deque[bytes] = field(default_factory=deque)

    # The port.

    def write(self, data: bytes) -> None:
        self.require_plugged()
        for byte in data:
            self._wire_free_s = max(self._wire_free_s, self.now_s) + 1 / self.bytes_per_s
            self._wire.append((self._wire_free_s, byte))

    def read(self, timeout_s: float) -> bytes:
        self.require_plugged()
        end_s = self.now_s + max(timeout_s, 1e-6)
        while True:
            if self._woken:
                self._woken = False
                return b""
            if self._words and self._words[0][0] <= self.now_s:
                found = b""
                while self._words and self._words[0][0] <= self.now_s:
                    found += self._words.popleft()[1]
                return found
            at_s = min(self._next_s(), end_s)
            self._step(at_s)
            if at_s >= end_s and not (self._words and self._words[0][0] <= self.now_s):
                return b""

    # The control.

    @property
    def idle(self) -> bool:
        """Nothing on the wire, nothing in the buffer, nothing executing."""
        return not self._wire and not self._buffer and not self._planner and self._block_ends_s == inf

    def run_dry(self) -> None:
        """Let the control execute all it holds; half a block without its end stays in the buffer."""
        while (at_s := min(self._block_ends_s, self._wire[0][0] if self._wire else inf)) < inf:
            self._step(max(at_s, self.now_s))

    def _next_s(self) -> float:
        times = [self._block_ends_s]
        if self._wire:
            times.append(self._wire[0][0])
        if self._words:
            times.append(self._words[0][0])
        if not self._started:
            times.append(self.ready_at_s)
        elif self._stopped and self._tape_marks < 2 and self._room_again():
            times.append(max(self._may_resume_s, self.now_s))
        return max(min(times), self.now_s)

    def _step(self, to_s: float) -> None:
        """Advance; every event due by `to_s` happens, in order of kind (arrivals before decisions)."""
        self.now_s = max(self.now_s, to_s)
        while self._wire and self._wire[0][0] <= self.now_s + 1e-12:
            self._arrive(self._wire.popleft()[1])
        if self._block_ends_s <= self.now_s:
            self._block_ends_s = inf
        self._execute()
        if not self._started and self.now_s >= self.ready_at_s:
            self._started = True
            self._say(DC1)
        waits = self._started and self._stopped and self._tape_marks < 2 and self._room_again()
        if waits and self.now_s >= self._may_resume_s:
            self._say(DC1)

    def _room_again(self) -> bool:
        return len(self._buffer) <= self.buffer_bytes // 2

    def _arrive(self, byte: int) -> None:
        self.early += not self._started
        if self._stopped and self._started:
            self._after_stop += 1
            self.most_after_stop = max(self.most_after_stop, self._after_stop)
        if len(self._buffer) >= self.buffer_bytes:
            self.overruns += 1
            return
        self.received.append(byte)
        self._buffer.append(byte)
        self._since_stop += 1
        self._tape_marks += byte == 0x25
        full = self.buffer_bytes - len(self._buffer) <= self.margin_bytes
        counted = self.stop_every and self._since_stop >= self.stop_every
        if not self._stopped and (full or counted or byte == 0x25):
            self._say(DC3)

    def _say(self, word: bytes) -> None:
        self._stopped = word == DC3
        if word == DC3:
            self.stops += 1
            self._since_stop, self._after_stop = 0, 0
            self._may_resume_s = self.now_s + self.resend_s
        sent = bytes([word[0] | 0x80]) if self.parity_bit and word == DC3 else word
        self._words.append((self.now_s + 1 / self.bytes_per_s + self.latency_s, sent))

    def _execute(self) -> None:
        """`executed` lists the blocks begun; the last of them may be under way."""
        while True:
            while len(self._planner) <= self.planner_lines and (end := self._buffer.find(b"\n")) >= 0:
                line = bytes(self._buffer[: end + 1]).strip(b"\r\n\0")
                del self._buffer[: end + 1]
                if line.strip(b"%"):
                    self._planner.append(line)
            if not self._planner or self._block_ends_s < inf:
                return
            self.executed.append(self._planner.popleft())
            self._block_ends_s = self.now_s + self.line_s
