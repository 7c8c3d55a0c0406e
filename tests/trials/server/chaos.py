"""Faults at random moments: kill -9 of any process, frozen workers and hosts, database restarts.

What is to happen is a shuffled deck of cards, so that a storm holds enough of every kind. A card that finds no victim
now goes back into the deck.
"""

from __future__ import annotations

import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.trials.server.deployment import Deployment
from tests.trials.server.processes import Process, kill, of_kind, processes, wait_until

# Share of each kind among the kills. "api in a POST": the API while it answers somebody who submits.
SHARES = {"stage": 26, "worker": 24, "api in a POST": 14, "api": 8, "fork server": 11, "host": 9, "picture": 8}
# A job's stages are hit at most twice: the third crash of one stage is a failed job, by design. (Kills of its worker do
# not count.)
_HITS_PER_JOB = 2
_TICK_S = 0.1
_POST_S = 6.0  # patience for somebody who submits


def deck(kills: int, *, freezes: int = 0, restarts: int = 0) -> list[str]:
    """So many cards of each kind, in no order."""
    total = sum(SHARES.values())
    cards = [kind for kind, share in SHARES.items() for _ in range(round(kills * share / total))]
    cards += ["stage"] * (kills - len(cards))
    return [*cards[:kills], *["freeze"] * freezes, *["database restart"] * restarts]


@dataclass(slots=True)
class Thaw:
    """Processes that stand still, and when they shall go on."""

    at: float
    pids: list[int]
    what: str


@dataclass(kw_only=True)
class Chaos:
    """Runs in a thread of its own until the deck is used up or it is stopped.

    freeze_s         : how long a frozen worker or host stands still (SIGSTOP, SIGCONT)
    restart_database : what a card "database restart" calls
    posting          : is somebody being answered who submits?
    """

    deployment: Deployment
    seed: int
    cards: list[str]
    pause_s: tuple[float, float] = (0.3, 2.5)
    freeze_s: float = 0.0
    restart_database: Callable[[], None] | None = None
    posting: Callable[[], bool] = lambda: True
    done: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._chance = random.Random(self.seed)
        self._chance.shuffle(self.cards)
        self._dealt = len(self.cards)
        self._hits: Counter[str] = Counter()
        self._frozen: list[Thaw] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._guarded, name="chaos", daemon=True)

    @property
    def killed(self) -> int:
        return sum(count for kind, count in self.done.items() if kind in SHARES)

    @property
    def share(self) -> float:
        """How much of the deck is used up."""
        return 1 - len(self.cards) / max(1, self._dealt)

    @property
    def over(self) -> bool:
        return not self._thread.is_alive()

    def begin(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _guarded(self) -> None:
        """A trial whose faults have stopped by a fault of its own must not pass."""
        try:
            self._rage()
        except Exception as error:
            self.faults.append(f"the storm itself broke: {type(error).__name__}: {error}")
        finally:
            self._thaw(everything=True)

    def _rage(self) -> None:
        while (self.cards or self._frozen) and not self._stop.is_set():
            self._wait(self._chance.uniform(*self.pause_s))
            if not self.cards or self._stop.is_set():
                continue
            card = self.cards.pop()
            if not self._play(card):
                self.cards.insert(self._chance.randrange(len(self.cards) + 1), card)

    def _wait(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until and not self._stop.wait(_TICK_S):
            self._thaw()

    def _play(self, card: str) -> bool:
        """False: nobody was there to be hit."""
        if card == "freeze":
            return self._freeze()
        if card == "database restart":
            assert self.restart_database is not None
            self.restart_database()
            self.done[card] += 1
            return True
        return self._strike(card)

    def _strike(self, card: str) -> bool:
        if card == "api in a POST":
            if not wait_until(self.posting, _POST_S, every_s=0.002):
                return False
            time.sleep(self._chance.uniform(0.0, 0.04))
            if not self.posting():
                return False
        kind = "api" if card == "api in a POST" else card
        still = {pid for thaw in self._frozen for pid in thaw.pids}
        found = [p for p in of_kind(self.deployment.mark, kind) if p.pid not in still and self._may_hit(p)]
        if not found:
            return False
        victim = self._chance.choice(found)
        jobs = self._jobs_of(victim)
        if not kill([victim.pid]):
            return False
        self.done[card] += 1
        self._hits.update(jobs)
        return True

    def _may_hit(self, process: Process) -> bool:
        """A stage that has no job yet cannot be counted against its job."""
        if process.kind == "stage" and not process.job:
            return False
        return all(self._hits[job] < _HITS_PER_JOB for job in self._jobs_of(process))

    def _jobs_of(self, process: Process) -> list[str]:
        """The jobs that lose a try when this process is killed."""
        if process.kind == "stage":
            return [process.job]
        if process.kind == "fork server":
            return [stage.job for stage in of_kind(self.deployment.mark, "stage") if stage.parent == process.pid]
        return []

    def _freeze(self) -> bool:
        """A worker, a worker with all it started, or a whole host stands still for longer than a lease."""
        workers = of_kind(self.deployment.mark, "worker")
        if not workers or self._frozen:
            return False
        worker = self._chance.choice(workers)
        what = self._chance.choice(("worker", "worker and stages", "whole host"))
        family = [worker.pid]
        if what == "whole host":
            family += [p.pid for p in of_kind(self.deployment.mark, "host") if p.pid == worker.parent]
        pids = list(family) if what == "worker" else [p.pid for p in _kin(processes(self.deployment.mark), family)]
        if not kill([worker.pid], signal.SIGSTOP):
            return False
        kill((pid for pid in pids if pid != worker.pid), signal.SIGSTOP)
        self._frozen.append(Thaw(time.monotonic() + self.freeze_s, pids, what))
        self.done["freeze"] += 1
        return True

    def _thaw(self, *, everything: bool = False) -> None:
        for thaw in list(self._frozen):
            if everything or time.monotonic() > thaw.at:
                if kill(thaw.pids[:1], signal.SIGCONT):  # nobody had killed it meanwhile
                    self.done[f"thawed {thaw.what}"] += 1
                kill(thaw.pids[1:], signal.SIGCONT)
                self._frozen.remove(thaw)


def _kin(all_of_it: list[Process], family: list[int]) -> list[Process]:
    """These processes and everything they have started."""
    found: list[Process] = [p for p in all_of_it if p.pid in family]
    for process in found:
        found += [p for p in all_of_it if p.parent == process.pid and p not in found]
    return found
