"""Submit, start, cancel."""

from __future__ import annotations

import os
import random
import sqlite3
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server.customer import LONG, SMALL, Customer
from tests.benchmarks.server.rows import row, spread
from tests.benchmarks.server.sizes import CANCELS, JOBS, SUBMITS
from tests.benchmarks.timing import Figure
from tests.trials.server.deployment import Deployment
from tests.trials.server.pictures import picture
from tests.trials.server.processes import of_kind, wait_until

_PAUSE_S = 0.03
_LONGEST_S = 1.5  # a stage runs so long, or less, before it is cancelled


def overhead(customer: Customer) -> Iterator[Figure]:
    """What a job takes beyond the work of its stages, per stage."""
    rest = []
    for number in range(JOBS):
        job = customer.done(SMALL, throw_mm=60 + number)
        events = list(customer.events(job["id"]))
        at = {said.kind: said.at for said in events if said.kind in ("started", "ended")}
        work_s = sum(said.data["seconds"] for said in events if said.kind == "stage.committed")
        rest.append((at["ended"] - at["started"] - work_s) / len(job["stages"]))
    yield row("engine overhead per stage, most", max(rest), "s", n=len(rest), most=1.5)


def cancels(deployment: Deployment, customer: Customer) -> Iterator[Figure]:
    """Each job is new; the time to its first stage, and from its cancel to the last process gone."""
    waited, gone, chance = [], [], random.Random(1)
    customer.done(SMALL)
    for number in range(CANCELS):
        job_id = customer.submit(LONG, pixels=512, throw_mm=130 + number)
        at = customer.until(job_id, "stage.started")
        waited.append(at["stage.started"] - at["queued"])
        assert wait_until(lambda: of_kind(deployment.mark, "stage"), 30.0, every_s=0.005)
        time.sleep(chance.uniform(0.0, _LONGEST_S))
        begun = time.monotonic()
        customer.cancel(job_id)
        assert wait_until(lambda: not of_kind(deployment.mark, "stage"), 30.0, every_s=0.005)
        gone.append(time.monotonic() - begun)
        customer.ended(job_id)
    yield from spread("enqueue to stage running, warm", waited, most=500.0)
    yield from spread("cancel to last process gone", gone, unit="s", most=2.0)


def submits(customer: Customer) -> Iterator[Figure]:
    """An answer tells of a job that is durable. The jobs ask for what is there already, so they cost little."""
    customer.done(SMALL)
    took = []
    for _ in range(SUBMITS):
        begun = time.perf_counter()
        customer.submit(SMALL)
        took.append(time.perf_counter() - begun)
        time.sleep(_PAUSE_S)
    yield from spread("submit to durable answer", took, most=50.0, note="while the worker works the jobs off")
    yield from _peers(len(took))


def _peers(n: int) -> Iterator[Figure]:
    """What a durable answer costs here at the least: a synced file, a synced transaction."""
    with tempfile.TemporaryDirectory() as folder:
        took = []
        for number in range(n):
            begun = time.perf_counter()
            with (Path(folder) / str(number)).open("wb", buffering=0) as file:
                file.write(picture(0))
                os.fsync(file.fileno())
            took.append(time.perf_counter() - begun)
        yield from spread("  peer: a file of that size, fsync", took)
        book = sqlite3.connect(Path(folder) / "peer.sqlite", isolation_level=None)
        for words in ("PRAGMA journal_mode = WAL", "PRAGMA synchronous = FULL", "CREATE TABLE t (a TEXT)"):
            book.execute(words)
        took = []
        for _ in range(n):
            begun = time.perf_counter()
            book.execute("INSERT INTO t VALUES ('a job')")
            took.append(time.perf_counter() - begun)
        book.close()
        yield from spread("  peer: one row in SQLite, WAL, synchronous FULL", took)
