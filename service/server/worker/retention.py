"""Deletes ended jobs by age and by disk quota, and with them the store's files that nothing refers to any more.

Theory of operation: files are deleted with the last row that refers to them. The sweep, which compares the store with
the tables a part at a time, finds files that a crash has left behind. A file without a reference may still get one:
from a stage that has stored it and not yet committed, or from a job that is just being made. Both store the file
(again) first, which renews its time. So only files stored more than an hour before the references were read are
deleted, and the store itself checks that time again as it deletes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import sqlalchemy as sa
import structlog

from service.server.database.claims import drop_results
from service.server.database.connection import begin_reading, begin_writing, clock, is_sqlite
from service.server.database.job_rows import ARTIFACT_BYTES, lock_job, set_counter
from service.server.database.jobs import drop_job
from service.server.database.records import JobOnMillError, UnknownJobError
from service.server.database.tables import artifacts, executors, jobs, result_files, runs, stage_results, stage_runs
from service.server.queue.engine import JobEngine, Ticket
from service.settings import ServerSettings
from service.store.base import MissingObjectError, Store

GRACE_S = 3600.0
"""How long a file without a reference stays after it was stored, and how long the engine keeps an ended job."""
DAY_S = 86400.0
BATCH = 20
CHUNK = 500
PARTS = [f"{number:02x}" for number in range(256)]  # of the store: the first two digits of a hash
PARTS_A_TURN = 16
log = structlog.get_logger()

_NAMES = (artifacts.c.sha256, jobs.c.image_sha256, stage_runs.c.log_sha256, result_files.c.sha256)


class Retention:
    """Deletes by age and quota, and sweeps the store. One turn does a part of the work; several workers may do it at
    once.
    """

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
        self._named_bytes: dict[str, int] = {}  # by part of the store
        self._next_part = 0
        self._forgotten_to: float | None = None

    def clean_up(self) -> None:
        if self._keep_s is not None:
            self._drop_old(self._keep_s)
        self._sweep_parts()
        if self._quota is not None:
            self._drop_to_quota(self._quota)
        with begin_writing(self._database) as connection:
            set_counter(connection, ARTIFACT_BYTES, sum(self._named_bytes.values()))
        self._forget_ended()
        self._forget_workers()

    def _drop_old(self, keep_s: float) -> None:
        while self._drop_jobs(older_than_s=keep_s, limit=BATCH):
            pass
        while self._drop_results(unused_for_s=keep_s, limit=BATCH):
            pass

    def _drop_to_quota(self, quota: int) -> None:
        """First drop results that only might be reused, the longest unused first; then whole jobs, the oldest first."""
        while sum(self._named_bytes.values()) > quota:
            if self._drop_results(unused_for_s=self._grace_s, limit=BATCH):
                continue
            if not self._drop_jobs(older_than_s=0.0, limit=1):
                log.warning("over quota, and nothing left that could go", quota_mb=quota // 1_000_000)
                return

    def _drop_jobs(self, *, older_than_s: float, limit: int) -> int:
        """Delete the oldest ended jobs, except those whose programs are on a mill. Return the number deleted."""
        on_mill = sa.select(runs.c.job_id).where(runs.c.open)
        with begin_reading(self._database) as connection:
            ended = jobs.c.ended_at <= clock(connection) - older_than_s
            query = (
                sa.select(jobs.c.id)
                .where(ended, jobs.c.id.not_in(on_mill))
                .order_by(jobs.c.ended_at, jobs.c.id)
                .limit(limit)
            )
            found = list(connection.execute(query).scalars())
        return sum(self._drop_job(job_id) for job_id in found)

    def _drop_job(self, job_id: str) -> bool:
        with begin_writing(self._database) as connection:
            try:
                job = lock_job(connection, job_id)
            except UnknownJobError:
                return False
            if not job.ended:
                return False  # retried a moment ago
            named = {job.image_sha256, *_list_hashes_of_job(connection, job_id)}
            try:
                drop_job(connection, job)
            except JobOnMillError:
                return False  # handed to a mill a moment ago
        self._engine.forget(_tickets(job.id, job.attempt))
        self._drop_files(named)
        log.info("job deleted", job=job_id, ended_at=job.ended_at)
        return True

    def _drop_results(self, *, unused_for_s: float, limit: int) -> int:
        table = stage_results.c
        with begin_writing(self._database) as connection:
            old = table.used_at < clock(connection) - unused_for_s
            keys = sa.select(table.key).where(old).order_by(table.used_at).limit(limit).with_for_update()
            doomed = list(connection.execute(keys).scalars())
            files = sa.select(result_files.c.sha256).where(result_files.c.key.in_(doomed))
            named = set(connection.execute(files).scalars())
            dropped = drop_results(connection, doomed)
        self._drop_files(named)
        return dropped

    def _drop_files(self, hashes: set[str]) -> None:
        """Drop the files of a deleted row, unless another row refers to them."""
        named, at = self._find_named(lambda column: column.in_(hashes))
        for sha256 in hashes - named:
            with suppress(MissingObjectError):
                size, part = self._store.head(sha256).bytes, sha256[:2]
                self._store.delete(sha256, stored_before=at - self._grace_s)
                self._named_bytes[part] = max(0, self._named_bytes.get(part, 0) - size)

    def _find_named(self, wanted: Callable[[sa.Column[Any]], sa.ColumnElement[bool]]) -> tuple[set[str], float]:
        """Return those hashes to which the tables refer, and the time of the query."""
        with self._database.connect() as plain:
            connection = plain if is_sqlite(plain) else plain.execution_options(isolation_level="REPEATABLE READ")
            with connection.begin():
                at = clock(connection)
                queries = [sa.select(column).where(wanted(column)) for column in _NAMES]
                return {sha256 for query in queries for sha256 in connection.execute(query).scalars()}, at

    def _sweep_parts(self) -> None:
        """Sweep at first the whole store, whose size is not known yet; then a sixteenth of it."""
        count = PARTS_A_TURN if self._named_bytes else len(PARTS)
        for _ in range(count):
            self._sweep(PARTS[self._next_part])
            self._next_part = (self._next_part + 1) % len(PARTS)

    def _sweep(self, part: str) -> None:
        named, at = self._find_named(lambda column: column.between(part, part + "g"))
        found = list(self._store.list(part))
        self._named_bytes[part] = sum(one.bytes for one in found if one.sha256 in named)
        swept = [one for one in found if one.sha256 not in named and one.stored_at < at - self._grace_s]
        for one in swept:
            self._store.delete(one.sha256, stored_before=at - self._grace_s)
        if swept:
            log.info("files swept", count=len(swept), bytes=sum(one.bytes for one in swept))

    def _forget_ended(self) -> None:
        """Forget the engine's history of jobs that ended an hour ago: each once, those of two days once more after a
        start.
        """
        place = sa.tuple_(jobs.c.ended_at, jobs.c.id)
        with begin_reading(self._database) as connection:
            at = clock(connection)
        last = (self._forgotten_to or at - 2 * DAY_S, "")
        while True:
            query = (
                sa.select(jobs.c.id, jobs.c.attempt, jobs.c.ended_at)
                .where(place > sa.tuple_(*last), jobs.c.ended_at <= at - GRACE_S)
                .order_by(jobs.c.ended_at, jobs.c.id)
                .limit(CHUNK)
            )
            with begin_reading(self._database) as connection:
                found = connection.execute(query).all()
            if not found:
                self._forgotten_to = at - GRACE_S
                return
            self._engine.forget([ticket for row in found for ticket in _tickets(row.id, row.attempt)])
            last = (found[-1].ended_at, found[-1].id)

    def _forget_workers(self) -> None:
        """Forget rows of workers that have not been heard of for a day and own nothing."""
        owners = sa.select(jobs.c.owner).where(jobs.c.owner.is_not(None))
        with begin_writing(self._database) as connection:
            old = executors.c.seen_at < clock(connection) - DAY_S
            connection.execute(executors.delete().where(old, executors.c.id.not_in(owners)))


def _list_hashes_of_job(connection: sa.Connection, job_id: str) -> Iterator[str]:
    """Yield hashes of a job's files and of its stages' logs."""
    for column, table in ((artifacts.c.sha256, artifacts), (stage_runs.c.log_sha256, stage_runs)):
        query = sa.select(column).where(table.c.job_id == job_id, column.is_not(None))
        yield from connection.execute(query).scalars()


def _tickets(job_id: str, attempts: int) -> list[Ticket]:
    return [Ticket(job_id, attempt) for attempt in range(1, attempts + 1)]
