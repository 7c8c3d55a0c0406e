"""Looks at a deployment all the time: two living processes at one job at the same time are a fault."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from tests.trials.server.deployment import Deployment
from tests.trials.server.processes import of_kind

_LOOK_S = 0.15
# So many looks must agree: who was frozen may need a moment, when he goes on, to see that his job is another's.
_LOOKS = 5


@dataclass
class Watching:
    """`doubled`: a line for each pair that was seen."""

    deployment: Deployment
    doubled: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._stop = threading.Event()
        self._told: set[frozenset[int]] = set()
        self._thread = threading.Thread(target=self._look, name="watch", daemon=True)

    def begin(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _look(self) -> None:
        looks: list[dict[str, set[int]]] = []
        while not self._stop.wait(_LOOK_S):
            looks = [*looks[-_LOOKS + 1 :], at_work(self.deployment.mark)]
            if len(looks) == _LOOKS:
                self._judge(looks)

    def _judge(self, looks: list[dict[str, set[int]]]) -> None:
        for job in looks[0]:
            all_the_time = frozenset(set.intersection(*(look.get(job, set()) for look in looks)))
            if len(all_the_time) > 1 and all_the_time not in self._told:
                self._told.add(all_the_time)
                self.doubled.append(f"two processes at the same time at job {job}: {sorted(all_the_time)}")


def at_work(mark: str) -> dict[str, set[int]]:
    """Processes that work at each job now; who stands still does nothing."""
    found: dict[str, set[int]] = {}
    for process in of_kind(mark, "stage"):
        if process.job and not process.frozen:
            found.setdefault(process.job, set()).add(process.pid)
    return found
