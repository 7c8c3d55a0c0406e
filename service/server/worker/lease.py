"""Decides whether a worker and its jobs may go on: by its lease, a row in the database that it renews, and by the
requests about its running jobs.

Theory of operation: others take a worker's jobs when its row is older than one lease, by the database's clock. The
worker itself stops working after 0.6 of a lease without a successful heartbeat. This is real time, including a pause or
a suspended computer (`machines.clock`), and counts from before the heartbeat was sent. So it has stopped before anyone
takes over, however slow the answer was. The supervisor of a stage asks five times a second whether to go on, and must
get an answer at once, with or without a database: one thread per worker queries the database for all of its jobs, and
writes their progress, at most twice a second per job.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from uuid import uuid4

import sqlalchemy as sa
import structlog

from machines.clock import Timeout, suspend_aware_clock_s
from service.processes.lifeline import BEAT_S
from service.server.database.claims import Claim, WorkBook
from service.server.database.connection import begin_writing, clock, put_rows
from service.server.database.tables import executors
from service.settings import SAFE_SHARE

BEATS_PER_LEASE = 6
log = structlog.get_logger()


class NameTakenError(Exception):
    """Another process has started under this worker's name, and owns it now."""


@dataclass
class Lease:
    """The row of one worker. `boot` distinguishes its process from others of the same name.

    alone : no one can take over, because a lock makes this process the only worker of the database; then it need not
    stop if the database is away for longer (a backup that locks the file), and `safe` only depends on the row
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
        """Write the row: from now on this process is the worker of this name."""
        begun = self.monotonic()
        with begin_writing(self.database) as connection:
            at = clock(connection)
            row = {"id": self.executor, "host": socket.gethostname(), "pid": self.pid, "boot": self.boot}
            put_rows(connection, executors, [row | {"version": self.version, "started_at": at, "seen_at": at}])
        self._good_at = begun

    def renew(self) -> None:
        """Renew the row. NameTakenError if it is another process's."""
        begun = self.monotonic()
        with begin_writing(self.database) as connection:
            mine = sa.and_(executors.c.id == self.executor, executors.c.boot == self.boot)
            renewed = connection.execute(executors.update().where(mine).values(seen_at=clock(connection)))
            if renewed.rowcount == 0:
                raise NameTakenError(f"another process works as {self.executor}")
        self._good_at = begun

    def give_back(self) -> None:
        """Give the lease back, so that others need not wait until it expires."""
        with begin_writing(self.database) as connection:
            mine = sa.and_(executors.c.id == self.executor, executors.c.boot == self.boot)
            connection.execute(executors.delete().where(mine))
        self._good_at = float("-inf")

    def is_safe(self) -> bool:
        """Return whether this worker may still work. Costs nothing."""
        age_s = self.monotonic() - self._good_at
        return age_s < (float("inf") if self.alone else SAFE_SHARE * self.lease_s)


class LeaseRenewer:
    """Renews a lease in its own thread. `on_taken` is called once if another process has taken the name."""

    def __init__(self, lease: Lease, on_taken: Callable[[], None]) -> None:
        self._lease = lease
        self._on_taken = on_taken
        self._stop = threading.Event()
        self._hang = Timeout(max(lease.lease_s, 10.0), most_s=2.0 * BEAT_S)  # checked with every beat
        self._thread = threading.Thread(target=self._run, name="heart", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(timeout=self._lease.lease_s)

    def is_turning(self) -> bool:
        """Return False if the thread has hung for a lease: then the process should be restarted."""
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
            except Exception as error:  # the database is away: the lease expires by itself
                log.warning("no beat", error=str(error).splitlines()[0], safe=self._lease.is_safe())


def list_live_executors(connection: sa.Connection, lease_s: float) -> set[str]:
    """Return the workers whose heartbeat is not older than a lease."""
    query = sa.select(executors.c.id).where(executors.c.seen_at > clock(connection) - lease_s)
    return set(connection.execute(query).scalars())


POLL_S = 0.15
PROGRESS_S = 0.5


class Watched:
    """A running job: requests to it, and its progress."""

    def __init__(self, claim: Claim, lease: Lease, stopping: threading.Event) -> None:
        self.claim = claim
        self.wish = "go"
        self.news: tuple[str, float, float] | None = None
        self.noted_at = 0.0
        self._lease = lease
        self._stopping = stopping

    def reason(self) -> str | None:
        """Return why its stage has to end now: "cancelled", "fenced", "stopping"; None: go on. Never waits."""
        if self.wish != "go":
            return self.wish
        if self._stopping.is_set():
            return "stopping"
        return None if self._lease.is_safe() else "fenced"


class Watch:
    """All jobs that run in this worker."""

    def __init__(self, work: WorkBook, lease: Lease) -> None:
        self.stopping = threading.Event()
        self._work = work
        self._lease = lease
        self._jobs: dict[str, Watched] = {}
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def is_idle_within(self, timeout_s: float) -> bool:
        """Wait until no job runs here."""
        with self._change:
            return self._change.wait_for(lambda: not self._jobs, timeout_s)

    @contextmanager
    def follow(self, claim: Claim) -> Iterator[Watched]:
        """Watch a job as long as it runs."""
        watched = Watched(claim, self._lease, self.stopping)
        with self._change:
            self._jobs[claim.job.id] = watched
            self._change.notify_all()
        try:
            yield watched
        finally:
            with self._change:
                del self._jobs[claim.job.id]
                self._change.notify_all()

    def _run(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._jobs)
                jobs = list(self._jobs.values())
            try:
                self._look(jobs)
                self._note(jobs)
            except Exception as error:  # the database is away; if that lasts, the lease runs out
                log.warning("cannot look after running jobs", error=str(error).splitlines()[0])
            time.sleep(POLL_S)

    def _look(self, jobs: list[Watched]) -> None:
        wishes = self._work.read_wishes(job.claim for job in jobs)
        for job in jobs:
            job.wish = wishes[job.claim.job.id]

    def _note(self, jobs: list[Watched]) -> None:
        now = time.monotonic()
        for job in jobs:
            news, job.news = (job.news, None) if now - job.noted_at >= PROGRESS_S else (None, job.news)
            if news is not None:
                stage, share, whole = news
                self._work.note_progress(job.claim, stage, share, whole=whole)
                job.noted_at = now
