"""Start, rest, and the way back after kill -9."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server.customer import LONG, SMALL, Customer, spread
from tests.benchmarks.server.footprint import processor_share, pss_mb
from tests.benchmarks.timing import Figure
from tests.trials.server.deployment import Deployment, embedded
from tests.trials.server.processes import kill, of_kind, processes, wait_until

_STARTS = 5
_RESTARTS = 5
_IDLE_S = 30.0


def figures() -> Iterator[Figure]:
    starts = []
    for _ in range(_STARTS):
        with tempfile.TemporaryDirectory() as folder:
            begun = time.monotonic()
            with embedded(Path(folder)):
                starts.append(time.monotonic() - begun)
    yield Figure("server: cold `serve` to ready, slowest", max(starts), "s", f"n={_STARTS}, new folder, budget 5 s")
    with tempfile.TemporaryDirectory() as folder, embedded(Path(folder)) as deployment:
        yield from _idle(deployment)
        with Customer(deployment.url) as customer:
            yield from _restarts(deployment, customer)


def _idle(deployment: Deployment) -> Iterator[Figure]:
    time.sleep(5.0)
    share = processor_share(deployment, _IDLE_S)
    count = len(processes(deployment.mark))
    yield Figure("server: idle memory (PSS)", pss_mb(deployment), "MB", f"{count} processes, budget 250 MB")
    yield Figure("server: idle processor share", 100 * share, "% of a core", f"over {_IDLE_S:g} s, budget 5 %")


def _restarts(deployment: Deployment, customer: Customer) -> Iterator[Figure]:
    """kill -9 of the worker, and of everything, in the middle of a stage; until a stage runs again."""
    customer.ended(customer.submit(SMALL))  # kernels are compiled
    for name, kinds in (("worker", ("worker",)), ("everything", ("host", "api", "worker", "nursery", "stage"))):
        times = []
        for number in range(_RESTARTS):
            job_id = customer.submit(LONG, pixels=512, throw_mm=120 + number + 50 * len(kinds))
            wait_until(lambda: of_kind(deployment.mark, "stage"), 60.0, every_s=0.01)
            old = {process.pid for process in of_kind(deployment.mark, "stage")}
            begun = time.monotonic()
            kill(process.pid for process in of_kind(deployment.mark, *kinds))
            assert wait_until(lambda old=old: _others(deployment, old), 60.0, every_s=0.01)
            times.append(time.monotonic() - begun)
            wait_until(deployment.ready, 30.0)
            customer.cancel(job_id)
            customer.ended(job_id)
            time.sleep(5.5)  # a child that lives well is started again at once
        yield from spread(f"server: kill -9 of {name} to a stage running again", times, unit="s", note="budget 3 s")


def _others(deployment: Deployment, old: set[int]) -> bool:
    return any(process.pid not in old for process in of_kind(deployment.mark, "stage"))
