"""Fifty readers of one job: how late is each event, and each step of progress, at each of them?"""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.server.customer import SMALL, Customer, Said
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
    job_id = customer.submit(SMALL, throw_mm=77)
    noted = _Noted(deployment.data[0] / "causticmill.sqlite", job_id)
    heard: list[list[Said]] = []

    def follow(begun: float) -> None:
        with Customer(deployment.url) as reader:
            heard.append([said for said in reader.events(job_id) if "at" not in said.data or said.at > begun])

    readers = [threading.Thread(target=follow, args=(time.time() + 0.5,)) for _ in range(FOLLOWERS)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join()
    noted.stop()
    late = [said.came - said.at for said_to in heard for said in said_to if "at" in said.data]
    yield from spread(f"events to {FOLLOWERS} followers, late by", late, unit="s", most=1.0)
    steps = [
        said.came - noted.at[step]
        for said_to in heard
        for said in said_to
        if said.kind == "progress" and (step := (said.data["stage"], said.data["share"])) in noted.at
    ]
    words = "from the worker's note, itself made at most twice a second"
    yield from spread(f"progress to {FOLLOWERS} followers, late by", steps, unit="s", most=1.0, note=words)
