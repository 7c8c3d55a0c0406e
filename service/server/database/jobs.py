"""The job book: jobs as the API sees and changes them. Each change and its event are one transaction. Changes by
workers are in service/server/database/claims.py. Both lock the job's row before they look at it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any
from uuid import uuid4

import sqlalchemy as sa

from phrases.phrase import Phrase
from service.errors import printable
from service.job.files import TARGET_PICTURE, THUMBNAILS
from service.job.stages.order import merge_reports
from service.server.database.connection import begin_reading, begin_writing, clock
from service.server.database.job_rows import (
    BATCH,
    Counter,
    add_to_counters,
    change_job,
    claim_key,
    end_job,
    find_by_key,
    get_job,
    list_offered_artifacts,
    list_offered_programs,
    lock_job,
    may_be_milled,
    open_run_of,
    read_events,
    read_news,
    state_counter,
    write_event,
)
from service.server.database.records import (
    PRIORITIES,
    RETRYABLE,
    TRANSITIONS,
    Artifact,
    Job,
    JobEvent,
    JobFacts,
    JobListRow,
    JobOnMillError,
    JobState,
    JobStateError,
    NewJob,
    News,
    StageRun,
    StageState,
    UnknownArtifactError,
    UnknownJobError,
)
from service.server.database.tables import artifacts, idempotency_keys, jobs, stage_results, stage_runs
from service.store.base import Store

NAME_CHARS = 255
_MOST_FACTS = 5000
MOST_POSITIONS = 1000  # places in the queue that are counted: behind that many jobs the exact place does not matter
_PICTURES = (*THUMBNAILS, TARGET_PICTURE)  # jobs of earlier versions have only the large one
_SUMMARY = [jobs.c[field.name] for field in fields(JobListRow)]


class JobBook:
    """Jobs of one database. `store`, if given, is asked whether it (still) has the picture of a new job."""

    def __init__(self, database: sa.Engine, store: Store | None = None) -> None:
        self.database = database
        self._store = store
        self._facts: dict[tuple[str, int], JobFacts] = {}  # by job and version

    # ------------------------------------------------------------------ making and changing

    def create(self, new: NewJob) -> tuple[Job, bool]:
        """Create a queued job; False if the same request with the same key made it before. KeyReusedError."""
        if self._store is not None:
            self._store.head(new.image_sha256)
        with begin_writing(self.database) as connection:
            at, job_id = clock(connection), str(uuid4())
            if new.key is not None and not claim_key(connection, "job", new.key, new.request_sha256, job_id, at=at):
                before = find_by_key(connection, "job", new.key, new.request_sha256)
                return get_job(connection, str(before)), False
            connection.execute(jobs.insert().values(**_first_row(new, job_id, at)))
            add_to_counters(connection, {state_counter(JobState.QUEUED): 1})
            write_event(connection, job_id, "queued", {"attempt": 1, "by": new.created_by}, at=at)
            return get_job(connection, job_id), True

    def request_cancel(self, job_id: str, by: str) -> Job:
        """Cancel: a queued job at once, a running one as soon as its worker sees it. Asking again changes nothing."""
        with begin_writing(self.database) as connection:
            job, at = lock_job(connection, job_id), clock(connection)
            if job.state == JobState.CANCELLED or (job.state == JobState.RUNNING and job.cancel_requested):
                return job
            if JobState.CANCELLED not in TRANSITIONS[job.state]:
                raise JobStateError(job.state, Phrase("cancelling"), frozenset({JobState.QUEUED, JobState.RUNNING}))
            write_event(connection, job_id, "cancel.requested", {"by": by}, at=at)
            if job.state == JobState.QUEUED:
                end_job(connection, job, JobState.CANCELLED, at=at, cancel_requested=True)
            else:
                change_job(connection, job, cancel_requested=True)
            return get_job(connection, job_id)

    def retry(self, job_id: str, by: str) -> Job:
        """Queue an ended job once more. Its finished stages are kept; its files appear again as the attempt proceeds.

        JobOnMillError while a run of one of its programs is open.
        """
        with begin_writing(self.database) as connection:
            job, at = lock_job(connection, job_id), clock(connection)
            if job.state not in RETRYABLE:
                raise JobStateError(job.state, Phrase("retrying"), RETRYABLE)
            _require_no_open_run(connection, job.id)
            is_log = artifacts.c.name.like("%.log")
            connection.execute(artifacts.delete().where(artifacts.c.job_id == job_id, ~is_log))
            change_job(connection, job, **_fresh(job.attempt + 1, at), fence=job.fence + 1)
            write_event(connection, job_id, "retried", {"attempt": job.attempt + 1, "by": by}, at=at)
            return get_job(connection, job_id)

    def delete(self, job_id: str) -> Job:
        """Delete a job that neither runs nor is on a mill, including its idempotency key. Return the deleted job."""
        with begin_writing(self.database) as connection:
            job = lock_job(connection, job_id)
            if job.state == JobState.RUNNING:
                raise JobStateError(job.state, Phrase("deleting"), frozenset(JobState) - {JobState.RUNNING})
            drop_job(connection, job)
            return job

    # ------------------------------------------------------------------ reading

    def get(self, job_id: str) -> Job:
        with begin_reading(self.database) as connection:
            return get_job(connection, job_id)

    def list_rows(
        self, *, states: Collection[JobState] = (), limit: int = 50, before: str | None = None
    ) -> list[JobListRow]:
        """List jobs, newest first; those older than the job `before` (UnknownJobError if it is gone).

        Each of several states is queried separately, in the order of its index; of all results the newest are taken.
        """
        place = sa.tuple_(jobs.c.created_at, jobs.c.id)
        query = sa.select(*_SUMMARY).order_by(jobs.c.created_at.desc(), jobs.c.id.desc()).limit(limit)
        with begin_reading(self.database) as connection:
            if before is not None:
                query = query.where(place < sa.tuple_(_summarise(connection, before).created_at, before))
            queries = [query.where(jobs.c.state == str(state)) for state in set(states)] or [query]
            found = [JobListRow.of(row) for one in queries for row in connection.execute(one).mappings()]
        return sorted(found, key=lambda job: (job.created_at, job.id), reverse=True)[:limit]

    def read_facts(self, rows: Sequence[JobListRow]) -> dict[str, JobFacts]:
        """Return the parts of spec and report that a list shows, by job; cached by version, because reading a report is
        slow.
        """
        found = {row.id: facts for row in rows if (facts := self._facts.get((row.id, row.version))) is not None}
        if unknown := [row.id for row in rows if row.id not in found]:
            query = sa.select(jobs.c.id, jobs.c.version, jobs.c.spec, jobs.c.report).where(jobs.c.id.in_(unknown))
            with begin_reading(self.database) as connection:
                read = {(row.id, row.version): JobFacts.of(row.spec, row.report) for row in connection.execute(query)}
            if len(self._facts) + len(read) > _MOST_FACTS:  # other threads may be reading the old ones
                self._facts = {}
            self._facts |= read
            found |= {row.id: read[row.id, row.version] for row in rows if (row.id, row.version) in read}
        return found

    def list_stages(self, job_id: str) -> list[StageRun]:
        """Return every try of every stage, in the order in which they began."""
        query = sa.select(stage_runs).where(stage_runs.c.job_id == job_id).order_by(stage_runs.c.id)
        with begin_reading(self.database) as connection:
            return [StageRun.of(row) for row in connection.execute(query).mappings()]

    def report_so_far(self, job: Job) -> dict[str, Any] | None:
        """Return the report of the stages that are done in this attempt; an ended job holds its report itself."""
        with begin_reading(self.database) as connection:
            return _read_reports(connection, [job.id]).get(job.id)

    def add_report(self, job: Job) -> Job:
        """Return the job; if it has not ended, with the reports of its finished stages."""
        return replace(job, report=self.report_so_far(job)) if _is_without_report(job) else job

    def list_with_programs(self, job_ids: Collection[str]) -> dict[str, tuple[Job, list[Artifact]]]:
        """Return the existing ones of these jobs, as `add_report` does, each with the programs that it offers."""
        with begin_reading(self.database) as connection:
            rows = connection.execute(sa.select(jobs).where(jobs.c.id.in_(job_ids))).mappings()
            found = {job.id: job for job in map(Job.of, rows)}
            reports = _read_reports(connection, [job.id for job in found.values() if _is_without_report(job)])
            programs = list_offered_programs(connection, found)
        found |= {job_id: replace(found[job_id], report=report) for job_id, report in reports.items()}
        return {job_id: (job, programs.get(job_id, [])) for job_id, job in found.items()}

    def may_be_milled(self, job: Job) -> bool:
        """Return whether its programs may be sent to a mill, as `job_rows.may_be_milled` decides."""
        with begin_reading(self.database) as connection:
            return may_be_milled(connection, job)

    def list_artifacts(self, job_id: str) -> list[Artifact]:
        """Return the files that the job offers, by name; programs only once they have been checked."""
        with begin_reading(self.database) as connection:
            get_job(connection, job_id)
            return list_offered_artifacts(connection, job_id)

    def find_artifact(self, job_id: str, name: str) -> Artifact:
        for artifact in self.list_artifacts(job_id):
            if artifact.name == name:
                return artifact
        raise UnknownArtifactError(job_id, name)

    def list_pictures(self, job_ids: Collection[str]) -> dict[str, str]:
        """Return, by job, the name of the small picture of its light; jobs without one are left out."""
        query = sa.select(artifacts.c.job_id, artifacts.c.name).where(
            artifacts.c.job_id.in_(job_ids), artifacts.c.name.in_(_PICTURES)
        )
        with begin_reading(self.database) as connection:
            found = sorted(connection.execute(query), key=lambda row: _PICTURES.index(row.name), reverse=True)
        return {row.job_id: row.name for row in found}  # of several, the last one counts

    def list_events(self, job_id: str, after: int = 0, limit: int = BATCH) -> list[JobEvent]:
        """Return events after the one numbered `after`, at most 500 of them."""
        with begin_reading(self.database) as connection:
            return read_events(connection, job_id, after, min(limit, BATCH))

    def read_news(self, after: Mapping[str, int]) -> News:
        """Return events of many jobs, each after the seq given for it, and the progress of those that run."""
        with begin_reading(self.database) as connection:
            return read_news(connection, after)

    def read_queue_positions(self) -> dict[str, int]:
        """Return the places of the first thousand waiting jobs, from 1 for the one that starts next."""
        query = (
            sa.select(jobs.c.id)
            .where(jobs.c.state == str(JobState.QUEUED))
            .order_by(jobs.c.priority, jobs.c.queued_at, jobs.c.id)
            .limit(MOST_POSITIONS)
        )
        with begin_reading(self.database) as connection:
            return {job_id: place for place, job_id in enumerate(connection.execute(query).scalars(), start=1)}


# ---------------------------------------------------------------------- steps inside a transaction


def drop_job(connection: sa.Connection, job: Job) -> None:
    """Delete all of a locked job except its ticket in the engine. JobOnMillError while a run of it is open."""
    _require_no_open_run(connection, job.id)
    connection.execute(idempotency_keys.delete().where(idempotency_keys.c.resource_id == job.id))
    connection.execute(jobs.delete().where(jobs.c.id == job.id))
    add_to_counters(connection, {state_counter(job.state): -1})


def find_oldest_queued_at(connection: sa.Connection) -> float | None:
    """Return when the longest waiting job was queued. The first job of each priority is looked up."""
    waiting = sa.select(sa.func.min(jobs.c.queued_at)).where(jobs.c.state == str(JobState.QUEUED))
    firsts = [connection.execute(waiting.where(jobs.c.priority == p)).scalar() for p in PRIORITIES.values()]
    return min((at for at in firsts if at is not None), default=None)


def count_jobs(found: Mapping[Counter, float]) -> dict[JobState, int]:
    """Return the number of jobs in each state, out of all counters."""
    return {state: int(found.get(state_counter(state), 0)) for state in JobState}


def _require_no_open_run(connection: sa.Connection, job_id: str) -> None:
    if (run_id := open_run_of(connection, job_id)) is not None:
        raise JobOnMillError(run_id)


def _is_without_report(job: Job) -> bool:
    return job.report is None and job.started_at is not None


def _read_reports(connection: sa.Connection, job_ids: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return, by job, the report of the stages that are done in its present attempt; jobs without any are left out."""
    if not job_ids:
        return {}
    done = stage_runs.c.state.in_([StageState.COMMITTED, StageState.REUSED])
    query = (
        sa.select(stage_runs.c.job_id, stage_results.c.report)
        .join(stage_results, stage_runs.c.key == stage_results.c.key)
        .join(jobs, sa.and_(jobs.c.id == stage_runs.c.job_id, jobs.c.attempt == stage_runs.c.attempt))
        .where(jobs.c.id.in_(job_ids), stage_runs.c.job_id.in_(job_ids), done)
        .order_by(stage_runs.c.id)
    )
    found: dict[str, list[dict[str, Any]]] = {}
    for row in connection.execute(query):
        found.setdefault(row.job_id, []).append(row.report)
    merged = {job_id: merge_reports(reports) for job_id, reports in found.items()}
    return {job_id: report for job_id, report in merged.items() if report}


def _summarise(connection: sa.Connection, job_id: str) -> JobListRow:
    row = connection.execute(sa.select(*_SUMMARY).where(jobs.c.id == job_id)).mappings().first()
    if row is None:
        raise UnknownJobError(job_id)
    return JobListRow.of(row)


def _first_row(new: NewJob, job_id: str, at: float) -> dict[str, Any]:
    return {
        "id": job_id,
        "name": printable(new.name)[:NAME_CHARS],
        "priority": new.priority,
        "spec": new.spec,
        "figures": new.figures,
        "image_sha256": new.image_sha256,
        "image_bytes": new.image_bytes,
        "created_by": new.created_by,
        "created_at": at,
        "fence": 0,
        "version": 1,
        **_fresh(1, at),
    }


def _fresh(attempt: int, at: float) -> dict[str, Any]:
    """Return the columns of a job that waits to be started."""
    return {
        "state": str(JobState.QUEUED),
        "attempt": attempt,
        "queued_at": at,
        "started_at": None,
        "ended_at": None,
        "stage": None,
        "progress": 0.0,
        "error": None,
        "report": None,
        "cancel_requested": False,
        "owner": None,
    }
