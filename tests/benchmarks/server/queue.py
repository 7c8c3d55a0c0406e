"""Submit, start, cancel, follow."""

from __future__ import annotations

import random
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server.customer import LONG, SMALL, Customer, Said, percentile, spread
from tests.benchmarks.timing import Figure
from tests.trials.server.deployment import Deployment, embedded
from tests.trials.server.processes import of_kind, wait_until

_SUBMITS = 300
_CANCELS = 30
_FOLLOWERS = 50
_OVERHEAD_JOBS = 3


def figures() -> Iterator[Figure]:
    with tempfile.TemporaryDirectory() as folder, embedded(Path(folder)) as deployment, Customer(deployment.url) as one:
        one.ended(one.submit(SMALL))
        yield from _overhead(one)
        yield from _submits(one)
        yield from _cancels(deployment, one)
        yield from _followers(deployment, one)


def _overhead(customer: Customer) -> Iterator[Figure]:
    """What a job takes beyond the work of its stages, per stage."""
    rest = []
    for number in range(_OVERHEAD_JOBS):
        job = customer.ended(customer.submit(SMALL, throw_mm=60 + number))
        assert job["state"] == "succeeded", job["error"]
        events = list(customer.events(job["id"]))
        ends = {said.kind: said.at for said in events if said.kind in ("started", "ended")}
        work_s = sum(said.data["seconds"] for said in events if said.kind == "stage.committed")
        rest.append((ends["ended"] - ends["started"] - work_s) / len(job["stages"]))
    yield Figure("server: engine overhead per stage", max(rest), "s", f"most of {len(rest)} jobs; budget 1.5 s")


def _submits(customer: Customer) -> Iterator[Figure]:
    """An answer tells of a job that is durable. The jobs ask for what is there already, so they cost little."""
    took = []
    for _ in range(_SUBMITS):
        begun = time.perf_counter()
        customer.submit(SMALL)
        took.append(time.perf_counter() - begun)
        time.sleep(0.05)
    yield from spread("server: submit to durable answer", took, note="budget 50 ms")
    wait_until(lambda: not customer.http.get("/v1/jobs?state=queued").json()["jobs"], 120.0)


def _cancels(deployment: Deployment, customer: Customer) -> Iterator[Figure]:
    """Each job is new; the time to its first stage, and from its cancel to the last process gone."""
    waited, gone, chance = [], [], random.Random(1)
    for number in range(_CANCELS):
        job_id = customer.submit(LONG, pixels=512, throw_mm=130 + number)
        events = {said.kind: said.at for said in _until(customer, job_id, "stage.started")}
        waited.append(events["stage.started"] - events["queued"])
        assert wait_until(lambda: of_kind(deployment.mark, "stage"), 30.0, every_s=0.005)
        time.sleep(chance.uniform(0.0, 3.0))
        begun = time.monotonic()
        customer.cancel(job_id)
        assert wait_until(lambda: not of_kind(deployment.mark, "stage"), 30.0, every_s=0.005)
        gone.append(time.monotonic() - begun)
        customer.ended(job_id)
    yield from spread("server: enqueue to stage running", waited, note="budget 500 ms")
    yield from spread("server: cancel to last process gone", gone, unit="s", note="budget 2 s")


def _until(customer: Customer, job_id: str, kind: str) -> Iterator[Said]:
    for said in customer.events(job_id):
        yield said
        if said.kind == kind:
            return


def _followers(deployment: Deployment, customer: Customer) -> Iterator[Figure]:
    """Fifty readers of one job: how late is each event at each of them?"""
    job_id = customer.submit(SMALL, throw_mm=77)
    late: list[float] = []
    seen: list[int] = []

    def follow() -> None:
        with Customer(deployment.url) as reader:
            begun, count = time.time(), 0
            for said in reader.events(job_id):
                if "at" in said.data and said.at > begun:
                    late.append(said.came - said.at)
                count += 1
            seen.append(count)

    readers = [threading.Thread(target=follow) for _ in range(_FOLLOWERS)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join()
    note = f"{len(late)} events to {len(seen)} readers, budget 1 s"
    yield Figure("server: events to 50 followers, late by p99", percentile(late, 0.99), "s", note)
