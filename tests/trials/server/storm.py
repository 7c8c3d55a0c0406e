"""One storm: real jobs, faults until so many kills are done, then calm, then the verdict."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.trials.server.chaos import Chaos
from tests.trials.server.customers import Customers, Order
from tests.trials.server.deployment import Deployment
from tests.trials.server.judge import Verdict, half_objects, judged, left_over
from tests.trials.server.processes import of_kind, processes, touching, wait_until


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """kinds: how many different things are asked for; `jobs` of them go round."""

    jobs: int
    kinds: int
    kills: int
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
    orphans: list[str] = field(default_factory=list)

    @property
    def broken(self) -> list[str]:
        v = self.verdict
        return [*v.lost, *v.doubled, *v.run_again, *v.half, *self.orphans]


def storm(
    deployment: Deployment,
    store: Path,
    size: Size,
    *,
    seed: int = 1,
    restart_database: Callable[[], None] | None = None,
    say: Callable[[str], None] = lambda _line: None,
) -> Result:
    """Run it over a deployment that is ready, and stop that at the end."""
    begun = time.monotonic()
    orders = [Order(kind=number % size.kinds) for number in range(size.jobs)]
    chaos = Chaos(
        deployment=deployment,
        seed=seed,
        kills=size.kills,
        pause_s=size.pause_s,
        freeze_s=size.freeze_s,
        restart_database=restart_database,
    )
    customers = Customers(deployment.url, orders)
    customers.begin()
    chaos.begin()
    _let_it_rage(chaos, customers, orders, size, say)
    verdict, orphans = _calm(deployment, customers, orders, store, size)
    verdict.doubled += [f"at the same time: {line}" for line in chaos.doubled]
    return Result(
        verdict=verdict,
        faults=dict(chaos.done),
        kills=chaos.killed,
        took_s=time.monotonic() - begun,
        restarts=deployment.restarts,
        orphans=orphans,
    )


def _let_it_rage(
    chaos: Chaos, customers: Customers, orders: list[Order], size: Size, say: Callable[[str], None]
) -> None:
    """Until the kills are done. While some are left and nothing is left to do, further orders come in."""
    give_up_s, extra, told_s = time.monotonic() + size.patience_s, 0, 0.0
    while not chaos.over and time.monotonic() < give_up_s:
        time.sleep(0.5)
        states = customers.states()
        ended = sum(state in ("succeeded", "failed", "cancelled") for state in states.values())
        if time.monotonic() - told_s > 15.0:
            told_s = time.monotonic()
            say(f"{chaos.killed} of {size.kills} kills, {ended} of {len(states)} jobs ended, {dict(chaos.done)}")
        if states and ended >= len(states) - 1 and all(order.ids or order.refused for order in orders):
            extra += 1
            more = [Order(kind=size.kinds + extra), Order(kind=extra % size.kinds)]
            orders += more
            following = Customers(customers.url, more, threads=1)
            following.begin()
            following.join()
            customers.acked |= following.acked
    chaos.stop()
    customers.join()


def _calm(
    deployment: Deployment, customers: Customers, orders: list[Order], store: Path, size: Size
) -> tuple[Verdict, list[str]]:
    """No more faults: everything must come to its end, and then nobody may be left."""
    orphans: list[str] = []
    if not wait_until(customers.all_ended, size.patience_s, every_s=0.5):
        orphans.append("not all jobs had ended when patience did")
    verdict = judged(deployment.url, orders, customers.states())
    wait_until(lambda: not of_kind(deployment.mark, "stage"), 5.0)
    orphans += [f"stage {process} after the last job" for process in of_kind(deployment.mark, "stage")]
    for kind, most in (("api", 1), ("worker", len(deployment.data))):
        if len(found := of_kind(deployment.mark, kind)) > most:
            orphans.append(f"{len(found)} processes of kind {kind}")
    deployment.stop()
    with contextlib.suppress(AssertionError):
        wait_until(lambda: not processes(deployment.mark), 5.0)
    orphans += [f"left after the stop: {process}" for process in processes(deployment.mark)]
    orphans += [f"left after the stop: process {pid} uses the data" for pid in touching([*deployment.data, store])]
    verdict.half += half_objects(store)
    verdict.half += [f"left over in {data.name}: {name}" for data in deployment.data for name in left_over(data)]
    return verdict, orphans
