"""What happened to jobs, in order. An event is written in the same transaction as the change it tells of."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import sqlalchemy as sa

from service.server.database.records import JobEvent, News, Progress
from service.server.database.tables import events, jobs, progress

BATCH = 500
MOST_NEWS = 10 * BATCH


def write_event(connection: sa.Connection, job_id: str, kind: str, data: Mapping[str, Any], *, at: float) -> None:
    """Write the next event of a job. The caller holds the job's row, so seq has no gaps and no doubles."""
    last = sa.select(sa.func.coalesce(sa.func.max(events.c.seq), 0)).where(events.c.job_id == job_id)
    seq = connection.execute(last).scalar_one() + 1
    connection.execute(events.insert().values(job_id=job_id, seq=seq, at=at, kind=kind, data=dict(data)))


def read_events(connection: sa.Connection, job_id: str, after: int, limit: int) -> list[JobEvent]:
    """Return events of a job after the one numbered `after`."""
    query = sa.select(events).where(events.c.job_id == job_id, events.c.seq > after).order_by(events.c.seq).limit(limit)
    return [JobEvent.of(row) for row in connection.execute(query).mappings()]


def read_news(connection: sa.Connection, after: Mapping[str, int]) -> News:
    """Return events of many jobs after the given ones, at most 5000, and how far their running stages are.

    Mostly nothing has happened: the last event of each job tells, by one query for all of them.
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
