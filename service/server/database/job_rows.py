"""Rows of jobs, read and changed under a lock by the books of jobs, runs and claims; the event and the counters that
are written in the same transaction as a change; and the files that a job offers.

Counters are figures about all jobs, updated with each change, because counting a hundred thousand rows at each scrape
takes seconds. They change in the same transaction as the rows they count. A counter's row is locked until its
transaction ends. So that two transactions cannot wait for each other, each of them changes the counters of stages
before that of jobs, and rows of one call in the order of their keys.

A job offers the files of its committed stages, programs only once all of them have been checked. An attempt that was
begun by one version of this software and continues with another repeats finished stages, because a check is not valid
for programs that were made after it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from phrases.phrase import phrases_in
from service.job.files import is_one_program, is_program, program_order
from service.server.database.connection import insert_new, is_sqlite, put_rows
from service.server.database.records import (
    Artifact,
    ClientKey,
    Job,
    JobEvent,
    JobState,
    KeyReusedError,
    News,
    Progress,
    StageState,
    UnknownJobError,
    require_move,
)
from service.server.database.tables import (
    artifacts,
    counters,
    events,
    idempotency_keys,
    jobs,
    progress,
    runs,
    stage_runs,
)

BATCH = 500
MOST_NEWS = 10 * BATCH


@dataclass(frozen=True, slots=True, order=True)
class Counter:
    """The key of a row: "jobs" by state, "stage_runs" and "stage_seconds" by stage and state, others by name alone."""

    name: str
    stage: str = ""
    state: str = ""


ARTIFACT_BYTES = Counter("artifact_bytes")  # as found by the last sweep of the store
RECOVERIES = Counter("recoveries")
STAGE_RESULTS = Counter("stage_results")


def add_to_counters(connection: sa.Connection, changes: Mapping[Counter, float]) -> None:
    """Raise counters by these amounts, which may be negative."""
    insert = sqlite.insert if is_sqlite(connection) else postgresql.insert
    for counter in sorted(changes):
        row = {"name": counter.name, "stage": counter.stage, "state": counter.state, "value": changes[counter]}
        new = insert(counters).values(**row)
        raised = {"value": counters.c.value + new.excluded.value}
        connection.execute(new.on_conflict_do_update(index_elements=["name", "stage", "state"], set_=raised))


def set_counter(connection: sa.Connection, counter: Counter, value: float) -> None:
    row = {"name": counter.name, "stage": counter.stage, "state": counter.state, "value": value}
    put_rows(connection, counters, [row])


def read_counters(connection: sa.Connection) -> dict[Counter, float]:
    """Return all counters: a few dozen rows."""
    rows = connection.execute(sa.select(counters))
    return {Counter(row.name, row.stage, row.state): row.value for row in rows}


def write_event(connection: sa.Connection, job_id: str, kind: str, data: Mapping[str, Any], *, at: float) -> None:
    """Write the next event of a job. The caller holds the job's row, so seq has no gaps and no duplicates."""
    last = sa.select(sa.func.coalesce(sa.func.max(events.c.seq), 0)).where(events.c.job_id == job_id)
    seq = connection.execute(last).scalar_one() + 1
    connection.execute(events.insert().values(job_id=job_id, seq=seq, at=at, kind=kind, data=dict(data)))


def read_events(connection: sa.Connection, job_id: str, after: int, limit: int) -> list[JobEvent]:
    """Return events of a job after the one numbered `after`."""
    query = sa.select(events).where(events.c.job_id == job_id, events.c.seq > after).order_by(events.c.seq).limit(limit)
    return [JobEvent.of(row) for row in connection.execute(query).mappings()]


def read_news(connection: sa.Connection, after: Mapping[str, int]) -> News:
    """Return events of many jobs after the given ones, at most 5000, and the progress of their running stages.

    Usually there is nothing new, which one query for the last event of each job shows.
    """
    last = sa.func.max(events.c.seq)
    query = sa.select(events.c.job_id, last).where(events.c.job_id.in_(after)).group_by(events.c.job_id)
    found: list[JobEvent] = []
    for job_id, seq in connection.execute(query).all():
        if seq > after[job_id] and len(found) < MOST_NEWS:
            found += read_events(connection, job_id, after[job_id], MOST_NEWS - len(found))
    return News(events=found, progress=read_progress(connection, after))


def read_progress(connection: sa.Connection, job_ids: Collection[str]) -> dict[str, Progress]:
    query = (
        sa.select(progress, jobs.c.progress)
        .join(jobs, jobs.c.id == progress.c.job_id)
        .where(progress.c.job_id.in_(job_ids), jobs.c.state == "running", jobs.c.stage == progress.c.stage)
    )
    return {row["job_id"]: Progress.of(row) for row in connection.execute(query).mappings()}


def open_run_of(connection: sa.Connection, job_id: str) -> str | None:
    """Return the id of an open run of a program of this job, on any mill."""
    return connection.execute(sa.select(runs.c.id).where(runs.c.job_id == job_id, runs.c.open).limit(1)).scalar()


def claim_key(
    connection: sa.Connection, kind: str, key: ClientKey, request_sha256: str, resource_id: str, *, at: float
) -> bool:
    """Reserve a caller's key for a new job or run; do nothing and return False if it is already used."""
    row = {"principal": key.token, "kind": kind, "key": key.text, "request_sha256": request_sha256}
    return insert_new(connection, idempotency_keys, row | {"resource_id": resource_id, "created_at": at})


def find_by_key(connection: sa.Connection, kind: str, key: ClientKey, request_sha256: str) -> str | None:
    """Return the id of the job or run that this key has made. KeyReusedError if the key belongs to another request."""
    table = idempotency_keys.c
    mine = sa.and_(table.principal == key.token, table.kind == kind, table.key == key.text)
    row = connection.execute(sa.select(table.request_sha256, table.resource_id).where(mine)).first()
    if row is None:
        return None
    if row.request_sha256 != request_sha256:
        raise KeyReusedError(key.text)
    return str(row.resource_id)


def lock_job(connection: sa.Connection, job_id: str) -> Job:
    """Lock the job's row until the transaction ends. UnknownJobError."""
    row = connection.execute(sa.select(jobs).where(jobs.c.id == job_id).with_for_update()).mappings().first()
    if row is None:
        raise UnknownJobError(job_id)
    return Job.of(row)


def change_job(connection: sa.Connection, job: Job, **values: Any) -> None:
    """Write columns of a locked job, and increment its version. JobStateError for a move that the table does not
    allow.
    """
    state = JobState(values.get("state", job.state))
    if state is not job.state:
        require_move(job.state, state)
        add_to_counters(connection, {state_counter(job.state): -1, state_counter(state): 1})
    connection.execute(jobs.update().where(jobs.c.id == job.id).values(version=jobs.c.version + 1, **values))


def end_job(connection: sa.Connection, job: Job, state: JobState, *, at: float, **values: Any) -> None:
    """End a locked job: its state and the last event. Raises the fence, so that no one writes after it."""
    if (error := values.get("error")) is not None:
        values["error"] = error = error | {"phrases": phrases_in(error)}
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


CHECK = "check"
PASS = "pass-"
LOG = ".log"
DONE = (str(StageState.COMMITTED), str(StageState.REUSED))


def list_offered_artifacts(connection: sa.Connection, job_id: str) -> list[Artifact]:
    """List by name. Names that begin with a dot are between stages only; a program must have passed this attempt's
    check.
    """
    query = sa.select(artifacts).where(artifacts.c.job_id == job_id).order_by(artifacts.c.name)
    found = [Artifact.of(row) for row in connection.execute(query).mappings()]
    checked = bool(_find_checked_jobs(connection, [job_id]))
    return [one for one in found if not one.name.startswith(".") and (checked or not _is_program(one))]


def list_offered_programs(connection: sa.Connection, job_ids: Collection[str]) -> dict[str, list[Artifact]]:
    """List by job those of `list_offered_artifacts` that its passes have made, for many jobs at once."""
    found: dict[str, list[Artifact]] = {job_id: [] for job_id in _find_checked_jobs(connection, job_ids)}
    query = sa.select(artifacts).where(artifacts.c.job_id.in_(found)).order_by(artifacts.c.name)
    for row in connection.execute(query.where(artifacts.c.stage.startswith(PASS))).mappings():
        if _is_program(one := Artifact.of(row)):
            found[one.job_id].append(one)
    return found


def sort_programs(files: Iterable[Artifact]) -> list[Artifact]:
    """Return the programs among a job's files, in the order in which they are run: that of their pass and part."""
    return sorted((file for file in files if is_program(file.name)), key=lambda file: program_order(file.name))


def may_be_milled(connection: sa.Connection, job: Job) -> bool:
    """Return whether programs may be sent to mills: once they are checked, even if the job still draws their pictures;
    never those of a job that has failed or was cancelled.
    """
    if job.state is not JobState.RUNNING:
        return job.state is JobState.SUCCEEDED
    return not job.cancel_requested and bool(_find_checked_jobs(connection, [job.id]))


def _is_program(artifact: Artifact) -> bool:
    is_of_pass = artifact.stage.startswith(PASS) and not artifact.name.endswith(LOG)
    return is_of_pass or is_one_program(artifact.name)


def _find_checked_jobs(connection: sa.Connection, job_ids: Collection[str]) -> set[str]:
    """Return the jobs among these whose check is the last of their finished pass and check stages."""
    query = (
        sa.select(stage_runs.c.job_id, stage_runs.c.stage)
        .join(jobs, sa.and_(jobs.c.id == stage_runs.c.job_id, jobs.c.attempt == stage_runs.c.attempt))
        .where(jobs.c.id.in_(job_ids), stage_runs.c.job_id.in_(job_ids), stage_runs.c.state.in_(DONE))
        .where(sa.or_(stage_runs.c.stage == CHECK, stage_runs.c.stage.startswith(PASS)))
        .order_by(stage_runs.c.id)
    )
    last = {row.job_id: row.stage for row in connection.execute(query)}
    return {job_id for job_id, stage in last.items() if stage == CHECK}
