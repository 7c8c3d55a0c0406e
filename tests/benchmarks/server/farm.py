"""Workers on PostgreSQL: how long until another takes over what a dead one had begun."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server.customer import LONG, SMALL, Customer
from tests.benchmarks.server.rows import spread
from tests.benchmarks.server.sizes import SHARE, TAKEOVERS
from tests.benchmarks.timing import Figure
from tests.service.server.worker.postgres import missing, running_postgres
from tests.trials.server.deployment import Deployment
from tests.trials.server.deployment import farm as started_farm
from tests.trials.server.processes import kill, of_kind, wait_until

LEASE_S = max(5.0, 30.0 * SHARE)


def figures() -> Iterator[Figure]:
    """Several workers are killed in the same farm, each while it runs a job; as many are left."""
    if reason := missing():
        print(f"  skipped: {reason}", flush=True)
        return
    environment = {"CAUSTICMILL_LEASE_S": str(LEASE_S)}
    with (
        tempfile.TemporaryDirectory() as folder,
        running_postgres(durable=True) as database,
        started_farm(
            Path(folder), database.url(), workers=2 * TAKEOVERS, api_works=False, environment=environment
        ) as deployment,
        Customer(deployment.url) as customer,
    ):
        customer.done(SMALL)
        took = _takeovers(deployment, customer)
    words = f"PostgreSQL, {TAKEOVERS} of {2 * TAKEOVERS} workers killed for good"
    yield from spread(f"takeover at lease {LEASE_S:g} s", took, unit="s", most=LEASE_S + 10.0, note=words)


def _takeovers(deployment: Deployment, customer: Customer) -> list[float]:
    killed: dict[str, tuple[float, set[int]]] = {}
    for number in range(TAKEOVERS):
        job_id = customer.submit(LONG, pixels=512, throw_mm=210 + number)
        assert wait_until(lambda job_id=job_id: _at_work(deployment, job_id), 60.0, every_s=0.01)
        old = _at_work(deployment, job_id)
        fork_server = next(p.parent for p in of_kind(deployment.mark, "stage") if p.pid in old)
        owner = next(p.parent for p in of_kind(deployment.mark, "fork server") if p.pid == fork_server)
        deployment.forsake(owner)
        kill([owner])
        killed[job_id] = (time.monotonic(), old)
    took: dict[str, float] = {}
    give_up_s = time.monotonic() + 3 * LEASE_S + 30.0
    while len(took) < len(killed):
        assert time.monotonic() < give_up_s, (took, killed)
        for job_id, (at, old) in killed.items():
            if job_id not in took and _at_work(deployment, job_id) - old:
                took[job_id] = time.monotonic() - at
                customer.cancel(job_id)
        time.sleep(0.02)
    return list(took.values())


def _at_work(deployment: Deployment, job_id: str) -> set[int]:
    return {process.pid for process in of_kind(deployment.mark, "stage") if process.job == job_id}
