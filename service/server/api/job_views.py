"""Jobs and their files as the API shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from service.job.files import is_one_program, is_program
from service.job.spec.model import JobSpec
from service.job.spec.resolve import with_plan
from service.job.stages.table import usual_seconds
from service.server.api.services import Services
from service.server.database.job_rows import sort_programs
from service.server.database.jobs import MOST_POSITIONS
from service.server.database.records import (
    Artifact,
    Job,
    JobFacts,
    JobListRow,
    JobState,
    Progress,
    StageRun,
    priority_word,
)
from service.server.schemas.jobs import ArtifactView, ImageView, JobError, JobSummary, JobView, ProgramView, StageView

_MEDIA_TYPES = {
    ".json": "application/json",
    ".html": "text/html; charset=utf-8",
    ".png": "image/png",
    ".pdf": "application/pdf",
    ".stl": "model/stl",
    ".step": "model/step",
    ".stpZ": "model/step+zip",
    ".npz": "application/zip",
    ".log": "text/plain; charset=utf-8",
}
_PROGRAM_TYPE = "text/plain; charset=us-ascii"
_OTHER_TYPE = "application/octet-stream"
MEDIA_TYPES = sorted({kind.partition(";")[0] for kind in (*_MEDIA_TYPES.values(), _PROGRAM_TYPE, _OTHER_TYPE)})
_NO_EVENTS = 1 << 30  # after the last event of any job: only the progress is asked for


def make_summary(
    job: JobListRow, *, position: int | None, progress: Progress | None, picture: str | None, facts: JobFacts | None
) -> JobSummary:
    """Make a job as the list shows it; picture: the artifact to show for it; facts: None if it has changed."""
    address = f"/v1/jobs/{job.id}"
    links = {"self": address} | {kind: f"{address}/{kind}" for kind in ("events", "artifacts")}
    links["archive"] = f"{address}/archive.zip"
    if picture is not None:
        links["picture"] = f"{address}/artifacts/{picture}"
    return JobSummary(
        id=job.id,
        name=job.name,
        state=job.state,
        stage=job.stage,
        progress=_progress(job, progress),
        queue_position=position if job.state is JobState.QUEUED else None,
        priority=priority_word(job.priority),
        attempt=job.attempt,
        cancel_requested=job.cancel_requested,
        created_at=job.created_at,
        started_at=job.started_at,
        ended_at=job.ended_at,
        error=None if job.error is None else JobError(**job.error),
        image=ImageView(sha256=job.image_sha256, bytes=job.image_bytes),
        lens_mm=None if facts is None else facts.lens_mm,
        machine=None if facts is None else facts.machine,
        hours=None if facts is None else facts.hours,
        links=links,
        etag=etag(job, position=position, progress=progress),
    )


def make_view(
    job: Job,
    *,
    position: int | None,
    progress: Progress | None,
    picture: str | None,
    runs: Sequence[StageRun],
    files: Sequence[Artifact],
) -> JobView:
    """Make a job with its report, spec, stages and programs."""
    return JobView(
        **dict(
            make_summary(
                job, position=position, progress=progress, picture=picture, facts=JobFacts.of(job.spec, job.report)
            )
        ),
        report=job.report,
        spec=job.spec,
        stages=_stages(job, runs),
        programs=[_program(job.id, number, file) for number, file in enumerate(sort_programs(files), 1)],
    )


def etag(job: JobListRow, *, position: int | None, progress: Progress | None) -> str:
    """Return a tag that changes whenever the job's body changes."""
    share = round(_progress(job, progress) * 10_000)
    return f'"{job.attempt}-{job.version}-{position or 0}-{share}"'


def make_artifact_view(file: Artifact) -> ArtifactView:
    return ArtifactView(
        name=file.name,
        sha256=file.sha256,
        bytes=file.bytes,
        stage=file.stage,
        media_type=media_type(file.name),
        url=f"/v1/jobs/{file.job_id}/artifacts/{file.name}",
    )


def media_type(name: str) -> str:
    if is_program(name) or is_one_program(name):
        return _PROGRAM_TYPE
    return _MEDIA_TYPES.get(f".{name.rpartition('.')[2]}", _OTHER_TYPE)


def _program(job_id: str, number: int, file: Artifact) -> ProgramView:
    url = f"/v1/jobs/{job_id}/programs/{number}"
    return ProgramView(number=number, name=file.name, sha256=file.sha256, bytes=file.bytes, url=url)


def _progress(job: JobListRow, progress: Progress | None) -> float:
    live = progress.progress if progress is not None and job.state is JobState.RUNNING else job.progress
    return round(min(1.0, max(0.0, job.progress, live)), 4)


def _stages(job: Job, runs: Sequence[StageRun]) -> list[StageView]:
    """Return every stage of the job's plan, with its result in this attempt."""
    last: Mapping[str, StageRun] = {run.stage: run for run in runs if run.attempt == job.attempt}
    usual = usual_seconds(with_plan(JobSpec.model_validate(job.spec), job.report or {}))
    whole = sum(usual.values())
    return [_stage(name, own, own / whole, last.get(name)) for name, own in usual.items()]


def _stage(name: str, usual_s: float, share: float, run: StageRun | None) -> StageView:
    seconds = None if run is None or run.ended_at is None else round(max(0.0, run.ended_at - run.started_at), 3)
    return StageView(
        name=name,
        state="waiting" if run is None else run.state,
        share=round(share, 4),
        usual_s=round(usual_s, 2),
        seconds=seconds,
        started_at=None if run is None else run.started_at,
    )


def read_view(services: Services, job: Job) -> JobView:
    """Return the job with all its data in the job book."""
    book = services.book
    position = _position(job, book.read_queue_positions()) if job.state is JobState.QUEUED else None
    progress = book.read_news({job.id: _NO_EVENTS}).progress.get(job.id) if job.state is JobState.RUNNING else None
    runs, files = book.list_stages(job.id), book.list_artifacts(job.id)
    job = book.add_report(job)
    picture = book.list_pictures([job.id]).get(job.id)
    return make_view(job, position=position, progress=progress, runs=runs, files=files, picture=picture)


def read_summaries(services: Services, jobs: Sequence[JobListRow]) -> list[JobSummary]:
    book = services.book
    positions = book.read_queue_positions() if any(job.state is JobState.QUEUED for job in jobs) else {}
    running = {job.id: _NO_EVENTS for job in jobs if job.state is JobState.RUNNING}
    progress = book.read_news(running).progress
    pictures = book.list_pictures([job.id for job in jobs])
    facts = book.read_facts(jobs)
    return [
        make_summary(
            job,
            position=_position(job, positions),
            progress=progress.get(job.id),
            picture=pictures.get(job.id),
            facts=facts.get(job.id),
        )
        for job in jobs
    ]


def _position(job: JobListRow, positions: Mapping[str, int]) -> int:
    return positions.get(job.id, MOST_POSITIONS)
