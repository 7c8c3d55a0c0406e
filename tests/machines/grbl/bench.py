"""A workbench for the driver: a simulated mill on simulated time, a tap on the wire, a program with known ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from machines.driver import Command, CommandDone, Event, Faulted, MillState, ProgramDone, ProgramLine
from machines.grbl.driver import GrblDriver
from machines.grbl.link import GrblOptions
from machines.simulated.endpoints import MemoryPort
from machines.simulated.faults import Fault, Faults
from machines.simulated.mill import SimulatedMill
from machines.simulated.traits import GRBL_11, Traits

Triple = tuple[float, float, float]


def numbered(blocks: list[bytes]) -> list[ProgramLine]:
    lines, offset = [], 0
    for number, block in enumerate(blocks, 1):
        lines.append(ProgramLine(number, offset, block))
        offset += len(block) + 1
    return lines


def spiral(moves: int, turn_rad: float = 0.03) -> tuple[list[ProgramLine], list[Triple]]:
    """A program whose points are all different, and those points."""
    points = [
        (round(20 * math.sin(turn_rad * k), 3), round(20 - 20 * math.cos(turn_rad * k), 3), round(-0.001 * k, 3))
        for k in range(1, moves + 1)
    ]
    blocks = [b"G21G90G94", b"G54", b"M3S10000", b"G0X0Y0Z2", b"G1Z0F600", b"F1500"]
    blocks += [b"G1X%.3fY%.3fZ%.3f" % point for point in points]
    blocks += [b"G0Z5", b"M5", b"M2"]
    return numbered(blocks), points


class Tap:
    """A port that remembers what was written when."""

    def __init__(self, port: MemoryPort) -> None:
        self.port, self.url, self.wire_bytes_per_s = port, port.url, port.wire_bytes_per_s
        self.written: list[tuple[float, bytes]] = []

    def read(self, timeout_s: float) -> bytes:
        return self.port.read(timeout_s)

    def write(self, data: bytes) -> None:
        self.written.append((self.port.clock(), bytes(data)))
        self.port.write(data)

    def write_realtime(self, data: bytes) -> bool:
        self.write(data)
        return True

    def wake(self) -> None:
        self.port.wake()

    def close(self) -> None:
        self.port.close()

    def clock(self) -> float:
        return self.port.clock()


@dataclass
class Bench:
    traits: Traits = GRBL_11
    faults: tuple[Fault, ...] = ()
    options: GrblOptions = field(default_factory=GrblOptions)
    baud: int | None = 115200
    link: Callable[[MemoryPort], Tap] = Tap

    def __post_init__(self) -> None:
        self.mill = SimulatedMill(self.traits, Faults(self.faults))
        self.tap = self.link(MemoryPort(self.mill, baud=self.baud))
        self.driver = GrblDriver(self.tap, options=self.options)
        self.events: list[Event] = []
        self.most_in_flight = 0

    def until(self, done: Callable[[], object], within_s: float = 60.0) -> bool:
        """Poll until `done()`, at most so much simulated time."""
        end_s = self.mill.now_s + within_s
        while not done():
            if self.mill.now_s > end_s:
                return False
            self.events += self.driver.poll(0.2)
            self.most_in_flight = max(self.most_in_flight, self.driver.progress.bytes_in_flight)
        return True

    def pass_time(self, seconds: float) -> None:
        end_s = self.mill.now_s + seconds
        self.until(lambda: self.mill.now_s >= end_s, seconds + 1.0)

    def state(self) -> MillState:
        return self.driver.status.state

    def connected(self) -> Bench:
        self.driver.connect()
        assert self.until(lambda: self.state() in (MillState.IDLE, MillState.ALARM), 10.0), self.driver.status
        return self

    def start(self, lines: list[ProgramLine], *, past_line: int = 0) -> None:
        """Start a program; with `past_line`, wait until more lines than that are executed."""
        self.driver.start(iter(lines))
        if past_line:
            self.until(lambda: self.driver.progress.executed_line > past_line)

    def run(self, lines: list[ProgramLine], within_s: float = 60.0) -> None:
        """Run a program to its end, without a fault."""
        self.start(lines)
        self.finish(within_s)

    def finish(self, within_s: float = 60.0) -> None:
        assert self.until(lambda: self.of(ProgramDone) or self.of(Faulted), within_s), self.driver.status
        assert not self.of(Faulted), self.of(Faulted)

    def do(self, command: Command, within_s: float = 60.0) -> CommandDone:
        """Carry out a command, and return how it ended."""
        count = len(self.of(CommandDone))
        self.driver.command(command)
        assert self.until(lambda: len(self.of(CommandDone)) > count, within_s)
        return self.of(CommandDone)[-1]

    def hold(self, within_s: float = 5.0) -> None:
        """Hold, and wait until the mill stands."""
        self.driver.hold()
        assert self.until(lambda: self.state() is MillState.HELD, within_s)

    def written(self, begin: int = 0) -> bytes:
        """Return what went over the wire from that write on."""
        return b"".join(data for _, data in self.tap.written[begin:])

    def of(self, kind: type[Event]) -> list[Event]:
        return [event for event in self.events if isinstance(event, kind)]

    def cut_ends(self) -> list[Triple]:
        return [segment.end for segment in self.mill.recording.cuts()]

    def last_whole(self, points: list[Triple]) -> int:
        """How many of these points were really reached, in order; fails on any other cut below Z0."""
        reached = 0
        for segment in self.mill.recording.cuts():
            if segment.end[2] >= 0.0 or not segment.whole:
                continue
            assert math.dist(segment.end, points[reached]) < 0.006, (segment, points[reached])
            reached += 1
        return reached
