"""kill -9 for real: the agent in a process of its own, a simulated mill on a real pty, a new agent on the same folder.

Each program is cut through one to three kills at random moments, some of them on the way back in. Between them the mill
cuts on with what it holds, as a real one does. What was cut is then held against the program.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from machines.journal.journal import read_journal
from machines.simulated import SimulatedMill
from machines.simulated.endpoints import serve_pty
from tests.benchmarks.timing import Figure
from tests.service.milling.agent.process import AgentProcess
from tests.service.mills import AT_ZERO
from tests.trials.judge import Verdict, judge
from tests.trials.programs import waves_mm

CUTS = 3000
_FACTOR = 10.0
_LASTS_S = 3.0  # what the cuts take at this factor, by the clock on the wall
_BACK = 1000  # segments: a mark a second of the clock is one every ten seconds of the mill, at 80 segments each
_PATIENCE_S = 60.0
_CHECKS = ["tool", "zero", "stock", "clear"]
_PREAMBLE = ("G21G90G94G17G54", "M3S12000", "G0Z5", "G0X1Y1", "G0Z1", "G1Z-1F1500")


@dataclass(slots=True)
class Trial:
    """One program.

    loss_s : age of the newest mark on disk, at each kill
    plan_s : from a new agent's start to the plan of the recovery, with the mill connected and at rest
    """

    seed: int
    loss_s: list[float] = field(default_factory=list)
    plan_s: list[float] = field(default_factory=list)
    verdict: Verdict | None = None
    faults: list[str] = field(default_factory=list)


def real_kills(count: int) -> Iterator[Figure]:
    """At least so many kills, as figures."""
    trials: list[Trial] = []
    while sum(len(trial.loss_s) for trial in trials) < count:
        trials.append(one_trial(len(trials)))
    loss_s = [value for trial in trials for value in trial.loss_s]
    plan_s = [value for trial in trials for value in trial.plan_s]
    verdicts = [trial.verdict for trial in trials if trial.verdict is not None]
    broken = [f"seed {trial.seed}: {trial.faults[0]}" for trial in trials if trial.faults]
    yield Figure(
        "real kills of the agent survived", len(loss_s), "kills",
        f"BROKEN: {broken[:3]}" if broken else f"{len(trials)} programs, 0 skipped, 0 foreign",
    )  # fmt: skip
    yield Figure(
        "real kills: most segments cut twice", max((v.recut for v in verdicts), default=0), "segments",
        f"all kills of a program; the mill runs {_FACTOR:g} times faster than the journal's clock",
    )  # fmt: skip
    yield _limited("real kills: most journal time lost", max(loss_s), 1.0)
    yield _limited("real kills: start of the new agent to a recovery plan, slowest", max(plan_s), 5.0)


def _limited(name: str, value_s: float, allowed_s: float) -> Figure:
    note = f"allowed {allowed_s:g} s"
    return Figure(name, value_s, "s", note if value_s <= allowed_s else f"BROKEN: {note}")


def one_trial(seed: int) -> Trial:
    """One program through its kills; everything random comes from the seed, the rest from the machine it runs on."""
    chance, trial, mill = random.Random(seed), Trial(seed), SimulatedMill(AT_ZERO)
    with tempfile.TemporaryDirectory() as made, serve_pty(mill, _FACTOR) as endpoint:
        folder = Path(made)
        program = folder / "program.nc"
        cuts = [f"X{x:.3f}Y{y:.3f}Z{z:.3f}" for x, y, z in waves_mm(CUTS)[1:]]
        program.write_text("\n".join([*_PREAMBLE, *cuts, "G0Z5", "M5", "M2"]) + "\n")
        run = ""
        try:
            for life in range(chance.choice((2, 2, 3, 4))):
                began_s = time.monotonic()
                with AgentProcess(folder / "data", endpoint.url) as agent:
                    run = _go_on(agent, trial, run, program, began_s)
                    if life == 0 or chance.random() < 0.7:
                        time.sleep(chance.uniform(0.0, 0.6) * _LASTS_S)
                    if _state(agent, run) not in ("running", "recovering"):
                        break
                    agent.process.kill()
                    killed_s = time.time()
                    agent.process.wait()
                    _note_loss(trial, folder / "data" / "runs" / run, killed_s)
                    time.sleep(chance.choice((0.0, 0.2, 1.0)))
            else:
                began_s = time.monotonic()
                with AgentProcess(folder / "data", endpoint.url) as agent:
                    _go_on(agent, trial, run, program, began_s)
                    if (state := _end_state(agent, run)) != "finished":
                        trial.faults.append(f"ended {state}: {agent.get(f'/v1/runs/{run}')['words']}")
        except (AssertionError, TimeoutError) as error:
            trial.faults.append(str(error)[:300])
    trial.verdict = judge(waves_mm(CUTS), mill.recording.cuts(), back=_BACK)
    if not trial.verdict.clean:
        foreign = [(cut.start, cut.end) for cut in trial.verdict.foreign[:2]]
        trial.faults.append(f"skipped {trial.verdict.skipped[:5]}, foreign {foreign}")
    return trial


def _go_on(agent: AgentProcess, trial: Trial, run: str, program: Path, began_s: float) -> str:
    """Start the program, or recover the run; its id."""
    _wait(agent, lambda: agent.status()["connected"])
    if not run:
        run = str(agent.post("/v1/runs", 201, program=agent.upload(program), name="trial")["id"])
        agent.post(f"/v1/runs/{run}:start", 202, operator="trial", checks=_CHECKS)
        return run
    if (state := _state(agent, run)) != "interrupted":
        raise AssertionError(f"after the kill the run is {state}, not interrupted")
    wanted: list[dict[str, Any]] = [{"code": "connect"}]
    while wanted and wanted[0]["code"] in ("connect", "wait", "stand still"):
        if time.monotonic() > began_s + _PATIENCE_S:
            raise TimeoutError(f"no plan: {wanted}")
        plan = agent.get(f"/v1/runs/{run}/recovery")
        if plan["refusals"]:
            raise AssertionError(f"refused: {plan['refusals']}")
        wanted = plan["needs"]
    trial.plan_s.append(time.monotonic() - began_s)
    for need in wanted:
        if need["code"] != "position":
            raise AssertionError(f"not expected: {need}")
        agent.post("/v1/control/trust-position", 202)
    agent.post(f"/v1/runs/{run}:recover", 202, operator="trial", checks=[*_CHECKS, "position"])
    return run


def _state(agent: AgentProcess, run: str) -> str:
    return str(agent.get(f"/v1/runs/{run}")["state"])


def _end_state(agent: AgentProcess, run: str) -> str:
    _wait(agent, lambda: _state(agent, run) not in ("running", "recovering"))
    return _state(agent, run)


def _wait(agent: AgentProcess, good: Any) -> None:
    give_up_s = time.monotonic() + _PATIENCE_S
    while not good():
        if time.monotonic() > give_up_s:
            raise TimeoutError(f"waited {_PATIENCE_S:g} s: {agent.status()['status']}")
        time.sleep(0.02)


def _note_loss(trial: Trial, folder: Path, killed_s: float) -> None:
    content = read_journal(folder)
    if content is None:
        trial.faults.append("the journal cannot be read")
        return
    trial.loss_s.append(killed_s - float(content.state["wall_s"]))


if __name__ == "__main__":
    for figure in real_kills(int(sys.argv[1]) if len(sys.argv) > 1 else 20):
        print(f"{figure.name}: {figure.value:.3f} {figure.unit} ({figure.note})")
