"""Faults at random moments: kill -9 of any process, frozen workers, database restarts."""

from __future__ import annotations

import random
import signal
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.trials.server.deployment import Deployment
from tests.trials.server.processes import Process, kill, of_kind, processes

# How often each kind is the victim. A job's stages are hit at most twice: the third crash of one stage is a failed job,
# by design. (Kills of its worker do not count.)
WEIGHTS = {"api": 3, "worker": 3, "nursery": 2, "stage": 4, "host": 1, "picture": 1}
_HITS_PER_JOB = 2
_LOOK_S = 0.15


@dataclass(kw_only=True)
class Chaos:
    """Runs in a thread of its own until so many kills are done or it is stopped.

    freeze_s         : a worker is stopped for this long now and then (SIGSTOP, SIGCONT); 0: never
    restart_database : called now and then; None: never
    """

    deployment: Deployment
    seed: int
    kills: int
    pause_s: tuple[float, float] = (0.3, 2.5)
    freeze_s: float = 0.0
    restart_database: Callable[[], None] | None = None
    done: Counter[str] = field(default_factory=Counter)
    doubled: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._chance = random.Random(self.seed)
        self._hits: Counter[str] = Counter()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._rage, name="chaos", daemon=True)
        self._watch = threading.Thread(target=self._look, name="watch", daemon=True)

    @property
    def killed(self) -> int:
        return sum(count for kind, count in self.done.items() if kind in WEIGHTS)

    @property
    def over(self) -> bool:
        return not self._thread.is_alive()

    def begin(self) -> None:
        self._thread.start()
        self._watch.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self._watch.join()

    def _rage(self) -> None:
        while self.killed < self.kills and not self._stop.wait(self._chance.uniform(*self.pause_s)):
            draw = self._chance.random()
            if self.restart_database is not None and draw < 0.04:
                self.restart_database()
                self.done["database restart"] += 1
            elif self.freeze_s and draw < 0.08:
                self._freeze()
            else:
                self._strike()

    def _strike(self) -> None:
        found = [process for process in processes(self.deployment.mark) if self._may_hit(process)]
        kinds = sorted({process.kind for process in found})
        if not kinds:
            return
        kind = self._chance.choices(kinds, [WEIGHTS[kind] for kind in kinds])[0]
        victim = self._chance.choice([process for process in found if process.kind == kind])
        if kill([victim.pid]):
            self.done[kind] += 1
            self._hits.update(self._jobs_of(victim))

    def _may_hit(self, process: Process) -> bool:
        return process.kind in WEIGHTS and all(self._hits[job] < _HITS_PER_JOB for job in self._jobs_of(process))

    def _jobs_of(self, process: Process) -> list[str]:
        """The jobs that lose a try when this process is killed."""
        if process.kind == "stage":
            return [process.job]
        if process.kind == "nursery":
            return [stage.job for stage in of_kind(self.deployment.mark, "stage") if stage.parent == process.pid]
        return []

    def _freeze(self) -> None:
        """A worker, or its stage and nursery with it, stands still for longer than its lease."""
        workers = of_kind(self.deployment.mark, "worker")
        if not workers:
            return
        pids = [self._chance.choice(workers).pid]
        if self._chance.random() < 0.5:  # the whole host stands still
            pids += [p.pid for p in of_kind(self.deployment.mark, "nursery", "stage") if p.parent in pids]
        kill(pids, signal.SIGSTOP)
        self._stop.wait(self.freeze_s)
        kill(pids, signal.SIGCONT)
        self.done["freeze"] += 1

    def _look(self) -> None:
        """Two living processes at one job at the same time: seen, or not seen."""
        while not self._stop.wait(_LOOK_S):
            first = self._at_work()
            if any(len(pids) > 1 for pids in first.values()):
                second = self._at_work()  # one look is no moment: the first may have died before the second began
                both = {job: pids & second.get(job, set()) for job, pids in first.items()}
                self.doubled += [f"job {job}: {sorted(pids)}" for job, pids in both.items() if len(pids) > 1]

    def _at_work(self) -> dict[str, set[int]]:
        found: dict[str, set[int]] = {}
        for process in of_kind(self.deployment.mark, "stage"):
            if process.job:
                found.setdefault(process.job, set()).add(process.pid)
        return found
