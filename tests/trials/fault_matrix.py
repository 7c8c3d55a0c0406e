"""Every kind of fault at a hundred places of a program, and an operator who does what the recovery plan asks for."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from machines.driver import Home, Jog, MillState, SetZero
from machines.errors import MachineError, NotAllowedError
from machines.grbl.driver import GrblDriver
from machines.journal.journal import Journal
from machines.mill.mill import Mill
from machines.preflight.preflight import Preflight
from machines.profile import load_profile
from machines.recovery.plan_model import Reentry
from machines.runs import RECOVER_CHECKS, RECOVERABLE, START_CHECKS, Confirmation, RunState
from machines.simulated import GRBL_11, Faults, MemoryPort, SimulatedMill, Traits
from service.milling.preflight import run_preflight
from tests.trials.judge import Verdict, judge
from tests.trials.programs import waves_mm

CUTS = 400
FIRST_LINE = 7  # of the first cut in the program
_PREAMBLE = ("G21G90G94G17G54", "M3S12000", "G0Z5", "G0X1Y1", "G0Z1", "G1Z-1F600")
TRAITS = replace(GRBL_11.with_settings({22: 1, 20: 1}), lines_per_s=1000.0)
ANNA = "anna"
SILENT_KINDS = ("drop", "flip", "duplicate", "eeprom-stall")  # bytes to the mill: one number may become another


def write_program(path: Path) -> Path:
    cuts = [f"X{x:.3f}Y{y:.3f}Z{z:.3f}" for x, y, z in waves_mm(CUTS)[1:]]
    path.write_text("\n".join([*_PREAMBLE, *cuts, "G0Z5", "M5", "M2"]) + "\n")
    return path


class WatchedPort(MemoryPort):
    """Notes when a sign of trouble was read and when the hold after it was written."""

    signs = (b"error:", b"ALARM:", b"Grbl ")

    def __init__(self, mill: SimulatedMill, log: StopLog) -> None:
        super().__init__(mill)
        self._log = log
        self._tail = b""

    def read(self, timeout_s: float) -> bytes:
        data = super().read(timeout_s)
        self._tail = (self._tail + data)[-40:]
        if self._log.armed and self._log.sign_s is None and any(sign in self._tail for sign in self.signs):
            self._log.sign_s = self.clock()
        return data

    def write(self, data: bytes) -> None:
        if b"!" in data and self._log.armed:
            self._log.hold_s.append(self.clock())
        super().write(data)


@dataclass(slots=True)
class StopLog:
    armed: bool = False
    sign_s: float | None = None
    hold_s: list[float] = field(default_factory=list)

    @property
    def delay_s(self) -> float | None:
        """From the first sign to the first hold after it."""
        if self.sign_s is None:
            return None
        later = [s for s in self.hold_s if s >= self.sign_s - 1e-9]
        return later[0] - self.sign_s if later else None


@dataclass(slots=True)
class Trial:
    """What became of one fault."""

    kind: str
    seed: int
    ended: str
    verdict: Verdict
    causes: list[str]
    stop_delay_s: float | None
    recoveries: int
    done: bool  # the fault took place


def one_fault(kind: str, seed: int, facts: Preflight, program: Path, *, traits: Traits = TRAITS) -> Trial:
    """Run the program with one fault; recover as often as it takes, at most five times."""
    faults = Faults.by_seed(seed, kinds=(kind,), lines=(FIRST_LINE + 20, FIRST_LINE + CUTS - 20))
    mill = SimulatedMill(traits, seed=seed)
    log = StopLog()
    with tempfile.TemporaryDirectory() as folder:
        owner = _mill(mill, log, Path(folder))
        _until(owner, lambda: owner.status.state in (MillState.IDLE, MillState.ALARM), 30.0)
        _ready(owner)
        owner.command(Jog((-150.0, -150.0, -30.0), 1500.0))
        _until(owner, lambda: owner.status.state is MillState.JOG, 5.0)
        _until(owner, lambda: owner.status.state is MillState.IDLE, 60.0)
        _until(owner, lambda: False, 1.0)
        zero = mill.physical_mm
        owner.command(SetZero("XYZ"))
        _until(owner, lambda: owner.status.work_mm is not None and max(map(abs, owner.status.work_mm)) < 1e-3, 5.0)
        mill.arm(faults)
        log.armed = True
        run = owner.park(facts, program, "trial")
        owner.start(run.id, Confirmation(ANNA, START_CHECKS))
        causes = _operate(owner, mill, run.id)
        ended = owner.run(run.id)
        owner.close(detach=True)
    cuts = [
        cut._replace(start=_minus(cut.start, zero), end=_minus(cut.end, zero))
        for cut in mill.recording.segments
        if cut.kind in ("program", "slip")
    ]
    verdict = judge(waves_mm(CUTS), [cut for cut in cuts if not cut.rapid and min(cut.start[2], cut.end[2]) < 0.0][1:])
    return Trial(kind, seed, ended.state.value, verdict, causes, log.delay_s, ended.recoveries, bool(mill.faults.log))


def _mill(mill: SimulatedMill, log: StopLog, folder: Path) -> Mill:
    def pause(seconds: float) -> None:
        mill.advance(mill.now_s + seconds)

    return Mill(
        name="trial",
        reentry=Reentry(safe_z_mm=5.0),
        connect=lambda: GrblDriver(WatchedPort(mill, log)),
        folder=folder,
        clock=lambda: mill.now_s,
        wall_clock=lambda: mill.now_s,
        open_journal=Journal,
        pause=pause,
    )


def _ready(owner: Mill) -> None:
    """Home, if the mill is locked or its position is not to be trusted."""
    owner.command(Home())
    _until(owner, lambda: owner.status.state is MillState.HOMING, 5.0)
    _until(owner, lambda: owner.status.state is MillState.IDLE, 120.0)


def _operate(owner: Mill, mill: SimulatedMill, run_id: str) -> list[str]:
    """What a person at the mill does: resume a hold they pressed, close the door, else follow the recovery plan."""
    causes: list[str] = []
    for _ in range(6):
        _until(owner, lambda: owner.run(run_id).state in (*RECOVERABLE, RunState.FINISHED, RunState.HELD), 4000.0)
        state = owner.run(run_id).state
        if state is RunState.FINISHED:
            break
        causes.append(owner.run(run_id).words)
        if state is RunState.HELD:
            _until(owner, lambda: False, 5.0)
            owner.resume()
            _until(owner, lambda: owner.run(run_id).state is not RunState.HELD, 10.0)
            continue
        _recover(owner, mill, run_id)
    return causes


def _recover(owner: Mill, mill: SimulatedMill, run_id: str) -> None:
    _until(owner, lambda: owner.status.state not in (MillState.DISCONNECTED, MillState.CONNECTING, MillState.RUN), 60.0)
    for _ in range(8):
        plan = owner.plan_recovery(run_id)
        codes = {need.code for need in plan.needs}
        if plan.ready:
            owner.recover(run_id, Confirmation(ANNA, RECOVER_CHECKS))
            return
        if codes & {"wait", "stand still"}:
            owner.abort()
        elif "connect" in codes:
            pass
        elif codes & {"unlock", "position"}:
            with contextlib.suppress(NotAllowedError):  # still clearing the old stream: the operator tries again
                _ready(owner)
        else:
            raise MachineError(f"nothing an operator could do: {plan.words}")
        _until(owner, lambda: False, 2.0)
    raise MachineError(f"the plan never became ready: {plan.words}")


def _until(owner: Mill, is_so: Callable[[], bool], timeout_s: float) -> None:
    end_s = owner._cycle.context.clock() + timeout_s
    while owner._cycle.context.clock() < end_s and not is_so():
        owner.step(0.05)


def _minus(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def matrix(kinds: tuple[str, ...], seeds: range, *, traits: Traits = TRAITS) -> Iterator[Trial]:
    with tempfile.TemporaryDirectory() as folder:
        program = write_program(Path(folder) / "trial.nc")
        facts = run_preflight(program, load_profile("grbl"), cache=Path(folder) / "cache")
        for kind in kinds:
            for seed in seeds:
                yield one_fault(kind, seed, facts, program, traits=traits)
