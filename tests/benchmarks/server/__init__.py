"""Figures of the job server: latencies, takeover, footprint, downloads. Real processes, one machine, loopback."""

from __future__ import annotations

from collections.abc import Iterator

from tests.benchmarks.server import downloads, farm, life, queue
from tests.benchmarks.timing import Figure


def figures() -> Iterator[Figure]:
    yield from life.figures()
    yield from queue.figures()
    yield from downloads.figures()
    yield from farm.figures()
