"""Rows of jobs, read and changed under a lock by whatever works on jobs, runs and claims."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from service.server.database.counters import Counter, add_to_counters
from service.server.database.events import write_event
from service.server.database.records import Job, UnknownJobError
from service.server.database.states import JobState, require_move
from service.server.database.tables import jobs, progress, runs


def open_run_of(connection: sa.Connection, job_id: str) -> str | None:
    """Return the id of an open run of a program of this job, on any mill."""
    return connection.execute(sa.select(runs.c.id).where(runs.c.job_id == job_id, runs.c.open).limit(1)).scalar()


def lock_job(connection: sa.Connection, job_id: str) -> Job:
    """Lock the job's row until the transaction ends. UnknownJobError."""
    row = connection.execute(sa.select(jobs).where(jobs.c.id == job_id).with_for_update()).mappings().first()
    if row is None:
        raise UnknownJobError(job_id)
    return Job.of(row)


def change_job(connection: sa.Connection, job: Job, **values: Any) -> None:
    """Write columns of a locked job, and count its version. JobStateError for a move that the table does not allow."""
    state = JobState(values.get("state", job.state))
    if state is not job.state:
        require_move(job.state, state)
        add_to_counters(connection, {state_counter(job.state): -1, state_counter(state): 1})
    connection.execute(jobs.update().where(jobs.c.id == job.id).values(version=jobs.c.version + 1, **values))


def end_job(connection: sa.Connection, job: Job, state: JobState, *, at: float, **values: Any) -> None:
    """End a locked job: its state and the last event. Raises the fence, so that no one writes after it."""
    error = values.get("error")
    row = {"state": str(state), "ended_at": at, "owner": None, "fence": job.fence + 1} | values
    connection.execute(progress.delete().where(progress.c.job_id == job.id))
    change_job(connection, job, **row)
    write_event(connection, job.id, "ended", {"state": str(state), "attempt": job.attempt, "error": error}, at=at)


def get_job(connection: sa.Connection, job_id: str) -> Job:
    row = connection.execute(sa.select(jobs).where(jobs.c.id == job_id)).mappings().first()
    if row is None:
        raise UnknownJobError(job_id)
    return Job.of(row)


def state_counter(state: JobState) -> Counter:
    return Counter("jobs", state=str(state))
