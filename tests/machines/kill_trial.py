"""Kills the owner of a mill at a random moment, lets the mill go on with what it holds, and recovers. By seed.

    one_kill(seed) -> Trial     (for 1000 of them: python tests/machines/kill_trial.py 1000)

"Killed" means: the Mill object is dropped without a word. What was written to the journal is there, or, where the
host lost power, only what was synced and some torn bytes of the rest.
"""

from __future__ import annotations

import hashlib
import random
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from machines.driver import Home, MillState, Reset, SetZero, TrustPosition
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.preflight import Bounds, Preflight
from machines.gcode.program import IndexEntry, ProgramIndex, piece_digest
from machines.grbl.driver import GrblDriver
from machines.journal import Journal
from machines.journal_disk import InlineSyncer, RealDisk, RealFile
from machines.mill import Mill
from machines.runs import RECOVER_CHECKS, START_CHECKS, Confirmation, RunState
from machines.simulated.memory_port import MemoryPort
from machines.simulated.mill import SimulatedMill
from machines.simulated.recording import CutSegment
from machines.simulated.traits import GRBL_11, GRBLHAL

Point = tuple[float, float, float]
START = Confirmation("ann", START_CHECKS)
RECOVER = Confirmation("ben", RECOVER_CHECKS)
NEAR_MM = 0.005


class LossyDisk(RealDisk):
    """Knows which bytes are safe. After `lose_power` only those are left, and a random, torn piece of the rest."""

    def __init__(self) -> None:
        self.safe: dict[Path, int] = {}
        self.removed: dict[Path, bytes] = {}

    def create(self, path: Path) -> LossyFile:  # type: ignore[override]
        self.safe[path] = -1  # not even its name is safe
        return LossyFile(path, self)

    def remove(self, path: Path) -> None:
        self.removed[path] = path.read_bytes()[: max(0, self.safe.get(path, 1 << 60))]
        super().remove(path)

    def sync_folder(self, path: Path) -> None:
        for name in [name for name in self.removed if name.parent == path]:
            del self.removed[name]
        super().sync_folder(path)

    def lose_power(self, chance: random.Random) -> None:
        for path, data in self.removed.items():
            if chance.random() < 0.5:
                path.write_bytes(data)
        for path, safe in self.safe.items():
            if not path.exists():
                continue
            data = path.read_bytes()
            if safe < 0 and chance.random() < 0.5:
                path.unlink()
                continue
            keep = chance.randint(max(0, safe), len(data))
            torn = bytes(chance.randrange(256) for _ in range(chance.choice((0, 0, 7, 300))))
            path.write_bytes(data[:keep] + torn)


class LossyFile(RealFile):
    def __init__(self, path: Path, disk: LossyDisk) -> None:
        super().__init__(path)
        self._path, self._disk, self._size = path, disk, 0

    def write(self, data: bytes) -> None:
        super().write(data)
        self._size += len(data)

    def sync(self) -> None:
        self._disk.safe[self._path] = self._size


@dataclass
class Trial:
    """What came out. `faults` is empty if every segment was cut, in order, and nothing else."""

    seed: int
    kills: int
    segments: int
    recut: int = 0
    cut_after_death: int = 0
    journal_loss_s: float = 0.0
    interruptions: list[str] = field(default_factory=list)  # found by the driver itself, not by us
    faults: list[str] = field(default_factory=list)


def facts_of(path: Path, every_lines: int = 50) -> Preflight:
    """Pre-flight's result for a small program, by the slow and simple way."""
    data = path.read_bytes()
    lines = data.split(b"\n")[:-1]
    interpreter, entries, offset = Interpreter(ModalState()), [], 0
    starts: list[tuple[int, int, ModalState]] = []
    points: list[Point] = []
    for number, text in enumerate(lines, 1):
        if (number - 1) % every_lines == 0:
            starts.append((number, offset, interpreter.state))
        step = interpreter.take(text)
        if None not in step.end_mm:
            points.append(step.end_mm)  # type: ignore[arg-type]
        offset += len(text) + 1
    for one, (number, at, state) in enumerate(starts):
        end = starts[one + 1][1] if one + 1 < len(starts) else len(data)
        entries.append(IndexEntry(number, at, piece_digest(data[at:end]), state))
    least, most = tuple(map(min, zip(*points, strict=True))), tuple(map(max, zip(*points, strict=True)))
    return Preflight(
        sha256=hashlib.sha256(data).hexdigest(),
        bytes=len(data),
        lines=len(lines),
        blocks=len(lines),
        dialect="grbl",
        profile="grbl",
        bounds_mm=Bounds(least, most),  # type: ignore[arg-type]
        feeds_mm_per_min=(200.0, 1500.0),
        spindle_rpm=(12000.0, 12000.0),
        path_length_mm=1.0,
        time_s=60.0,
        ends=True,
        index=ProgramIndex(every_lines=every_lines, entries=tuple(entries), lines=len(lines), bytes=len(data)),
    )


def made_program(chance: random.Random, path: Path, segments: int) -> list[tuple[Point, Point]]:
    """A wandering cut without a point visited twice; the segments it consists of, in order."""
    x, y, z = 10.0, 10.0, -1.0
    lines = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 Z5", f"G0 X{x:g} Y{y:g}", f"G1 Z{z:g} F200"]
    cuts = [((x, y, 5.0), (x, y, z))]
    feed = "F1500"
    for number in range(segments):
        if number == segments // 2 and chance.random() < 0.5:
            lines += ["G0 Z5", f"G0 X{x + 1:g}", f"G1 Z{z:g} F200"]
            x = round(x + 1, 4)
            cuts.append(((x, y, 5.0), (x, y, z)))
            feed = "F1500"
        new = (
            round(x + chance.uniform(0.05, 0.4), 3),
            round(y + chance.uniform(-1, 1), 3),
            -round(chance.uniform(1, 2), 4),
        )
        if chance.random() < 0.05:  # a half circle
            new = (new[0], y, z)
            lines.append(f"G2X{new[0]:g}Y{new[1]:g}I{(new[0] - x) / 2:.4f}J0{feed}")
            feed = ""
            lines.append(f"G1X{new[0]:g}Y{new[1]:g}Z{new[2] - 0.1:.4f}")
            cuts.append(((x, y, z), new))
            cuts.append((new, (new[0], new[1], round(new[2] - 0.1, 4))))
            x, y, z = new[0], new[1], round(new[2] - 0.1, 4)
            continue
        word = "G1" if chance.random() < 0.1 else ""
        lines.append(f"{word}X{new[0]:g}Y{new[1]:g}Z{new[2]:g}{feed}")
        feed = ""
        cuts.append(((x, y, z), new))
        x, y, z = new
    lines += ["G0 Z5", "M5", "M2"]
    path.write_bytes("\n".join(lines).encode() + b"\n")
    return cuts


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
            connect=lambda: GrblDriver(MemoryPort(self.sim)),
            folder=self.folder,
            clock=lambda: self.sim.now_s,
            wall_clock=lambda: 1.8e9 + self.sim.now_s,
            open_journal=open_journal,
            pause=lambda seconds: self.sim.advance(self.sim.now_s + seconds),
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
        seen = self.mill._logged
        self.mill.command(command)  # type: ignore[arg-type]
        name = type(command).__name__
        self.until(lambda: any(e.number > seen and e.kind == "command" and e.words.startswith(name)
                               for e in self.mill.snapshot.events))  # fmt: skip
        self.until_state(MillState.IDLE, MillState.ALARM)

    def clearing(self) -> bool:
        """After a fault the driver clears the buffers by itself; that is awaited."""
        return "buffers are cleared" in self.mill.status.detail

    def kill(self, *, host_power: bool) -> None:
        """The owner is gone between two instructions. Its locks go with it."""
        self.mill._lock.release()
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
            elif need.code in ("connect", "stand still"):
                self.mill.step(0.2)
            else:
                raise AssertionError(f"not expected: {need}")
        raise AssertionError(f"never ready: {asked}")


def one_kill(seed: int, folder: Path | None = None, segments: int = 150) -> Trial:
    """One trial in simulated time: everything random comes from the seed."""
    if folder is None:
        with tempfile.TemporaryDirectory() as made:
            return one_kill(seed, Path(made), segments)
    chance = random.Random(seed)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "program.nc"
    cuts = made_program(chance, path, segments)
    facts = facts_of(path)
    homing = chance.random() < 0.5
    bench = Bench(folder / "mill", chance, homing=homing, hal=chance.random() < 0.3)
    trial = Trial(seed, 0, len(cuts))
    bench.until_state(MillState.IDLE, MillState.ALARM)
    if homing:
        bench.command_done(Home())
        bench.mill.command(SetZero("XYZ"))
        bench.until(lambda: "SetZero: done" in [e.words for e in bench.mill.snapshot.events])
        bench.until_state(MillState.IDLE)
    origin = bench.sim.physical_mm
    run_id = bench.mill.park(facts, path, "trial").id
    bench.mill.start(run_id, START)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        dies_s = bench.sim.now_s + chance.uniform(0.0, 12.0)
        while bench.sim.now_s < dies_s and bench.mill.run(run_id).live:
            if chance.random() < 0.002:
                bench.mill.hold()
                if chance.random() < 0.7:
                    bench.until(lambda: bench.mill.run(run_id).state is not RunState.HOLDING)
                    if bench.mill.run(run_id).state is RunState.HELD:
                        bench.mill.resume()
            bench.mill.step(0.1)
        if bench.mill.run(run_id).state in (RunState.FINISHED, RunState.INTERRUPTED):
            break
        known = bench.mill._runs[run_id].executed_line
        died_s = bench.sim.now_s if bench.mill.run(run_id).state is RunState.RUNNING else None
        host_power = chance.random() < 0.5
        bench.kill(host_power=host_power)
        trial.kills += 1
        before = len(bench.sim.recording.cuts())
        bench.sim.advance(bench.sim.now_s + chance.choice((0.0, 0.05, 1.0, 30.0)))
        if homing and chance.random() < 0.4:
            bench.sim.power_cycle()
        trial.cut_after_death = max(trial.cut_after_death, len(bench.sim.recording.cuts()) - before)
        bench.mill = bench.new_mill()
        view = bench.mill.run(run_id)
        if view.state is not RunState.INTERRUPTED:
            trial.faults.append(f"found as {view.state.value}")
        if died_s is not None:
            written_s = bench.mill._runs[run_id].record["wall_s"] - 1.8e9
            trial.journal_loss_s = max(trial.journal_loss_s, died_s - written_s)
        if view.executed_line > known:
            trial.faults.append(f"the journal says {view.executed_line} executed, its writer knew of {known}")
        bench.make_ready(run_id)
        bench.mill.recover(run_id, RECOVER)
    for _ in range(4):  # a fault on the way is recovered as well
        bench.until(lambda: bench.mill.run(run_id).state not in (RunState.RUNNING, RunState.RECOVERING))
        if bench.mill.run(run_id).state is not RunState.INTERRUPTED:
            break
        trial.interruptions.append(bench.mill.run(run_id).words)
        bench.make_ready(run_id)
        bench.mill.recover(run_id, RECOVER)
    view = bench.mill.run(run_id)
    if view.state is not RunState.FINISHED:
        trial.faults.append(f"ended as {view.state.value}: {view.words}")
    bench.mill.close()
    _compare(trial, cuts, bench.sim.recording.cuts(), origin)
    return trial


def _near(a: Point, b: Point) -> bool:
    return all(abs(p - q) <= NEAR_MM for p, q in zip(a, b, strict=True))


def _on_half_circle(point: Point, start: Point, end: Point) -> bool:
    """Chords of the half circles of made_program end on them."""
    if start[1] != end[1] or start[2] != end[2]:
        return False
    middle, radius = (start[0] + end[0]) / 2, (end[0] - start[0]) / 2
    away = ((point[0] - middle) ** 2 + (point[1] - start[1]) ** 2) ** 0.5
    return abs(away - radius) < NEAR_MM and abs(point[2] - start[2]) < NEAR_MM and point[1] > start[1] - NEAR_MM


def _compare(trial: Trial, cuts: list[tuple[Point, Point]], done: list[CutSegment], origin: Point) -> None:
    """Every programmed segment whole at least once; within a pass in order without a gap; nothing foreign."""

    def at(point: Point) -> Point:
        return (point[0] - origin[0], point[1] - origin[1], point[2] - origin[2])

    ends = {(round(e[0], 2), round(e[1], 2), round(e[2], 2)): i for i, (_, e) in enumerate(cuts)}

    def index_of(point: Point) -> int | None:
        for dx in (0, 0.01, -0.01):
            for dy in (0, 0.01, -0.01):
                for dz in (0, 0.01, -0.01):
                    i = ends.get((round(point[0] + dx, 2), round(point[1] + dy, 2), round(point[2] + dz, 2)))
                    if i is not None and _near(point, cuts[i][1]):
                        return i
        return None

    seen: set[int] = set()
    last = -1
    begun: tuple[Point, Point] | None = None  # start and end of a cut that a hold has stopped
    for segment in done:
        start, end = at(segment.start), at(segment.end)
        if begun is not None and _near(begun[1], start):
            start = begun[0]
        begun = None if segment.whole else (start, end)
        if not segment.whole:
            continue
        index = index_of(end)
        if index is None:
            if not any(_near(end, cut[0]) or _on_half_circle(end, *cut) for cut in cuts):
                trial.faults.append(f"foreign cut {start} -> {end}")
            continue
        vertical = abs(start[0] - end[0]) < NEAR_MM and abs(start[1] - end[1]) < NEAR_MM
        if vertical and not _near(start, cuts[index][0]) and start[2] > end[2]:
            last = index  # the way back in ends where this segment ended
            continue
        if index in seen:
            trial.recut += 1
        if index > last + 1:
            trial.faults.append(f"segments {last + 1}..{index - 1} passed over before {index}")
        seen.add(index)
        last = index
    missing = sorted(set(range(len(cuts))) - seen)
    if missing:
        trial.faults.append(f"never cut: {missing[:10]}")


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    trials = []
    for one in range(count):
        try:
            trials.append(one_kill(one))
        except Exception as error:
            trials.append(Trial(one, 0, 0, faults=[f"{type(error).__name__}: {error}"]))
    bad = [trial for trial in trials if trial.faults]
    print(f"{len(trials)} trials, {sum(t.kills for t in trials)} kills, most recut in one trial "
          f"{max(t.recut for t in trials)}, journal loss at most "
          f"{max(t.journal_loss_s for t in trials):.2f} s, most cut "
        f"after a kill {max(t.cut_after_death for t in trials)}, "
          f"{sum(len(t.interruptions) for t in trials)} interruptions beside them, {len(bad)} bad")  # fmt: skip
    for trial in bad[:20]:
        print(trial.seed, trial.faults[:3])
