"""Clean soak: millions of short lines at the wire's own rate; every cut is checked against its number as it is made."""

from __future__ import annotations

import time
from typing import Any

from machines.driver import Faulted, MillState, ProgramDone
from machines.grbl.driver import GrblDriver
from machines.simulated import CutSegment, MemoryPort, Recording, SimulatedMill
from tests.trials import programs
from tests.trials.live import FAST


class CutCounter:
    """Holds every cut against the next one expected: lost, doubled and foreign ones are counted apart."""

    def __init__(self) -> None:
        self.next = 0
        self.lost = 0
        self.doubled = 0
        self.foreign = 0

    def __call__(self, cut: CutSegment) -> None:
        if cut.rapid or cut.kind != "program" or (self._at(cut, (0, 0, -1500)) and self.next == 0):
            return
        if self._at(cut, programs.point_um(self.next)):
            self.next += 1
            return
        for ahead in range(1, 50):
            if self._at(cut, programs.point_um(self.next + ahead)):
                self.lost += ahead
                self.next += ahead + 1
                return
        if any(self._at(cut, programs.point_um(self.next - back)) for back in range(1, min(50, self.next) + 1)):
            self.doubled += 1
        else:
            self.foreign += 1

    @staticmethod
    def _at(cut: CutSegment, point: tuple[int, int, int]) -> bool:
        return all(abs(cut.end[d] * 1000 - point[d]) < 0.6 for d in range(3))


def soak(
    count: int, *, line_bytes: int | None = None, report_every: int = 500_000, budget_s: float = 3600.0
) -> dict[str, Any]:
    """Stream `count` cuts in simulated time; the figures as a dict. Ends early, saying so, when `budget_s` is over."""
    counter = CutCounter()
    mill = SimulatedMill(FAST, recording=Recording(counter, keep=False))
    driver = GrblDriver(MemoryPort(mill, baud=115200))
    driver.connect()
    while driver.status.state is MillState.CONNECTING or not driver.status.controller:
        driver.poll(0.1)
    began_s, began_cpu_s, start_s = time.monotonic(), time.process_time(), mill.now_s
    sent_bytes = 0
    worst_in_flight = 0
    state = ""

    def counted() -> Any:
        nonlocal sent_bytes
        for line in programs.lines(count, line_bytes=line_bytes):
            if time.monotonic() - began_s > budget_s and line.text[:1] == b"X":
                continue
            sent_bytes += len(line.text) + 1
            yield line

    driver.start(counted())
    shown = 0
    while not state:
        for event in driver.poll(0.2):
            if isinstance(event, ProgramDone):
                state = "done"
            elif isinstance(event, Faulted):
                state = f"fault: {event.words}"
        worst_in_flight = max(worst_in_flight, driver.progress.bytes_in_flight)
        if counter.next - shown >= report_every:
            shown = counter.next
            print(
                f"  {shown} lines, {time.monotonic() - began_s:.0f} s, lost {counter.lost}, doubled {counter.doubled}",
                flush=True,
            )
    wall_s, cpu_s, simulated_s = time.monotonic() - began_s, time.process_time() - began_cpu_s, mill.now_s - start_s
    return {
        "ended": state,
        "cut": counter.next,
        "lost": counter.lost,
        "doubled": counter.doubled,
        "foreign": counter.foreign,
        "worst_in_flight_bytes": worst_in_flight,
        "wire_share": sent_bytes / simulated_s / 11520.0,
        "simulated_s": round(simulated_s, 1),
        "wall_s": round(wall_s, 1),
        "cpu_us_per_line_both_sides": round(cpu_s / max(counter.next, 1) * 1e6, 1),
    }
