"""One thread per worker looks what is wanted of its running jobs, and notes how far they are.

The supervisor of a stage asks five times a second whether to go on, and must be answered at once, database or not: it
is answered from here. Progress comes the same way and is written here, at most twice a second per job.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import structlog

from service.server.database.claims import Claim, WorkBook
from service.server.worker.lease import Lease

POLL_S = 0.15
PROGRESS_S = 0.5
log = structlog.get_logger()


class Watched:
    """A running job: what is wanted of it, and how far it is."""

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
        """Look after a job as long as it runs."""
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
