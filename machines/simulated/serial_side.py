"""The controller's UART: a receive ring that drops what does not fit, realtime bytes picked out, a paced transmitter.

Arrival times are exact to the byte but kept per chunk: the bytes of a chunk follow one another at `byte_s`.
"""

from __future__ import annotations

import heapq
from collections import deque
from math import inf

NEWLINE = b"\n"
REALTIME = bytes([0x18, *b"!?~", *range(0x80, 0x100)])


class SerialSide:
    """Bytes in and out with their times.

    lost_overflow, lost_deaf : bytes dropped because the ring was full, or because an EEPROM write shut the receiver
    most_used                : greatest fill of the ring seen
    """

    def __init__(self, rx_bytes: int, tx_bytes: int, *, crlf_answered_twice: bool) -> None:
        self.rx_bytes = rx_bytes
        self.tx_bytes = tx_bytes
        self.byte_s = 0.0
        self.ring = bytearray()
        self.incoming: deque[tuple[float, bytes]] = deque()  # arrival of the first byte, bytes
        self.realtime: list[tuple[float, int, int]] = []  # heap: time, order, byte
        self.out: deque[tuple[float, bytes]] = deque()  # time of the last byte, bytes
        self.wire_free_s = 0.0
        self.tx_free_s = 0.0
        self.deaf_until_s = -inf
        self.lost_overflow = 0
        self.lost_deaf = 0
        self.most_used = 0
        self._order = 0
        self._twice = crlf_answered_twice
        self._after_cr = False

    # -- to the mill -----------------------------------------------------------------------------------------------
    def receive(self, data: bytes, at_s: float) -> None:
        """Take bytes put on the wire at `at_s`, behind those still under way."""
        step = self.byte_s
        first = (self.wire_free_s if self.wire_free_s > at_s else at_s) + step
        self.wire_free_s = first + (len(data) - 1) * step
        if len(data.translate(None, REALTIME)) != len(data):
            self._split(data, first)
        else:
            self._receive_chunk(data, first)

    def _split(self, data: bytes, first: float) -> None:
        start = 0
        for k, byte in enumerate(data):
            if byte in REALTIME:
                if k > start:
                    self._receive_chunk(data[start:k], first + start * self.byte_s)
                start = k + 1
                self._order += 1
                heapq.heappush(self.realtime, (first + k * self.byte_s, self._order, byte))
        if start < len(data):
            self._receive_chunk(data[start:], first + start * self.byte_s)

    def _receive_chunk(self, data: bytes, first: float) -> None:
        if first < self.deaf_until_s:
            count = self._count_arrived(first, len(data), self.deaf_until_s, strictly=True)
            self.lost_deaf += count
            data, first = data[count:], first + count * self.byte_s
        if b"\r" in data or self._after_cr:
            data = self._convert_line_ends(data)
        if data:
            self.incoming.append((first, data))

    def _convert_line_ends(self, data: bytes) -> bytes:
        """Convert line ends: CR ends a line as LF does; where CRLF is one line end, the LF after a CR vanishes."""
        if self._twice:
            return data.replace(b"\r", NEWLINE)
        if self._after_cr and data.startswith(NEWLINE):
            data = data[1:]
        self._after_cr = data.endswith(b"\r")
        return data.replace(b"\r\n", NEWLINE).replace(b"\r", NEWLINE)

    def _count_arrived(self, first: float, length: int, at_s: float, *, strictly: bool = False) -> int:
        if first > at_s or (strictly and first >= at_s):
            return 0
        if self.byte_s == 0.0 or at_s == inf:
            return length
        count = int((at_s - first) / self.byte_s + 1e-9) + 1
        if strictly and first + (count - 1) * self.byte_s >= at_s:
            count -= 1
        return min(length, count)

    def next_line_s(self) -> float:
        """Return when the next line end has arrived: -inf if it is in the ring, inf if none is under way."""
        if NEWLINE in self.ring:
            return -inf
        for first, data in self.incoming:
            k = data.find(NEWLINE)
            if k >= 0:
                return first + k * self.byte_s
        return inf

    def take_line(self) -> bytes:
        """Return the next line. While the main loop waits for it, its bytes do not stay in the ring, so they cannot
        overflow it.
        """
        ring, incoming = self.ring, self.incoming
        if ring:
            k = ring.find(NEWLINE)
            if k >= 0:
                line = bytes(ring[:k])
                del ring[: k + 1]
                return line
        parts = bytes(ring)
        ring.clear()
        while True:
            first, data = incoming.popleft()
            k = data.find(NEWLINE)
            if k < 0:
                parts += data
                continue
            if k + 1 < len(data):
                incoming.appendleft((first + (k + 1) * self.byte_s, data[k + 1 :]))
            return parts + data[:k] if parts else data[:k]

    def admit(self, at_s: float) -> None:
        """Put bytes that came while the main loop was busy into the ring, or drop them if the ring is full or deaf."""
        incoming, ring = self.incoming, self.ring
        while incoming:
            first, data = incoming[0]
            if first > at_s:
                break
            count = self._count_arrived(first, len(data), at_s)
            if count == len(data):
                incoming.popleft()
            else:
                incoming[0] = (first + count * self.byte_s, data[count:])
                data = data[:count]
            room = self.rx_bytes - len(ring)
            if count > room:
                self.lost_overflow += count - room
                data = data[:room]
            ring += data
        if len(ring) > self.most_used:
            self.most_used = len(ring)

    def count_used(self, at_s: float) -> int:
        """Return the number of bytes in the ring now, as Bf: reports it."""
        waiting = sum(self._count_arrived(first, len(data), at_s) for first, data in self.incoming)
        return min(self.rx_bytes, len(self.ring) + waiting)

    def go_deaf(self, from_s: float, until_s: float) -> None:
        """Switch the receiver interrupt off: what arrives is lost."""
        self.admit(from_s)
        self.deaf_until_s = max(self.deaf_until_s, until_s)
        waiting, self.incoming = self.incoming, deque()
        for first, data in waiting:
            self._receive_chunk(data, first)
        kept = [r for r in self.realtime if not from_s <= r[0] < until_s]
        self.lost_deaf += len(self.realtime) - len(kept)
        heapq.heapify(kept)
        self.realtime = kept

    def clear_received(self, at_s: float) -> None:
        """Clear the ring, as a reset does; what is still on the wire arrives."""
        self.admit(at_s)
        self.ring.clear()

    def cut_wire(self, at_s: float) -> None:
        """Cut the wire: nothing arrives any more, nothing goes out."""
        self.admit(at_s)
        self.incoming.clear()
        self.realtime = [r for r in self.realtime if r[0] <= at_s]
        heapq.heapify(self.realtime)
        self.out.clear()
        self.wire_free_s = self.tx_free_s = at_s

    # -- from the mill ---------------------------------------------------------------------------------------------
    def send(self, data: bytes, at_s: float) -> None:
        start = self.tx_free_s if self.tx_free_s > at_s else at_s
        self.tx_free_s = start + len(data) * self.byte_s
        self.out.append((self.tx_free_s, data))

    def may_go_on_s(self) -> float:
        """Return when the main loop may go on: it waits while more than `tx_bytes` are queued."""
        return self.tx_free_s - self.tx_bytes * self.byte_s
