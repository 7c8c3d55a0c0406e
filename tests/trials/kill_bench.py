"""A bench for killing the owner of a mill: a disk that loses power, a simulated mill, an operator who does as told."""

from __future__ import annotations

import random
from pathlib import Path

from machines.driver import Home, MillState, Reset, TrustPosition
from machines.grbl.driver import GrblDriver
from machines.journal.disk import RealDisk, RealFile
from machines.journal.journal import Journal
from machines.mill.mill import Mill
from machines.recovery.plan_model import Reentry
from machines.simulated.endpoints import MemoryPort
from machines.simulated.mill import SimulatedMill
from machines.simulated.traits import GRBL_11, GRBLHAL
from tests.machines.disks import InlineSyncer


class LossyDisk(RealDisk):
    """Knows which bytes are safe. After `lose_power` only those are left, and a random, torn piece of the rest.

    The name of a file is safe once its folder was synced, whatever was synced of the file.
    """

    def __init__(self) -> None:
        self.safe: dict[Path, int] = {}
        self.unnamed: set[Path] = set()
        self.removed: dict[Path, bytes] = {}

    def create(self, path: Path) -> LossyFile:  # type: ignore[override]
        self.safe[path] = 0
        self.unnamed.add(path)
        return LossyFile(path, self)

    def remove(self, path: Path) -> None:
        self.removed[path] = path.read_bytes()[: max(0, self.safe.get(path, 1 << 60))]
        super().remove(path)

    def sync_folder(self, path: Path) -> None:
        for name in [name for name in self.removed if name.parent == path]:
            del self.removed[name]
        self.unnamed -= {name for name in self.unnamed if name.parent == path}
        super().sync_folder(path)

    def lose_power(self, chance: random.Random) -> None:
        for path, data in self.removed.items():
            if chance.random() < 0.5:
                path.write_bytes(data)
        for path, safe in self.safe.items():
            if not path.exists():
                continue
            data = path.read_bytes()
            if path in self.unnamed and chance.random() < 0.5:
                path.unlink()
                continue
            keep = chance.randint(safe, len(data))
            torn = bytes(chance.randrange(256) for _ in range(chance.choice((0, 0, 7, 300))))
            path.write_bytes(data[:keep] + torn)
        self.unnamed.clear()


class LossyFile(RealFile):
    def __init__(self, path: Path, disk: LossyDisk) -> None:
        super().__init__(path)
        self._path, self._disk, self._size = path, disk, 0

    def write(self, data: bytes) -> None:
        super().write(data)
        self._size += len(data)

    def sync(self) -> None:
        self._disk.safe[self._path] = self._size


class Bench:
    """A simulated mill, the owner's folder, and a Mill that can be killed and made anew."""

    def __init__(self, folder: Path, chance: random.Random, *, homing: bool, hal: bool) -> None:
        traits = GRBLHAL if hal else GRBL_11
        settings = {120: 3000, 121: 3000, 122: 3000} | ({22: 1, 27: 1.0} if homing else {})
        self.sim = SimulatedMill(traits.with_settings(settings), seed=chance.randrange(1 << 30))
        self.homing = homing
        self.folder = folder
        self.chance = chance
        self.disk = LossyDisk()
        self.mill = self.new_mill()

    def new_mill(self) -> Mill:
        def open_journal(folder: Path) -> Journal:
            return Journal(folder, disk=self.disk, syncer=InlineSyncer(lambda: self.sim.now_s), rotate_bytes=20_000)

        return Mill(
            name="sim",
            reentry=Reentry(safe_z_mm=5.0),
            connect=lambda: GrblDriver(MemoryPort(self.sim)),
            folder=self.folder,
            clock=lambda: self.sim.now_s,
            wall_clock=lambda: 1.8e9 + self.sim.now_s,
            open_journal=open_journal,
            pause=lambda seconds: self.sim.advance(self.sim.now_s + seconds),
            spindle_rpm=(1000.0, 24000.0),
        )

    def until(self, done: object, patience_s: float = 600.0) -> None:
        end_s = self.sim.now_s + patience_s
        while not done():  # type: ignore[operator]
            if self.sim.now_s > end_s:
                snapshot = self.mill.snapshot
                raise AssertionError(f"nothing comes of it: {snapshot.status}, {snapshot.run}, {snapshot.events[-5:]}")
            self.mill.step(0.1)

    def until_state(self, *states: MillState) -> None:
        self.until(lambda: self.mill.status.state in states)

    def command_done(self, command: object) -> None:
        seen = self.mill._log.count
        self.mill.command(command)  # type: ignore[arg-type]
        self.until(lambda: any(e.number > seen and e.kind == "command" for e in self.mill.snapshot.events))
        self.until_state(MillState.IDLE, MillState.ALARM)

    def clearing(self) -> bool:
        """After a fault the driver clears the buffers by itself; that is awaited."""
        return "buffers are cleared" in self.mill.status.detail

    def kill(self, *, host_power: bool) -> None:
        """The owner is gone between two instructions. Its locks go with it."""
        self.mill._runs._lock.release()
        if host_power:
            self.disk.lose_power(self.chance)

    def make_ready(self, run_id: str) -> tuple[str, ...]:
        """Do what the plan asks for, as an operator would; the codes of what was asked."""
        asked = []
        for _ in range(20):
            self.until(lambda: self.mill.status.state not in (
                MillState.CONNECTING, MillState.DISCONNECTED, MillState.RUN, MillState.HOLDING))  # fmt: skip
            plan = self.mill.plan_recovery(run_id)
            if plan.refusals:
                raise AssertionError(f"refused: {plan.refusals}")
            if not plan.needs:
                return tuple(asked)
            need = plan.needs[0]
            asked.append(need.code)
            if need.code in ("unlock", "position"):
                self.command_done(Home() if self.homing else TrustPosition())
            elif need.code == "stand still" and self.mill.status.state is MillState.HELD and not self.clearing():
                self.command_done(Reset())
            elif need.code in ("connect", "wait", "stand still"):
                self.mill.step(0.2)
            else:
                raise AssertionError(f"not expected: {need}")
        raise AssertionError(f"never ready: {asked}")
