"""A job's JSON, read from the book: what the routes that answer with a job have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from service.api import views
from service.api.services import Services
from service.jobs.book import MOST_POSITIONS
from service.jobs.records import Job, JobSummary
from service.jobs.states import JobState


def whole_job(services: Services, job: Job) -> dict[str, Any]:
    book = services.book
    position = _position(job, book.queue_positions()) if job.state is JobState.QUEUED else None
    progress = book.latest({job.id: _NO_EVENTS}).progress.get(job.id) if job.state is JobState.RUNNING else None
    runs, files = book.stages(job.id), book.artifacts(job.id)
    job = book.with_report(job)
    picture = book.pictures([job.id]).get(job.id)
    return views.whole(job, position=position, progress=progress, runs=runs, files=files, picture=picture)


def job_list(services: Services, jobs: Sequence[JobSummary]) -> list[dict[str, Any]]:
    book = services.book
    positions = book.queue_positions() if any(job.state is JobState.QUEUED for job in jobs) else {}
    running = {job.id: _NO_EVENTS for job in jobs if job.state is JobState.RUNNING}
    progress = book.latest(running).progress
    pictures = book.pictures([job.id for job in jobs])
    places = [_position(job, positions) for job in jobs]
    return [
        views.summary(job, position=place, progress=progress.get(job.id), picture=pictures.get(job.id))
        for job, place in zip(jobs, places, strict=True)
    ]


def _position(job: JobSummary, positions: Mapping[str, int]) -> int:
    return positions.get(job.id, MOST_POSITIONS)


_NO_EVENTS = 1 << 30  # after the last event of any job: only the progress is asked for
