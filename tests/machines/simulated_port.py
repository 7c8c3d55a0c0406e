"""What the simulated far ends have in common that are their driver's port as well, in simulated time."""

from __future__ import annotations

from dataclasses import dataclass

from machines.errors import PortLostError


@dataclass(slots=True, kw_only=True)
class SimulatedPort:
    bytes_per_s: float = 960.0
    url: str = "simulated://mill"
    now_s: float = 0.0
    unplugged: bool = False
    _woken: bool = False

    @property
    def wire_bytes_per_s(self) -> float | None:
        return self.bytes_per_s

    def clock(self) -> float:
        return self.now_s

    def require_plugged(self) -> None:
        if self.unplugged:
            raise PortLostError(self.url, "the device is gone")

    def write_realtime(self, data: bytes) -> bool:
        return False

    def wake(self) -> None:
        self._woken = True

    def close(self) -> None: ...
