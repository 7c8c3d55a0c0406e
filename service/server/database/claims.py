"""The workers' part of the job book. Each write names the fence under which the worker claimed the job. If another
worker has claimed it since, or it has ended, the write changes nothing and raises `Fenced`.
"""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from service.errors import printable
from service.job.stages.order import FileRef, StageResult
from service.server.database.connection import begin_reading, begin_writing, clock, insert_new, put_rows
from service.server.database.job_rows import (
    DONE,
    RECOVERIES,
    STAGE_RESULTS,
    Counter,
    add_to_counters,
    change_job,
    end_job,
    lock_job,
    write_event,
)
from service.server.database.records import Job, JobState, Json, StageState, UnknownJobError
from service.server.database.tables import artifacts, executors, jobs, progress, result_files, stage_results, stage_runs
from service.server.queue.engine import Fenced, Ticket

WORDS_CHARS = 2000
# Interruptions caused by the worker, not by the stage; they do not count as tries.
LOST = "its worker ended, or was not heard of for too long"
STOPPED = "its worker was stopped"


@dataclass(frozen=True, slots=True)
class Claim:
    """This worker owns the job until the fence is raised again. `job` is as it was when claimed."""

    job: Job
    executor: str
    fence: int


@dataclass(frozen=True, slots=True)
class StageTry:
    """A row of stage_runs that this worker has begun."""

    id: int
    stage: str
    key: str
    number: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StageClose:
    """The end of a try without a result. `log`: of its process."""

    state: StageState
    words: str
    log: FileRef | None = None


class WorkBook:
    """Jobs of one database, for the workers that run them."""

    def __init__(self, database: sa.Engine, *, lease_s: float) -> None:
        self._database = database
        self._lease_s = lease_s

    def claim(self, ticket: Ticket, executor: str) -> Claim | None:
        """Claim the job of a ticket; None if there is nothing (more) to do. Fenced while another live worker owns
        it.

        Tries that an earlier owner left open become `interrupted`.
        """
        with begin_writing(self._database) as connection:
            try:
                job, at = lock_job(connection, ticket.job_id), clock(connection)
            except UnknownJobError:
                return None
            if job.ended or job.attempt != ticket.attempt:
                return None
            if job.owner not in (None, executor) and self._is_alive(connection, job.owner or "", at):
                raise Fenced(f"{job.owner} runs it")
            interrupt_tries(connection, job, at=at)
            if job.cancel_requested:
                end_job(connection, job, JobState.CANCELLED, at=at)
                return None
            fence = job.fence + 1
            if job.state == JobState.QUEUED:
                write_event(connection, job.id, "started", {"executor": executor, "attempt": job.attempt}, at=at)
            else:
                add_to_counters(connection, {RECOVERIES: 1})
            state = str(JobState.RUNNING)
            change_job(connection, job, state=state, started_at=job.started_at or at, owner=executor, fence=fence)
            return Claim(job, executor, fence)

    def begin_stage(self, claim: Claim, stage: str, key: str) -> StageTry:
        """Begin a try of a stage."""
        with begin_writing(self._database) as connection:
            job, at = _lock_held_job(connection, claim), clock(connection)
            interrupt_tries(connection, job, at=at)
            begun = _add_try(connection, claim, stage, key, StageState.RUNNING, at=at)
            put_rows(connection, progress, [{"job_id": job.id, "stage": stage, "share": 0.0, "at": at}])
            change_job(connection, job, stage=stage)
            write_event(connection, job.id, "stage.started", {"stage": stage, "number": begun.number}, at=at)
            return begun

    def find_result(self, key: str) -> StageResult | None:
        """Return the result of equal earlier work, if there is any."""
        with begin_reading(self._database) as connection:
            row = connection.execute(sa.select(stage_results).where(stage_results.c.key == key)).mappings().first()
        return None if row is None else _result_of(row)

    def reuse_stage(self, claim: Claim, stage: str, key: str, *, whole: float) -> StageResult | None:
        """Take over the result of equal work done before for this job; None if there is none."""
        with begin_writing(self._database) as connection:
            job, at = _lock_held_job(connection, claim), clock(connection)
            used = stage_results.update().where(stage_results.c.key == key).values(used_at=at)
            if connection.execute(used).rowcount == 0:
                return None
            row = connection.execute(sa.select(stage_results).where(stage_results.c.key == key)).mappings().one()
            result = _result_of(row)
            if _is_done(connection, claim, stage, key):
                return result  # this job's own, before its worker was interrupted
            _add_try(connection, claim, stage, key, StageState.REUSED, at=at)
            _offer(connection, job, stage, result.outputs, at)
            change_job(connection, job, stage=stage, progress=whole)
            write_event(connection, job.id, "stage.reused", {"stage": stage, "from": row["job_id"]}, at=at)
            return result

    def forget_result(self, key: str) -> None:
        """Delete a result whose files are no longer in the store, so that its work is done again."""
        with begin_writing(self._database) as connection:
            drop_results(connection, [key])

    def commit_stage(
        self, claim: Claim, begun: StageTry, result: StageResult, *, log: FileRef | None, whole: float
    ) -> None:
        """Commit a finished stage: its files belong to the job, and other jobs with equal work take its result."""
        with begin_writing(self._database) as connection:
            job, at = _lock_held_job(connection, claim), clock(connection)
            if _is_closed(connection, begun):
                return  # repeated, because the answer to the first call was lost
            state, peak = str(StageState.COMMITTED), result.peak_rss_mb
            _close_try(connection, begun, state=state, ended_at=at, peak_rss_mb=peak, log_sha256=log and log.sha256)
            add_to_counters(connection, {Counter("stage_seconds", begun.stage, state): result.seconds})
            row = result.plain() | {"key": begun.key, "stage": begun.stage, "job_id": job.id}
            if insert_new(connection, stage_results, row | {"created_at": at, "used_at": at}):
                rows = [
                    {"key": begun.key, "name": name, "sha256": file.sha256} for name, file in result.outputs.items()
                ]
                if rows:
                    connection.execute(result_files.insert(), rows)
                add_to_counters(connection, {STAGE_RESULTS: 1})
            offered = result.outputs if log is None else {**result.outputs, f"{begun.stage}.log": log}
            _offer(connection, job, begun.stage, offered, at)
            change_job(connection, job, progress=whole)
            data = {"stage": begun.stage, "number": begun.number, "seconds": result.seconds}
            write_event(connection, job.id, "stage.committed", data, at=at)

    def end_stage(self, claim: Claim, begun: StageTry, close: StageClose) -> None:
        """End a try without a result: interrupted (tried again), failed or cancelled."""
        with begin_writing(self._database) as connection:
            job, at = _lock_held_job(connection, claim), clock(connection)
            if _is_closed(connection, begun):
                return
            words = printable(close.words)[:WORDS_CHARS]
            log = close.log and close.log.sha256
            _close_try(connection, begun, state=str(close.state), ended_at=at, words=words, log_sha256=log)
            if close.log is not None:
                name = f"{begun.stage}.log"
                put_rows(connection, artifacts, [_artifact(job.id, name, close.log, begun.stage, at)])
            change_job(connection, job)
            if close.state != StageState.CANCELLED:
                data = {"stage": begun.stage, "number": begun.number, "words": words}
                write_event(connection, job.id, f"stage.{close.state}", data, at=at)

    def note_progress(self, claim: Claim, stage: str, share: float, *, whole: float) -> None:
        """Record the progress of the stage (`share`) and the job (`whole`). Do nothing if the job is no longer ours."""
        ours = sa.and_(jobs.c.id == claim.job.id, jobs.c.fence == claim.fence)
        with begin_writing(self._database) as connection:
            if connection.execute(jobs.update().where(ours).values(progress=whole)).rowcount:
                row = {"job_id": claim.job.id, "stage": stage, "share": share, "at": clock(connection)}
                put_rows(connection, progress, [row])

    def finish(self, claim: Claim, state: JobState, *, error: Json | None = None, report: Json | None = None) -> None:
        """Finish the job. One that was cancelled in its last moment is cancelled, not finished."""
        with begin_writing(self._database) as connection:
            job, at = _lock_held_job(connection, claim), clock(connection)
            values: Json = {"error": error, "report": report}
            if state == JobState.SUCCEEDED and job.cancel_requested:
                state, values = JobState.CANCELLED, {}
            elif state == JobState.SUCCEEDED:
                values["progress"] = 1.0
            end_job(connection, job, state, at=at, **values)

    def count_crashes(self, claim: Claim, stage: str) -> int:
        """Return how often a stage has crashed in this attempt while its worker lived."""
        table = stage_runs.c
        query = (
            sa.select(sa.func.count())
            .select_from(stage_runs)
            .where(table.job_id == claim.job.id, table.attempt == claim.job.attempt, table.stage == stage)
            .where(table.state == StageState.INTERRUPTED, table.words.not_in((LOST, STOPPED)))
        )
        with begin_reading(self._database) as connection:
            return int(connection.execute(query).scalar_one())

    def read_wishes(self, claims: Iterable[Claim]) -> dict[str, str]:
        """Return for each job "go", "cancelled" (a person has cancelled it) or "fenced" (it is no longer ours)."""
        held = {claim.job.id: claim.fence for claim in claims}
        query = sa.select(jobs.c.id, jobs.c.fence, jobs.c.state, jobs.c.cancel_requested).where(jobs.c.id.in_(held))
        with begin_reading(self._database) as connection:
            rows = {row.id: row for row in connection.execute(query)}
        return {job_id: _wish(rows.get(job_id), fence) for job_id, fence in held.items()}

    def _is_alive(self, connection: sa.Connection, executor: str, at: float) -> bool:
        query = sa.select(executors.c.seen_at).where(executors.c.id == executor)
        seen_at = connection.execute(query).scalar()
        return seen_at is not None and at - seen_at < self._lease_s


def interrupt_tries(connection: sa.Connection, job: Job, *, at: float) -> None:
    """Close the tries of a locked job that its dead owner left open."""
    running = sa.and_(stage_runs.c.job_id == job.id, stage_runs.c.state == str(StageState.RUNNING))
    query = sa.select(stage_runs.c.id, stage_runs.c.stage, stage_runs.c.number).where(running)
    rows = connection.execute(query).all()
    for row in rows:
        data = {"stage": row.stage, "number": row.number, "words": LOST}
        write_event(connection, job.id, "stage.interrupted", data, at=at)
    add_to_counters(connection, Tally(Counter("stage_runs", row.stage, StageState.INTERRUPTED) for row in rows))
    closed = {"state": str(StageState.INTERRUPTED), "ended_at": at, "words": LOST}
    connection.execute(stage_runs.update().where(running).values(**closed))


def drop_results(connection: sa.Connection, keys: Collection[str]) -> int:
    """Delete the results of stages, so that equal work is done again. Return their number."""
    dropped = connection.execute(stage_results.delete().where(stage_results.c.key.in_(keys))).rowcount
    add_to_counters(connection, {STAGE_RESULTS: -dropped})
    return dropped


def _lock_held_job(connection: sa.Connection, claim: Claim) -> Job:
    """Return the locked job, still ours."""
    try:
        job = lock_job(connection, claim.job.id)
    except UnknownJobError:
        raise Fenced("the job is gone") from None
    if job.fence != claim.fence or job.state != JobState.RUNNING:
        raise Fenced(f"owned by {job.owner or 'nobody'}")
    return job


def _add_try(
    connection: sa.Connection, claim: Claim, stage: str, key: str, state: StageState, *, at: float
) -> StageTry:
    mine = sa.and_(stage_runs.c.job_id == claim.job.id, stage_runs.c.stage == stage)
    number = connection.execute(sa.select(sa.func.count()).select_from(stage_runs).where(mine)).scalar_one() + 1
    row = {"job_id": claim.job.id, "attempt": claim.job.attempt, "number": number, "stage": stage, "key": key}
    row |= {"state": str(state), "executor": claim.executor, "fence": claim.fence, "started_at": at}
    if state != StageState.RUNNING:
        row["ended_at"] = at
        add_to_counters(connection, {Counter("stage_runs", stage, str(state)): 1})
    inserted = connection.execute(stage_runs.insert().values(**row)).inserted_primary_key
    assert inserted is not None
    return StageTry(int(inserted[0]), stage, key, number)


def _is_done(connection: sa.Connection, claim: Claim, stage: str, key: str) -> bool:
    """Return whether this attempt has done the stage, and has not repeated an earlier stage since."""
    table = stage_runs.c
    mine = sa.and_(table.job_id == claim.job.id, table.attempt == claim.job.attempt, table.state.in_(DONE))
    rows = connection.execute(sa.select(table.stage, table.key).where(mine).order_by(table.id)).all()
    places = [place for place, row in enumerate(rows) if row == (stage, key)]
    if not places:
        return False
    before, after = rows[: places[-1]], rows[places[-1] + 1 :]
    return {row.stage for row in before}.isdisjoint(row.stage for row in after)


def _is_closed(connection: sa.Connection, begun: StageTry) -> bool:
    state = connection.execute(sa.select(stage_runs.c.state).where(stage_runs.c.id == begun.id)).scalar_one()
    return state != StageState.RUNNING


def _close_try(connection: sa.Connection, begun: StageTry, *, state: str, **values: Any) -> None:
    add_to_counters(connection, {Counter("stage_runs", begun.stage, state): 1})
    connection.execute(stage_runs.update().where(stage_runs.c.id == begun.id).values(state=state, **values))


def _offer(connection: sa.Connection, job: Job, stage: str, files: Mapping[str, FileRef], at: float) -> None:
    """Offer the files of a stage as the job's, in place of those from an earlier attempt."""
    old = sa.and_(artifacts.c.job_id == job.id, artifacts.c.stage == stage)
    connection.execute(artifacts.delete().where(old))
    put_rows(connection, artifacts, [_artifact(job.id, name, file, stage, at) for name, file in files.items()])


def _artifact(job_id: str, name: str, file: FileRef, stage: str, at: float) -> Json:
    return {
        "job_id": job_id,
        "name": name,
        "sha256": file.sha256,
        "bytes": file.bytes,
        "stage": stage,
        "created_at": at,
    }


def _result_of(row: Mapping[Any, Any]) -> StageResult:
    names = ("outputs", "report", "notes", "seconds", "peak_rss_mb")
    return StageResult.from_plain({name: row[name] for name in names})


def _wish(row: Any, fence: int) -> str:
    if row is None or row.fence != fence or row.state != JobState.RUNNING:
        return "fenced"
    return "cancelled" if row.cancel_requested else "go"
