"""One storm: real jobs, faults until the deck is used up, then calm, then the verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.trials.server.chaos import Chaos, deck
from tests.trials.server.customers import Customers, Order
from tests.trials.server.deployment import Deployment
from tests.trials.server.judge import Verdict, database_faults, half_objects, judged, left_over, tries_faults
from tests.trials.server.processes import of_kind, processes, touching, wait_until
from tests.trials.server.watching import Watching

_CALM_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """kinds: how many different things are asked for; `jobs` of them go round. patience_s: for the whole storm, and
    again for the calm after it.
    """

    jobs: int
    kinds: int
    kills: int
    freezes: int = 0
    restarts: int = 0
    pause_s: tuple[float, float] = (0.3, 2.5)
    freeze_s: float = 0.0
    patience_s: float = 600.0


@dataclass(slots=True)
class Result:
    """What was done, and every broken law as a line."""

    verdict: Verdict
    faults: dict[str, int]
    kills: int
    took_s: float
    restarts: int
    answers: dict[int, int]
    orphans: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    short: list[str] = field(default_factory=list)

    @property
    def broken(self) -> list[str]:
        v = self.verdict
        return [*v.lost, *v.doubled, *v.run_again, *v.half, *v.differing, *self.orphans, *self.left, *self.short]


def storm(
    deployment: Deployment,
    store: Path,
    size: Size,
    *,
    seed: int = 1,
    restart_database: Callable[[], None] | None = None,
    database_url: str | None = None,
    say: Callable[[str], None] = lambda _line: None,
) -> Result:
    """Run it over a deployment that is ready, and stop that at the end.

    database_url: where the jobs' tables are; None: the SQLite file of the only data folder
    """
    begun = time.monotonic()
    customers = Customers(deployment.url, [Order(kind=number % size.kinds) for number in range(size.jobs)])
    chaos = Chaos(
        deployment=deployment,
        seed=seed,
        cards=deck(size.kills, freezes=size.freezes, restarts=size.restarts),
        pause_s=size.pause_s,
        freeze_s=size.freeze_s,
        restart_database=restart_database,
        posting=lambda: customers.posting,
    )
    watching = Watching(deployment)
    for one in (customers, chaos, watching):
        one.begin()
    _let_it_rage(chaos, customers, size, say)
    result = Result(Verdict(), {}, 0, 0.0, 0, {})
    result.short = [*chaos.faults, *_missing(chaos)]
    _calm(deployment, customers, store, size, result)
    watching.stop()
    result.verdict.doubled += watching.doubled
    _stopped(deployment, store, database_url, result)
    result.faults, result.kills, result.answers = dict(chaos.done), chaos.killed, dict(customers.answers)
    result.took_s, result.restarts = time.monotonic() - begun, deployment.restarts
    return result


def _let_it_rage(chaos: Chaos, customers: Customers, size: Size, say: Callable[[str], None]) -> None:
    """Orders are released as the faults go on; when nothing is left to do and faults are, further orders come in."""
    give_up_s, told_s, extra = time.monotonic() + size.patience_s, 0.0, 0
    while not chaos.over and time.monotonic() < give_up_s:
        customers.release(2 + int(size.jobs * 1.1 * chaos.share))
        time.sleep(0.5)
        states = customers.states()
        ended = sum(state in ("succeeded", "failed", "cancelled") for state in states.values())
        if time.monotonic() - told_s > 15.0:
            told_s = time.monotonic()
            say(f"{chaos.killed} of {size.kills} kills, {ended} of {len(states)} jobs ended, {dict(chaos.done)}")
        if states and ended == len(states):
            if all(order.ids for order in customers.orders):
                extra += 1
                customers.add([Order(kind=size.kinds + extra), Order(kind=extra % size.kinds)])
            customers.release(len(states) + 2)
    chaos.stop()
    customers.release(len(customers.orders))
    customers.close()


def _missing(chaos: Chaos) -> list[str]:
    return [f"{len(chaos.cards)} faults were not done: {sorted(set(chaos.cards))}"] if chaos.cards else []


def _calm(deployment: Deployment, customers: Customers, store: Path, size: Size, result: Result) -> None:
    """No more faults: everything must come to its end while the server runs, and nothing of the work may be left."""
    if not wait_until(customers.all_ended, size.patience_s, every_s=0.5):
        result.verdict.lost.append(f"not all jobs ended within {size.patience_s:g} s of calm: {customers.states()}")
    verdict = judged(deployment.url, customers.orders, customers.states())
    verdict.lost += result.verdict.lost + customers.faults
    result.verdict = verdict
    wait_until(lambda: not of_kind(deployment.mark, "stage"), _CALM_S)
    result.orphans += [f"{process} after the last job" for process in of_kind(deployment.mark, "stage")]
    for kind, most in (
        ("api", 1),
        ("worker", len(deployment.data)),
        ("fork server", len(deployment.data)),
        ("picture", 1),
    ):
        if len(found := of_kind(deployment.mark, kind)) > most:
            result.orphans.append(f"{len(found)} processes of kind {kind}: {[process.pid for process in found]}")
    result.left += [f"with all jobs ended: {line}" for line in _files_left(deployment)]


def _stopped(deployment: Deployment, store: Path, database_url: str | None, result: Result) -> None:
    """Nobody is left after the stop; what is on the disk is looked at without any help of the server."""
    deployment.stop()
    wait_until(lambda: not processes(deployment.mark), _CALM_S)
    result.orphans += [f"left after the stop: {process}" for process in processes(deployment.mark)]
    result.orphans += [f"process {pid} uses the data after the stop" for pid in touching([*deployment.data, store])]
    result.verdict.half += half_objects(store)
    result.left += [f"after the stop: {line}" for line in _files_left(deployment)]
    file = deployment.data[0] / "causticmill.sqlite"
    result.verdict.run_again += tries_faults(database_url or f"sqlite:///{file}")
    if database_url is None:
        result.verdict.half += [
            line for path in (file, file.with_name("engine.sqlite")) for line in database_faults(path)
        ]


def _files_left(deployment: Deployment) -> list[str]:
    return [f"{data.name}/{name}" for data in deployment.data for name in left_over(data)]


def counted(faults: Mapping[Any, int]) -> str:
    return ", ".join(f"{count} x {kind}" for kind, count in sorted(faults.items()))
