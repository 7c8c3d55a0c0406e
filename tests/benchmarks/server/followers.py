"""Fifty readers of one job: how late is each event, and each step of progress, at each of them?"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server.customer import LONG, SMALL, Customer, Said
from tests.benchmarks.server.rows import spread
from tests.benchmarks.server.sizes import FOLLOWERS
from tests.benchmarks.timing import Figure
from tests.trials.server.deployment import Deployment

_LOOK_S = 0.02


class _Noted:
    """When the worker wrote each step of progress down, read from the database itself."""

    def __init__(self, file: Path, job_id: str) -> None:
        self.at: dict[tuple[str, float], float] = {}
        self._file, self._job_id = file, job_id
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _look(self) -> None:
        book = sqlite3.connect(f"file:{self._file}?mode=ro", uri=True, timeout=10)
        query = "SELECT stage, share, at FROM progress WHERE job_id = ?"
        while not self._stop.wait(_LOOK_S):
            for stage, share, at in book.execute(query, (self._job_id,)):
                self.at.setdefault((stage, round(share, 4)), at)
        book.close()


def figures(deployment: Deployment, customer: Customer) -> Iterator[Figure]:
    """The job waits behind another one until all have heard that it is queued."""
    other = customer.submit(LONG, pixels=512, throw_mm=76)
    customer.until(other, "stage.started")
    job_id = customer.submit(SMALL, throw_mm=77)
    noted = _Noted(deployment.data[0] / "causticmill.sqlite", job_id)
    there = threading.Barrier(FOLLOWERS + 1, timeout=60.0)
    heard: list[list[Said]] = []

    def follow() -> None:
        with Customer(deployment.url) as reader:
            stream = reader.events(job_id)
            assert next(stream).kind == "queued"
            there.wait()
            heard.append(list(stream))

    readers = [threading.Thread(target=follow, daemon=True) for _ in range(FOLLOWERS)]
    for reader in readers:
        reader.start()
    there.wait()
    customer.cancel(other)
    for reader in readers:
        reader.join()
    noted.stop()
    assert len(heard) == FOLLOWERS
    said = [each for heard_by_one in heard for each in heard_by_one]
    late = [each.came - each.at for each in said if "at" in each.data]
    yield from spread(f"events to {FOLLOWERS} followers, late by", late, unit="s", most=1.0)
    steps = [
        each.came - noted.at[step]
        for each in said
        if each.kind == "progress" and (step := (each.data["stage"], each.data["share"])) in noted.at
    ]
    words = "from the worker's note, itself made at most twice a second"
    yield from spread(f"progress to {FOLLOWERS} followers, late by", steps, unit="s", most=1.0, note=words)
