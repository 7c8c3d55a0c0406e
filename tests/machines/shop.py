"""A mill's owner with a parked run, on the bench of the kill trials, and a disk that can be full."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

from machines.driver import MillState
from machines.runs import RECOVER_CHECKS, START_CHECKS, Confirmation, RunState
from tests.machines.disks import FullDisk
from tests.trials.kill_bench import Bench
from tests.trials.kill_program import facts_of

YES = Confirmation("ann", START_CHECKS)
YES_ALL = Confirmation("ann", RECOVER_CHECKS)
LINES = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 Z5", "G0 X10 Y10", "G1 Z-1 F200"]
LINES += [f"X{10 + i / 2:g}Y{10 + i % 2}{'F600' if i == 1 else ''}" for i in range(1, 80)] + ["G0 Z5", "M5", "M2"]


class Shop:
    """A bench of the kill trials with a parked run."""

    def __init__(self, folder: Path, lines: list[str]) -> None:
        self.path = folder / "p.nc"
        self.path.write_text("\n".join(lines) + "\n")
        self.facts = facts_of(self.path)
        self.bench = Bench(folder / "mill", random.Random(1), homing=False, hal=False)
        self.disk = FullDisk()
        self.mill.close()
        self.bench.disk = self.disk
        self.bench.mill = self.bench.new_mill()
        self.bench.until_state(MillState.IDLE)
        self.id: str = self.mill.park(self.facts, self.path, "part").id

    @property
    def mill(self) -> Any:
        return self.bench.mill

    @property
    def state(self) -> RunState:
        return self.mill.run(self.id).state

    @property
    def cuts(self) -> int:
        return len(self.bench.sim.recording.cuts())

    def until(self, *states: RunState) -> None:
        self.bench.until(lambda: self.state in states)

    def pass_s(self, seconds: float) -> None:
        end_s = self.bench.sim.now_s + seconds
        while self.bench.sim.now_s < end_s:
            self.mill.step(0.1)

    def started(self, cuts: int = 5) -> Shop:
        self.mill.start(self.id, YES)
        self.bench.until(lambda: self.cuts >= cuts)
        return self

    def aborted(self) -> Shop:
        """The run, once it is aborted and the mill stands idle."""
        self.mill.abort()
        self.until(RunState.ABORTED)
        self.bench.until_state(MillState.IDLE)
        return self

    def held(self) -> Shop:
        self.mill.hold()
        self.until(RunState.HELD)
        return self

    def replace_owner(self, *states: MillState) -> None:
        """As `stream` does it: the process ends, another one opens the link, and waits for one of these states."""
        self.bench.kill(host_power=False)
        self.bench.mill = self.bench.new_mill()
        if states:
            self.bench.until_state(*states)

    @property
    def needs(self) -> list[str]:
        """Codes of what a recovery asks for."""
        return [need.code for need in self.mill.plan_recovery(self.id).needs]
