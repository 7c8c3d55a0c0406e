"""The files that a job offers: those of its committed stages, programs only once all of them have been checked; and
whether a mill may have its programs.

An attempt that was begun by one version of the program and goes on with another does stages again that were done: a
check is worth nothing for programs that were made after it.
"""

from __future__ import annotations

from collections.abc import Collection

import sqlalchemy as sa

from service.server.database.records import Artifact, Job
from service.server.database.states import JobState, StageState
from service.server.database.tables import artifacts, jobs, stage_runs

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
    checked = bool(_find_checked(connection, [job_id]))
    return [one for one in found if not one.name.startswith(".") and (checked or not _is_program(one))]


def list_offered_programs(connection: sa.Connection, job_ids: Collection[str]) -> dict[str, list[Artifact]]:
    """List by job those of `list_offered_artifacts` that its passes have made, for many jobs at once."""
    found: dict[str, list[Artifact]] = {job_id: [] for job_id in _find_checked(connection, job_ids)}
    query = sa.select(artifacts).where(artifacts.c.job_id.in_(found)).order_by(artifacts.c.name)
    for row in connection.execute(query.where(artifacts.c.stage.startswith(PASS))).mappings():
        if _is_program(one := Artifact.of(row)):
            found[one.job_id].append(one)
    return found


def may_be_milled(connection: sa.Connection, job: Job) -> bool:
    """Return whether mills may have programs: once they are checked, though the job goes on with pictures of what they
    make; never those of a job that has failed or was given up.
    """
    if job.state is not JobState.RUNNING:
        return job.state is JobState.SUCCEEDED
    return not job.cancel_requested and bool(_find_checked(connection, [job.id]))


def _is_program(artifact: Artifact) -> bool:
    return artifact.stage.startswith(PASS) and not artifact.name.endswith(LOG)


def _find_checked(connection: sa.Connection, job_ids: Collection[str]) -> set[str]:
    """Return those of the jobs whose last finished stage, of their passes and their check, is the check."""
    query = (
        sa.select(stage_runs.c.job_id, stage_runs.c.stage)
        .join(jobs, sa.and_(jobs.c.id == stage_runs.c.job_id, jobs.c.attempt == stage_runs.c.attempt))
        .where(jobs.c.id.in_(job_ids), stage_runs.c.job_id.in_(job_ids), stage_runs.c.state.in_(DONE))
        .where(sa.or_(stage_runs.c.stage == CHECK, stage_runs.c.stage.startswith(PASS)))
        .order_by(stage_runs.c.id)
    )
    last = {row.job_id: row.stage for row in connection.execute(query)}
    return {job_id for job_id, stage in last.items() if stage == CHECK}
