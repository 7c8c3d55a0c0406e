"""Figures of the job server: latencies, takeover, footprint, downloads. Real processes, one machine, loopback."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server import downloads, farm, followers, life, queue
from tests.benchmarks.server.customer import Customer
from tests.benchmarks.timing import Figure
from tests.trials.server.deployment import embedded


def figures() -> Iterator[Figure]:
    """One server for most of it; it rests while the farm is measured, so that its own rest can be afterwards."""
    yield from life.starts()
    with tempfile.TemporaryDirectory() as folder, embedded(Path(folder)) as deployment:
        with Customer(deployment.url) as customer:
            yield from life.restarts(deployment, customer)
            yield from queue.overhead(customer)
            yield from followers.figures(deployment, customer)
            yield from queue.cancels(deployment, customer)
            yield from downloads.figures(deployment, customer)
        yield from farm.figures()
        yield from life.idle(deployment, "after work")
    with (
        tempfile.TemporaryDirectory() as folder,
        embedded(Path(folder)) as deployment,
        Customer(deployment.url) as customer,
    ):
        yield from queue.submits(customer)
