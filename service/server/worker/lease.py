"""The worker's claim to be alive: a row in the database that it renews, and the lock that makes its name its own.

Theory of operation: others take a worker's jobs when its row is older than one lease, by the database's clock. The
worker itself stops working at 0.6 of a lease without a successful beat, in real time, a pause or a suspended computer
included (`machines.clock`), and counted from before the beat was sent; so it has stopped before anyone takes over,
however slow the beat's answer was.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from uuid import uuid4

import sqlalchemy as sa
import structlog

from machines.clock import Timeout, suspend_aware_clock_s
from service.processes.lifeline import BEAT_S
from service.server.database.connection import begin_writing, clock, put_rows
from service.server.database.tables import executors

SAFE_SHARE = 0.6
BEATS_PER_LEASE = 6
log = structlog.get_logger()


class NameTakenError(Exception):
    """Another process has started under this worker's name, and owns it now."""


@dataclass
class Lease:
    """The row of one worker. `boot` tells its process from others of the same name.

    alone : nobody can take over, as a lock makes this process the only worker of the database; then it need not stop
            where the database is away for longer (a backup that locks the file), and `safe` is about the row only
    """

    database: sa.Engine
    executor: str
    lease_s: float
    pid: int
    version: str
    alone: bool = False
    monotonic: Callable[[], float] = suspend_aware_clock_s
    boot: str = field(default_factory=lambda: uuid4().hex)
    _good_at: float = field(default=float("-inf"), init=False)

    def take(self) -> None:
        """Put the row there: from now on this process is the worker of this name."""
        begun = self.monotonic()
        with begin_writing(self.database) as connection:
            at = clock(connection)
            row = {"id": self.executor, "host": socket.gethostname(), "pid": self.pid, "boot": self.boot}
            put_rows(connection, executors, [row | {"version": self.version, "started_at": at, "seen_at": at}])
        self._good_at = begun

    def renew(self) -> None:
        """Renew the row. NameTakenError where it is another process's."""
        begun = self.monotonic()
        with begin_writing(self.database) as connection:
            mine = sa.and_(executors.c.id == self.executor, executors.c.boot == self.boot)
            renewed = connection.execute(executors.update().where(mine).values(seen_at=clock(connection)))
            if renewed.rowcount == 0:
                raise NameTakenError(f"another process works as {self.executor}")
        self._good_at = begun

    def give_back(self) -> None:
        """Give the lease back: others need not wait for it to run out."""
        with begin_writing(self.database) as connection:
            mine = sa.and_(executors.c.id == self.executor, executors.c.boot == self.boot)
            connection.execute(executors.delete().where(mine))
        self._good_at = float("-inf")

    def is_safe(self) -> bool:
        """Return whether this worker may still work. Costs nothing."""
        age_s = self.monotonic() - self._good_at
        return age_s < (float("inf") if self.alone else SAFE_SHARE * self.lease_s)


class LeaseRenewer:
    """Beats a lease from a thread of its own. `on_taken` is called once where the name is another process's."""

    def __init__(self, lease: Lease, on_taken: Callable[[], None]) -> None:
        self._lease = lease
        self._on_taken = on_taken
        self._stop = threading.Event()
        self._hang = Timeout(max(lease.lease_s, 10.0), most_s=2.0 * BEAT_S)  # looked at with every beat
        self._thread = threading.Thread(target=self._run, name="heart", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(timeout=self._lease.lease_s)

    def is_turning(self) -> bool:
        """Return False where the thread has hung for a lease: the process had better be started again."""
        return not self._hang.is_over

    def _run(self) -> None:
        while not self._stop.wait(self._lease.lease_s / BEATS_PER_LEASE):
            self._hang.restart()
            try:
                self._lease.renew()
            except NameTakenError:
                log.error("name taken: another process works under this executor's name")
                self._on_taken()
                return
            except Exception as error:  # the database is away: the lease runs down by itself
                log.warning("no beat", error=str(error).splitlines()[0], safe=self._lease.is_safe())


def list_live_executors(connection: sa.Connection, lease_s: float) -> set[str]:
    """Return the workers that were heard of within a lease."""
    query = sa.select(executors.c.id).where(executors.c.seen_at > clock(connection) - lease_s)
    return set(connection.execute(query).scalars())
