"""Kills the owner of a mill at a random moment, lets the mill go on with what it holds, and recovers. By seed.

    one_kill(seed) -> Trial     (for 1000 of them: python -m tests.trials.kill_trial 1000)

"Killed" means: the Mill object is dropped without a word. What was written to the journal is there, or, where the
host lost power, only what was synced and some torn bytes of the rest.
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

from machines.driver import Home, Jog, MillState, SetZero
from machines.runs import RECOVER_CHECKS, START_CHECKS, Confirmation, RunState
from tests.trials.kill_bench import Bench, LossyDisk
from tests.trials.kill_judge import Trial, compare
from tests.trials.kill_program import facts_of, made_program

__all__ = ["Bench", "LossyDisk", "Trial", "facts_of", "made_program", "one_kill"]

START = Confirmation("ann", START_CHECKS)
RECOVER = Confirmation("ben", RECOVER_CHECKS)


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
        bench.command_done(Jog((-120.0, -120.0, -40.0), 5000.0))
        bench.command_done(SetZero("XYZ"))
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
        known = bench.mill._runs.get(run_id).executed_line
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
            written_s = bench.mill._runs.get(run_id).record["wall_s"] - 1.8e9
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
    compare(trial, cuts, bench.sim.recording.cuts(), origin)
    return trial


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
