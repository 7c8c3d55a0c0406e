"""Start, rest, and the way back after kill -9."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server.customer import LONG, SMALL, Customer
from tests.benchmarks.server.footprint import processor_share, pss_mb
from tests.benchmarks.server.rows import row, spread
from tests.benchmarks.server.sizes import IDLE_S, RESTARTS, STARTS
from tests.benchmarks.timing import Figure
from tests.trials.server.deployment import Deployment, embedded
from tests.trials.server.processes import kill, of_kind, processes, wait_until

_SETTLE_S = 5.0  # a child that has lived so long is started again at once
_EVERYTHING = ("host", "api", "worker", "fork server", "stage", "picture")


def starts() -> Iterator[Figure]:
    took = []
    for _ in range(STARTS):
        with tempfile.TemporaryDirectory() as folder:
            begun = time.monotonic()
            with embedded(Path(folder)):
                took.append(time.monotonic() - begun)
    yield from spread("cold `serve`, new folder, to ready", took, unit="s", most=5.0)


def idle(deployment: Deployment, when: str) -> Iterator[Figure]:
    share = processor_share(deployment, IDLE_S)
    kinds = sorted(process.kind for process in processes(deployment.mark))
    yield row(f"idle memory (PSS) {when}", pss_mb(deployment), "MB", n=1, most=250.0, note=", ".join(kinds))
    words = f"over {IDLE_S:g} s"
    yield row(f"idle processor share {when}", 100 * share, "% of a core", n=1, most=5.0, note=words)


def restarts(deployment: Deployment, customer: Customer) -> Iterator[Figure]:
    """kill -9 of the worker, and of everything, in the middle of a stage; until a stage runs again."""
    customer.done(SMALL)  # kernels are compiled
    for name, kinds in (("worker", ("worker",)), ("everything", _EVERYTHING)):
        took = [
            _restart(deployment, customer, kinds, throw_mm=120.0 + number + 50 * len(kinds))
            for number in range(RESTARTS)
        ]
        yield from spread(f"kill -9 of {name} to a stage running again", took, unit="s", most=3.0)


def _restart(deployment: Deployment, customer: Customer, kinds: tuple[str, ...], *, throw_mm: float) -> float:
    job_id = customer.submit(LONG, pixels=512, throw_mm=throw_mm)
    customer.until(job_id, "stage.started")
    assert wait_until(lambda: of_kind(deployment.mark, "stage"), 30.0, every_s=0.01)
    time.sleep(0.3)
    old = {process.pid for process in of_kind(deployment.mark, "stage")}
    begun = time.monotonic()
    kill(process.pid for process in of_kind(deployment.mark, *kinds))
    assert wait_until(lambda: _others(deployment, old), 60.0, every_s=0.01)
    took = time.monotonic() - begun
    assert wait_until(deployment.ready, 30.0)
    customer.cancel(job_id)
    customer.ended(job_id)
    if "host" not in kinds:
        time.sleep(_SETTLE_S)
    return took


def _others(deployment: Deployment, old: set[int]) -> bool:
    return any(process.pid not in old and process.job for process in of_kind(deployment.mark, "stage"))
