"""A port to a simulated mill in the same process, on its simulated clock."""

from __future__ import annotations

import threading

from machines.errors import PortError, PortLostError
from machines.simulated.mill import SimulatedMill

_BITS_PER_BYTE = 10  # 8N1


class MemoryPort:
    """Implements machines.port.Port. No time passes but in `read`, which ends as soon as something has come.

    baud      : of the host's side; None: no pacing. Not the mill's: both sides read garbage
    latency_s : a USB adapter hands bytes over so much after the first of them
    """

    def __init__(self, mill: SimulatedMill, baud: int | None = 115200, *, latency_s: float = 0.0) -> None:
        self.url = "memory://mill"
        if not mill.connected:
            raise PortError(self.url, "no such port: the cable is unplugged")
        self.mill = mill
        self.wire_bytes_per_s = baud / _BITS_PER_BYTE if baud else None
        self._garbage = baud is not None and baud != mill.traits.baud
        self._latency_s = latency_s
        self._cable = mill.cable
        self._woken = threading.Event()
        self._closed = False
        mill.use_wire(_BITS_PER_BYTE / baud if baud else 0.0)
        mill.pulse_dtr()

    def clock(self) -> float:
        return self.mill.now_s

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, at once; else time passes until something comes or the timeout is over (then b"")."""
        mill = self.mill
        self._check()
        data = mill.output()
        if not data and not self._woken.is_set():
            mill.advance(mill.now_s + max(timeout_s, 0.0), until_output=True)
            if self._latency_s and mill.output_s() <= mill.now_s:
                mill.advance(mill.now_s + self._latency_s)
            data = mill.output()
        self._woken.clear()
        if not data:
            self._check()
        return self._noise(data) if self._garbage else data

    def write(self, data: bytes) -> None:
        self._check()
        self.mill.receive(self._noise(data) if self._garbage else data)

    def write_realtime(self, data: bytes) -> bool:
        if self._closed or self.mill.cable != self._cable or not self.mill.connected:
            return False
        self.write(data)
        return True

    def wake(self) -> None:
        self._woken.set()

    def close(self) -> None:
        self._closed = True

    def _check(self) -> None:
        if self._closed:
            raise PortError(self.url, "is closed")
        if self.mill.cable != self._cable or not self.mill.connected:
            raise PortLostError(self.url, "the device is gone (cable or power)")

    def _noise(self, data: bytes) -> bytes:
        return bytes(self.mill.chance.randrange(0x80, 0x100) if b & 1 else b ^ 0x55 for b in data)
