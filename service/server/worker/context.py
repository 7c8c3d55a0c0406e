"""What all jobs of a worker share, and how its writes bear a database that is away for a while."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import sqlalchemy as sa

from service.server.database.claims import WorkBook
from service.server.queue.engine import Fenced
from service.server.worker.lease import Lease
from service.server.worker.monitor import Watch
from service.server.worker.process.supervision import StageEnd
from service.settings import ServerSettings
from service.store.base import Store

RETRY_S = 600.0
PAUSE_S = 0.2
AWAY = (sa.exc.OperationalError, sa.exc.InterfaceError, sa.exc.InternalError, sa.exc.TimeoutError)
Result = TypeVar("Result")


class Processes(Protocol):
    """What the body needs of StageProcesses."""

    def run(
        self, order: Any, *, log: Path, on_progress: Callable[[float], None], stop: Callable[[], str | None]
    ) -> StageEnd: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class WorkerContext:
    """All that a worker's jobs share."""

    settings: ServerSettings
    executor: str
    work: WorkBook
    store: Store
    processes: Processes
    lease: Lease
    watch: Watch

    @property
    def scratch(self) -> Path:
        """Where this worker's stages work; no other worker's do."""
        return self.settings.scratch / self.executor


@contextmanager
def fence_outage() -> Iterator[None]:
    """Fence an attempt whose database cannot be reached: no fault of the job, which is gone on with later."""
    try:
        yield
    except AWAY as error:
        raise Fenced(f"the database is away: {str(error).splitlines()[0]}") from error


def retry_while_away(write: Callable[[], Result]) -> Result:
    """Retry while the database is away: work of hours is not thrown away over a restart of it."""
    deadline = time.monotonic() + RETRY_S
    while True:
        try:
            return write()
        except AWAY:
            if time.monotonic() > deadline:
                raise
            time.sleep(PAUSE_S)
