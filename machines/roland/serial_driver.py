"""Roland mills on RS-232 with hardware handshake (MDX-15/20, EGX, PNC families): bytes go while the mill keeps CTS up.

The port does the handshake (flow = "rtscts"); the driver keeps the number of bytes waiting in the port small, so that a
hold stops soon. The mill sends nothing: RML-1 has no line numbers and no position query, so only a lower bound of what
is executed is known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from machines.drip.feed import Pace
from machines.drip.one_way import OneWayDriver
from machines.driver import DriverFacts, ProgramLine
from machines.errors import ProgramRefusedError
from machines.gcode.dialects import RML
from phrases.phrase import Phrase

if TYPE_CHECKING:
    from machines.port import SerialPort
    from machines.profile import LinkSettings

_QUEUED = 64
_UNDER_WIRE_RATE = 0.98

FACTS = DriverFacts(
    kind="Roland, RS-232 with hardware handshake",
    capacity="handshake lines: the mill drops CTS when its buffer is full",
    acknowledgement="none: progress is bytes that have left, execution is not visible",
    stop="sending stops; the mill executes what its buffer holds: the operator presses VIEW or opens the cover",
    position="none",
    tried_on="only a simulated mill; never a real Roland. RS-232 on the MDX-40A is not confirmed by any source",
)


class RolandSerialDriver(OneWayDriver):
    """machines.driver.Driver for RML-1 or NC text over a line with RTS/CTS."""

    def __init__(self, port: SerialPort, link: LinkSettings, *, dialect: str = RML, planner_blocks: int = 0):
        pace = Pace(_UNDER_WIRE_RATE * link.wire_bytes_per_s, _QUEUED)
        super().__init__(port, facts=FACTS, pace=pace, buffer_bytes=link.rx_bytes, planner_blocks=planner_blocks)
        self._count_unsent_of_port = port.unsent_bytes
        self._line_end = b"\n" if dialect == RML else b"\r\n"

    def _encode(self, line: ProgramLine) -> bytes:
        bad = next((byte for byte in line.text if byte >= 0x7F or (byte < 0x20 and byte not in b"\t\x03")), None)
        if bad is not None:
            raise ProgramRefusedError(
                line.number, line.text.decode("latin-1"), Phrase("byte 0x{byte:02x} is not printable text", byte=bad)
            )
        return line.text + self._line_end

    def _count_unsent(self, now_s: float) -> int:
        return max(self._pace.count_queued(now_s), self._count_unsent_of_port())

    def _may_send(self) -> bool:
        """Return whether the tty has sent its bytes: while CTS is down no more are added."""
        return self._count_unsent_of_port() < _QUEUED

    def _turn(self) -> float:
        wait_s = super()._turn()
        waiting = self._feed is not None and not self._held and not self._may_send()
        return min(wait_s, 0.02) if waiting else wait_s
