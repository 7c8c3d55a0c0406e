"""Roland mills on RS-232 with hardware handshake (MDX-15/20, EGX, PNC families): bytes go while the mill keeps CTS up.

The port does the handshake (flow = "rtscts"); the driver sees to it that little waits in the port, so that a hold
stops soon. Nothing comes back unless `queries` is on, for families that answer ESC .B and .E (EGX-600 and PNC-3100
manuals). RML-1 has no line numbers and no position query: what is executed is only ever bounded from below.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from machines.drip.feed import Pace
from machines.drip.one_way import OneWayDriver
from machines.driver import DriverFacts, FaultCause, Faulted, MillState, ProgramLine
from machines.errors import ProgramRefusedError
from machines.gcode.dialects import RML
from phrases.phrase import Phrase

if TYPE_CHECKING:
    from machines.port import Port
    from machines.profile import LinkSettings

ESC_FREE, ESC_ERROR, ESC_ABORT = b"\x1b.B", b"\x1b.E", b"\x1b.K"
ERRORS = {
    15: Phrase("framing or parity error: check baud, bytesize, parity"),
    16: Phrase("its buffer has overflowed: check the handshake"),
}
OS_QUEUE_BYTES = 4096  # what a tty may hold beside what we know of, where the port cannot tell
_QUEUED = 64
_UNDER_WIRE_RATE = 0.98
_ASK_EVERY_S = 2.0
_MOST_REPLY = 64

FACTS = DriverFacts(
    kind="Roland, RS-232 with hardware handshake",
    capacity="handshake lines: the mill drops CTS when its buffer is full",
    acknowledgement="none: progress is bytes that have left, execution is not visible",
    stop="sending stops; the mill executes what its buffer holds: the operator presses VIEW or opens the cover",
    position="none",
    tried_on="only a simulated mill; never a real Roland. RS-232 on the MDX-40A is not confirmed by any source",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RolandSerialOptions:
    """queries    : the mill answers ESC .B (free bytes) and ESC .E (error): EGX-600 and PNC-3100 do by their manuals
    abort_code : the mill takes ESC .K (drop what is buffered), same families
    """

    queries: bool = False
    abort_code: bool = False


class RolandSerialDriver(OneWayDriver):
    """machines.driver.Driver for RML-1 or NC text over a line with RTS/CTS."""

    def __init__(
        self,
        port: Port,
        link: LinkSettings,
        *,
        dialect: str = RML,
        options: RolandSerialOptions | None = None,
        planner_blocks: int = 0,
    ):
        self._options = options or RolandSerialOptions()
        self._unsent_of_port = getattr(port, "unsent_bytes", None)
        hidden = 0 if self._unsent_of_port else OS_QUEUE_BYTES
        super().__init__(
            port,
            facts=FACTS,
            pace=Pace(_UNDER_WIRE_RATE * link.wire_bytes_per_s, _QUEUED),
            buffer_bytes=None if link.rx_bytes is None else link.rx_bytes + hidden,
            planner_blocks=planner_blocks,
        )
        self._line_end = b"\n" if dialect == RML else b"\r\n"
        self._asked: deque[bytes] = deque()
        self._reply = b""
        self._ask_at_s = 0.0

    def _encode(self, line: ProgramLine) -> bytes:
        bad = next((byte for byte in line.text if byte >= 0x7F or (byte < 0x20 and byte not in b"\t\x03")), None)
        if bad is not None:
            raise ProgramRefusedError(
                line.number, line.text.decode("latin-1"), Phrase("byte 0x{byte:02x} is not printable text", byte=bad)
            )
        return line.text + self._line_end

    def _abort_bytes(self) -> bytes:
        return ESC_ABORT if self._options.abort_code else b""

    def _count_unsent(self, now_s: float) -> int:
        return max(self._pace.count_queued(now_s), self._unsent_of_port() if self._unsent_of_port else 0)

    def _may_send(self) -> bool:
        """Return whether the tty has let go of what it had: while CTS is down nothing more is put on top."""
        return self._unsent_of_port is None or self._unsent_of_port() < _QUEUED

    def _turn(self) -> float:
        wait_s = super()._turn()
        waiting = self._feed is not None and not self._held and not self._may_send()
        return min(wait_s, 0.02) if waiting else wait_s

    def _tick(self, now_s: float) -> None:
        if not self._options.queries or now_s < self._ask_at_s:
            return
        self._ask_at_s = now_s + _ASK_EVERY_S
        if len(self._asked) < 2:
            for query in (ESC_ERROR, ESC_FREE):
                self._port.write(query)
                self._pace.note_written(len(query), now_s)
                self._asked.append(query)

    def _receive(self, data: bytes, now_s: float) -> None:
        *replies, self._reply = (self._reply + data)[-_MOST_REPLY:].split(b"\r")
        for reply in replies:
            if not self._asked or not reply.strip().isdigit():
                continue
            value = int(reply)
            if self._asked.popleft() == ESC_FREE:
                self._channel.update(detail=Phrase("the mill says {count} bytes of its buffer are free", count=value))
            elif value:
                meaning = ERRORS.get(value, Phrase("see its manual"))
                words = Phrase("the mill reports error {number}: {meaning}", number=value, meaning=meaning)
                self._end_by_fault(words, now_s)

    def _end_by_fault(self, words: Phrase, now_s: float) -> None:
        line = self.progress.sent_line if self._feed is not None else 0
        self._end_stream()
        self._channel.enter(
            MillState.ALARM, Phrase("{words}; the mill still executes {held}", words=words, held=self._describe_held())
        )
        self._channel.events.append(Faulted(FaultCause.DEVICE, words, line, now_s))
