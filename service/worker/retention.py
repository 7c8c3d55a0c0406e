"""Ended jobs go by age and by disk quota, and the store's files that nobody names any more go with them.

Theory of operation of the sweep: what is marked is what the tables name, read in one transaction. A file that is not
marked may still be about to be named: by a stage that has stored it and not yet committed, by a picture whose job is
just being made. Both store it (again) first, which renews its time; so only files stored more than an hour before the
marks were read are deleted, and the store itself looks at that time once more as it deletes.
"""

from __future__ import annotations

import sqlalchemy as sa
import structlog

from service.jobs.book import drop_job, locked_job
from service.jobs.database import clock, is_sqlite, reading, writing
from service.jobs.records import Job, UnknownJobError
from service.jobs.states import ENDED, JobOnMillError
from service.jobs.tables import artifacts, executors, jobs, runs, stage_results, stage_runs
from service.settings import ServerSettings
from service.store.store import Store
from service.worker.engine import JobEngine, Ticket

GRACE_S = 3600.0
DAY_S = 86400.0
BATCH = 20
log = structlog.get_logger()


class Retention:
    """One turn does all of it; several workers may do it at once."""

    def __init__(
        self,
        database: sa.Engine,
        store: Store,
        engine: JobEngine,
        settings: ServerSettings,
        *,
        grace_s: float = GRACE_S,
    ) -> None:
        self._database = database
        self._store = store
        self._engine = engine
        self._keep_s = None if settings.keep_days is None else settings.keep_days * DAY_S
        self._quota = None if settings.quota_mb is None else settings.quota_mb * 1_000_000
        self._grace_s = grace_s

    def turn(self) -> None:
        if self._keep_s is not None:
            self._drop_old(self._keep_s)
        if self._quota is not None:
            self._drop_to_quota(self._quota)
        self._sweep()
        self._forget_ended()
        self._forget_workers()

    def _drop_old(self, keep_s: float) -> None:
        while self._drop_jobs(older_than_s=keep_s, limit=BATCH):
            pass
        self._drop_results(unused_for_s=keep_s, limit=None)

    def _drop_to_quota(self, quota: int) -> None:
        """First results that only might be used again, the longest unused first; then whole jobs, the oldest first."""
        sizes = {one.sha256: one.bytes for one in self._store.list()}
        while sum(sizes.get(sha256, 0) for sha256 in self._marks()[0]) > quota:
            if self._drop_results(unused_for_s=self._grace_s, limit=BATCH):
                continue
            if not self._drop_jobs(older_than_s=0.0, limit=1):
                log.warning("over quota, and nothing left that could go", quota_mb=quota // 1_000_000)
                return

    def _drop_jobs(self, *, older_than_s: float, limit: int) -> int:
        """Delete the oldest ended jobs, but those whose programs a mill has in hand. Returns how many went."""
        on_mill = sa.select(runs.c.job_id).where(runs.c.open)
        with reading(self._database) as connection:
            ended = sa.and_(jobs.c.ended_at <= clock(connection) - older_than_s, jobs.c.state.in_(map(str, ENDED)))
            query = sa.select(jobs.c.id).where(ended, jobs.c.id.not_in(on_mill)).order_by(jobs.c.ended_at).limit(limit)
            found = list(connection.execute(query).scalars())
        return sum(self._drop_job(job_id) for job_id in found)

    def _drop_job(self, job_id: str) -> bool:
        with writing(self._database) as connection:
            try:
                job = locked_job(connection, job_id)
            except UnknownJobError:
                return False
            if not job.ended:
                return False  # retried a moment ago
            try:
                drop_job(connection, job)
            except JobOnMillError:
                return False  # handed to a mill a moment ago
        self._engine.forget(_tickets(job))
        log.info("job deleted", job=job_id, ended_at=job.ended_at)
        return True

    def _drop_results(self, *, unused_for_s: float, limit: int | None) -> int:
        table = stage_results.c
        with writing(self._database) as connection:
            old = table.used_at < clock(connection) - unused_for_s
            keys = sa.select(table.key).where(old).order_by(table.used_at).limit(limit)
            doomed = list(connection.execute(keys).scalars())
            # `old` once more: one that was used in the meantime stays.
            return connection.execute(stage_results.delete().where(table.key.in_(doomed), old)).rowcount

    def _marks(self) -> tuple[set[str], float]:
        """Every object that the tables name, and the time at which they did."""
        columns = (artifacts.c.sha256, jobs.c.image_sha256, stage_runs.c.log_sha256)
        with self._database.connect() as plain:
            connection = plain if is_sqlite(plain) else plain.execution_options(isolation_level="REPEATABLE READ")
            with connection.begin():
                at = clock(connection)
                named = {sha for column in columns for sha in connection.execute(sa.select(column)).scalars()}
                for outputs in connection.execute(sa.select(stage_results.c.outputs)).scalars():
                    named |= {file["sha256"] for file in outputs.values()}
        return {sha256 for sha256 in named if sha256 is not None}, at

    def _sweep(self) -> None:
        marks, at = self._marks()
        swept = [one for one in self._store.list() if one.sha256 not in marks and one.stored_at < at - self._grace_s]
        for one in swept:
            self._store.delete(one.sha256, stored_before=at - self._grace_s)
        if swept:
            log.info("files swept", count=len(swept), bytes=sum(one.bytes for one in swept))

    def _forget_ended(self) -> None:
        """The engine's history of jobs that ended a while ago; one forgotten already is looked at for two days more."""
        with reading(self._database) as connection:
            at = clock(connection)
            window = jobs.c.ended_at.between(at - 2 * DAY_S, at - GRACE_S)
            query = sa.select(jobs).where(window, jobs.c.state.in_(map(str, ENDED)))
            found = [Job.of(row) for row in connection.execute(query).mappings()]
        for start in range(0, len(found), BATCH):
            self._engine.forget([ticket for job in found[start : start + BATCH] for ticket in _tickets(job)])

    def _forget_workers(self) -> None:
        """Rows of workers that have not been heard of for a day and own nothing."""
        owners = sa.select(jobs.c.owner).where(jobs.c.owner.is_not(None))
        with writing(self._database) as connection:
            old = executors.c.seen_at < clock(connection) - DAY_S
            connection.execute(executors.delete().where(old, executors.c.id.not_in(owners)))


def _tickets(job: Job) -> list[Ticket]:
    return [Ticket(job.id, attempt) for attempt in range(1, job.attempt + 1)]
