"""A simulated mill that has started, and the words that come back from it."""

from __future__ import annotations

from machines.simulated import GRBL_11, MemoryPort, SimulatedMill, Traits


def power_up(mill: SimulatedMill, baud: int | None = 115200) -> MemoryPort:
    """Wait until it has said its banner."""
    port = MemoryPort(mill, baud)
    mill.advance(1.0)
    mill.output()
    return port


class Terminal:
    def __init__(self, traits: Traits = GRBL_11, baud: int | None = 115200) -> None:
        self.mill = SimulatedMill(traits)
        self.port = MemoryPort(self.mill, baud)
        self.first = self.wait(1.0)

    def wait(self, seconds: float) -> list[str]:
        end, words = self.port.clock() + seconds, b""
        while self.port.clock() < end:
            words += self.port.read(end - self.port.clock())
        return [line for line in words.decode("latin-1").split("\r\n") if line]

    def ask(self, text: str | bytes, seconds: float = 0.2) -> list[str]:
        self.port.write(text.encode("latin-1") if isinstance(text, str) else text)
        return self.wait(seconds)

    def status(self) -> str:
        return self.ask("?", 0.05)[-1]
