"""Reconciles the engine with the jobs' table every few seconds, in every worker.

Level-triggered: each turn looks at the present state and not at changes, so nothing is forgotten if a turn fails or a
worker dies between two steps. Every step may be repeated, and may race with other workers.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

import sqlalchemy as sa
import structlog

from phrases.phrase import Phrase
from service.server.database.claims import interrupt_tries
from service.server.database.connection import begin_reading, begin_writing, clock
from service.server.database.job_rows import change_job, end_job, lock_job
from service.server.database.records import Job, JobState, Json, UnknownJobError
from service.server.database.tables import jobs
from service.server.queue.engine import JobEngine, Ticket
from service.server.worker.lease import list_live_executors

CHUNK = 200
GRACE_S = 2.0  # a job younger than this may be on its way from the API to the engine
GIVEN_UP = Phrase("the job engine gave the job up without a result; the server's log may say why. You can retry it")
log = structlog.get_logger()

Queued = dict[Ticket, int]  # and the priority of each


class Reconciler:
    """`list_active` returns the jobs on which this worker works."""

    def __init__(
        self,
        database: sa.Engine,
        engine: JobEngine,
        *,
        executor: str,
        lease_s: float,
        list_active: Callable[[], set[str]],
    ) -> None:
        self._database = database
        self._engine = engine
        self._executor = executor
        self._lease_s = lease_s
        self._list_active = list_active
        self._last: tuple[int, float, str] | None = None  # place in the queue up to which the last turn has looked

    def reconcile(self) -> None:
        """Check everything that runs, and the next 200 jobs of the queue, which is usually all of it."""
        self.release_claims()
        queued = self._find_next_queued()
        self._submit_unknown(queued)
        self._engine.pick_up()
        live = self._take_over_dead()
        self._end_cancelled(live)
        self._end_given_up(queued, live)

    def release_claims(self) -> None:
        """Release jobs that have this worker's name but do not run here, so that the holder of the ticket can claim
        them.

        They date from before its restart, or the worker lost its claim while the engine gave the ticket to another
        worker.
        """
        query = sa.select(jobs.c.id).where(jobs.c.state == "running", jobs.c.owner == self._executor)
        with begin_reading(self._database) as connection:
            found = set(connection.execute(query).scalars()) - self._list_active()
        for job_id in found:
            with begin_writing(self._database) as connection, suppress(UnknownJobError):
                job, at = lock_job(connection, job_id), clock(connection)
                # Check again under the lock: a thread that is about to claim the job has announced it before.
                if job.owner == self._executor and job_id not in self._list_active():
                    log.info("let go", job=job_id)
                    interrupt_tries(connection, job, at=at)
                    change_job(connection, job, owner=None, fence=job.fence + 1)

    def _find_next_queued(self) -> Queued:
        """Return the jobs of the queue after those of the last turn, with their priorities; start from its head after
        its end.
        """
        place = sa.tuple_(jobs.c.priority, jobs.c.queued_at, jobs.c.id)
        query = (
            sa.select(jobs.c.id, jobs.c.attempt, jobs.c.priority, jobs.c.queued_at)
            .where(jobs.c.state == str(JobState.QUEUED))
            .order_by(jobs.c.priority, jobs.c.queued_at, jobs.c.id)
            .limit(CHUNK)
        )
        if self._last is not None:
            query = query.where(place > sa.tuple_(*self._last))
        with begin_reading(self._database) as connection:
            at, rows = clock(connection), connection.execute(query).all()
        last = rows[-1] if len(rows) == CHUNK else None
        self._last = None if last is None else (last.priority, last.queued_at, last.id)
        return {Ticket(row.id, row.attempt): row.priority for row in rows if row.queued_at < at - GRACE_S}

    def _submit_unknown(self, queued: Queued) -> None:
        """Submit queued jobs that the engine does not know: the API died, or could not reach it."""
        known = self._engine.list_known(list(queued))
        for ticket in [ticket for ticket in queued if ticket not in known]:
            log.info("submitted late", job=ticket.job_id, attempt=ticket.attempt)
            self._engine.submit(ticket, priority=queued[ticket])

    def _take_over_dead(self) -> set[str]:
        """Take over the tickets of workers that are no longer alive; return the live workers."""
        owners = set(self._engine.find_owners().values())
        with begin_reading(self._database) as connection:
            live = list_live_executors(connection, self._lease_s) | {self._executor}
        if dead := sorted(owners - live):
            log.info("taking over", executors=dead)
            self._engine.take_over(dead)
        return live

    def _end_cancelled(self, live: set[str]) -> None:
        """End running jobs that were to be cancelled when their worker died."""
        query = sa.select(jobs.c.id).where(jobs.c.state == "running", jobs.c.cancel_requested)
        with begin_reading(self._database) as connection:
            found = list(connection.execute(query).scalars())
        for job_id in found:
            self._end(job_id, live, JobState.CANCELLED, None)

    def _end_given_up(self, queued: Queued, live: set[str]) -> None:
        """End jobs that wait or run although the engine is done with their ticket.

        The engine is queried first and the job read afterwards, because an attempt ends the job before its ticket ends.
        """
        query = sa.select(jobs.c.id, jobs.c.attempt).where(jobs.c.state == str(JobState.RUNNING))
        with begin_reading(self._database) as connection:
            running = [Ticket(row.id, row.attempt) for row in connection.execute(query)]
        for ticket in self._engine.list_ended([*queued, *running]):
            error = {"stage": None, "detail": GIVEN_UP, "field": None}
            self._end(ticket.job_id, live, JobState.FAILED, error, attempt=ticket.attempt)

    def _end(
        self, job_id: str, live: set[str], state: JobState, error: Json | None, *, attempt: int | None = None
    ) -> None:
        """End a job in its owner's name, unless someone is working on it."""
        with begin_writing(self._database) as connection:
            try:
                job, at = lock_job(connection, job_id), clock(connection)
            except UnknownJobError:
                return
            if job.ended or attempt not in (None, job.attempt) or self._is_in_hand(job, live):
                return
            interrupt_tries(connection, job, at=at)
            if job.cancel_requested:
                state, error = JobState.CANCELLED, None
            log.info("ended for its owner", job=job_id, owner=job.owner, state=str(state))
            end_job(connection, job, state, at=at, error=error)

    def _is_in_hand(self, job: Job, live: set[str]) -> bool:
        return job.id in self._list_active() or (job.owner != self._executor and job.owner in live)


class PeriodicThread:
    """Calls a function periodically in its own thread; an error is logged, and the next round tries again."""

    def __init__(self, name: str, work: Callable[[], None], *, every_s: float) -> None:
        self._name = name
        self._work = work
        self._every_s = every_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()

    def _run(self) -> None:
        while not self._stop.wait(self._every_s):
            try:
                self._work()
            except Exception as error:
                log.warning(
                    f"{self._name}: this round failed", error=str(error).splitlines()[:1], kind=type(error).__name__
                )
