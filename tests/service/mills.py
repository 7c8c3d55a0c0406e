"""Simulated mills and small programs for the tests of agent and terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

from machines.simulated import GRBL_11, SimulatedMill, Traits
from machines.simulated.endpoints import Endpoint, serve_pty

# With switches: locked at power-up; its homing finds the corner it stands in, quickly.
WITH_SWITCHES = replace(
    GRBL_11,
    homing=True,
    power_up_machine_mm=(0.0, 0.0, 0.0),
    settings={20: 1, 21: 1, 24: 1000, 25: 5000, 26: 5, 110: 5000, 111: 5000, 112: 3000},
)
AT_ZERO = replace(GRBL_11, power_up_machine_mm=(0.0, 0.0, 0.0))
ZERO_MM = (-200.0, -150.0, -40.0)  # G54 in machine coordinates, as a touch-off has left it
LONG_LINES = 2000  # of a program that is not over while a test looks at it


@dataclass(frozen=True, slots=True)
class Bench:
    """A simulated mill on a pty."""

    mill: SimulatedMill
    url: str
    endpoint: Endpoint
    time_factor: float

    def hurry(self) -> None:
        """From now on as fast as it can: for what is only waited for."""
        self.endpoint.time_factor = 10 * self.time_factor

    @property
    def cut(self) -> list[tuple[float, float, float]]:
        """Ends of the blocks cut so far, whole ones only, rounded to the recording's noise."""
        return [tuple(round(c, 3) for c in s.end) for s in self.mill.recording.cuts() if s.whole]  # type: ignore[misc]

    @property
    def stands(self) -> bool:
        """Nothing moves: the stepper has nothing to do."""
        return self.mill.firmware.stepper.next_s == inf

    @property
    def holds_nothing(self) -> bool:
        """No line is left in the controller that a cycle start could cut."""
        firmware = self.mill.firmware
        return not firmware.stepper.planner.blocks and firmware.task is None and not self.mill.serial.count_used(inf)

    def unplug(self) -> None:
        self.mill.unplug()


@contextmanager
def bench(time_factor: float, *, traits: Traits = AT_ZERO) -> Iterator[Bench]:
    mill = SimulatedMill(traits)
    with serve_pty(mill, time_factor) as endpoint:
        yield Bench(mill, endpoint.url, endpoint, time_factor)


_ROW = 200


def place(i: int, step_mm: float = 1.0) -> tuple[float, float, float]:
    """Where cut `i` of a test program ends: rows to and fro, no place twice."""
    row, column = divmod(i, _ROW)
    return (round((column + 1 if row % 2 == 0 else _ROW - column) * step_mm, 3), row * step_mm, -1.0 - i % 2)


def program(path: Path, lines: int, *, step_mm: float = 1.0, feed_mm_per_min: int = 1200) -> Path:
    """A program of `lines` cuts; at the given feed a cut takes some 70 ms."""
    cuts = [f"G1 X{x:.3f} Y{y:.3f} Z{z:.0f}" for x, y, z in (place(i, step_mm) for i in range(lines))]
    text = ["G21 G90 G17 G94", "G54", "M3 S1000", f"F{feed_mm_per_min}", *cuts, "M5", "M2"]
    path.write_text("\n".join(text) + "\n")
    return path


def ends(lines: int, step_mm: float = 1.0) -> list[tuple[float, float, float]]:
    """Where the cuts of `program` end."""
    return [place(i, step_mm) for i in range(lines)]


def zeroed(mill: Bench, zero_mm: tuple[float, float, float] = ZERO_MM) -> None:
    """The zero of the work, kept in the controller's memory."""
    interpreter = mill.mill.firmware.interpreter
    interpreter.stored["G54"] = zero_mm
    interpreter.refresh()


def ends_on_the_mill(lines: int, zero_mm: tuple[float, float, float] = ZERO_MM) -> set[tuple[float, ...]]:
    """Where the cuts of `program` end, in machine coordinates."""
    return {tuple(round(p + z, 3) for p, z in zip(place(i), zero_mm, strict=True)) for i in range(lines)}


def is_homing(mill: Bench) -> bool:
    return mill.mill.firmware.state == "Home"


def fail_homing(mill: Bench, number: int) -> None:
    firmware = mill.mill.firmware
    firmware.traits = replace(firmware.traits, homing_alarm=number)


def leave_the_travel(mill: Bench) -> None:
    """Soft limits see the next lines beyond the end of X."""
    mill.mill.firmware.settings[130] = 100.0


IN_THE_CUT: dict[int, Callable[[Bench], None]] = {
    1: lambda mill: mill.mill.press("limit"),
    2: leave_the_travel,
    3: lambda mill: mill.mill.press("reset"),
    4: lambda mill: mill.mill.firmware.raise_alarm(4),
    5: lambda mill: mill.mill.firmware.raise_alarm(5),
}
WHILE_HOMING: dict[int, Callable[[Bench], None]] = {
    6: lambda mill: mill.mill.press("reset"),
    7: lambda mill: mill.mill.press("door"),
}
