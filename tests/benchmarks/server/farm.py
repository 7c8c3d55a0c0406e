"""Two workers on PostgreSQL: how long until another takes over what a dead one had begun."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server.customer import LONG, SMALL, Customer, spread
from tests.benchmarks.timing import Figure
from tests.service.worker.postgres import running_postgres
from tests.trials.server.deployment import Deployment
from tests.trials.server.deployment import farm as started_farm
from tests.trials.server.processes import kill, of_kind, wait_until

_LEASE_S = 30.0
_TIMES = 3


def figures() -> Iterator[Figure]:
    took = []
    with running_postgres(durable=True) as database:
        for number in range(_TIMES):
            with tempfile.TemporaryDirectory() as folder:
                environment = {"CAUSTICMILL_LEASE_S": str(_LEASE_S)}
                with started_farm(Path(folder), database.url(), api_works=False, environment=environment) as deployment:
                    took.append(_takeover(deployment, number))
    yield from spread(f"server: takeover at lease {_LEASE_S:g} s", took, unit="s", note="two workers, budget 40 s")


def _takeover(deployment: Deployment, number: int) -> float:
    """The worker that runs the job is killed with its host and does not come back."""
    with Customer(deployment.url) as customer:
        customer.ended(customer.submit(SMALL, throw_mm=200 + number))
        customer.submit(LONG, pixels=512, throw_mm=210 + number)
        assert wait_until(lambda: of_kind(deployment.mark, "stage"), 60.0, every_s=0.01)
        nurseries = {process.pid: process.parent for process in of_kind(deployment.mark, "nursery")}
        stages = of_kind(deployment.mark, "stage")
        owner = nurseries[stages[0].parent]
        old = {process.pid for process in stages}
        deployment.forsake(owner)
        begun = time.monotonic()
        kill([owner])
        assert wait_until(lambda: any(p.pid not in old for p in of_kind(deployment.mark, "stage")), 90.0, every_s=0.02)
        return time.monotonic() - begun
