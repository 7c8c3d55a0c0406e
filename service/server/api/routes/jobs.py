"""Jobs: list, look, follow, cancel, retry, delete."""

from __future__ import annotations

import asyncio
from typing import Annotated, Literal
from urllib.parse import urlencode
from uuid import UUID

import structlog
from fastapi import APIRouter, Header, Path, Query, Request, Response

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.server.api.access.guard import Reader, Writer
from service.server.api.errors import Responses, event_stream, refusals
from service.server.api.job_views import read_summaries, read_view
from service.server.api.routes.submit import hand_to_engine
from service.server.api.services import Services, services_of
from service.server.database.records import Job, JobState, UnknownJobError
from service.server.queue.engine import Ticket
from service.server.schemas.jobs import JOB_ID, JobList, JobView

router = APIRouter(tags=["jobs"])
_log = structlog.get_logger("api")

JobId = Annotated[UUID, Path(alias="id", description="id of a job", examples=[JOB_ID])]
State = Literal["queued", "running", "succeeded", "failed", "cancelled"]


@router.get("/v1/jobs", summary="List jobs, newest first")
async def list_jobs(
    request: Request,
    _: Reader,
    state: Annotated[list[State] | None, Query(description="only jobs in this state; may be repeated")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    cursor: Annotated[UUID | None, Query(description="id of the last job of the page before")] = None,
) -> JobList:
    """A page of jobs without their report, spec and stages. `next` is the address of the following page."""
    before = None if cursor is None else str(cursor)
    return await asyncio.to_thread(
        _read_page, services_of(request), [JobState(word) for word in state or ()], limit, before
    )


@router.get(
    "/v1/jobs/{id:uuid}",
    summary="Look at a job",
    response_model=JobView,
    responses={304: {"description": "unchanged since the ETag in If-None-Match"}},
)
async def look(
    request: Request,
    response: Response,
    _: Reader,
    job_id: JobId,
    if_none_match: Annotated[str | None, Header()] = None,
) -> JobView | Response:
    """The whole job. `report` grows as stages end; `programs` appear once all of them have been checked."""
    services = services_of(request)
    job = await asyncio.to_thread(lambda: read_view(services, services.book.get(str(job_id))))
    headers = {"ETag": job.etag, "Cache-Control": "no-cache"}
    if matches(if_none_match, job.etag):
        return Response(status_code=304, headers=headers)
    if job.state in ("queued", "running"):
        headers["Retry-After"] = "1"
    response.headers.update(headers)
    return job


@router.post("/v1/jobs/{id:uuid}:cancel", summary="Cancel a job", responses=refusals(409))
async def cancel(request: Request, response: Response, principal: Writer, job_id: JobId) -> JobView:
    """A waiting job ends at once, a running one when its worker has stopped it, within two seconds. Calling it twice is
    fine.
    """
    services = services_of(request)

    def change() -> JobView:
        job = services.book.request_cancel(str(job_id), principal.name)
        if job.state is JobState.CANCELLED:
            _cancel_in_engine(services, job)
        return read_view(services, job)

    return _with_address(response, await asyncio.to_thread(change))


@router.post(
    "/v1/jobs/{id:uuid}:retry",
    summary="Run a failed or cancelled job again",
    status_code=202,
    responses=refusals(409, 507),
)
async def retry(request: Request, response: Response, principal: Writer, job_id: JobId) -> JobView:
    """Another attempt. Stages that were finished are not run again."""
    services = services_of(request)

    def change() -> JobView:
        job = services.book.retry(str(job_id), principal.name)
        hand_to_engine(services, job)
        return read_view(services, job)

    return _with_address(response, await asyncio.to_thread(change))


@router.delete(
    "/v1/jobs/{id:uuid}",
    summary="Delete a job",
    status_code=204,
    response_class=Response,
    responses={204: {"description": "gone, with its files"}, **refusals(409)},
)
async def delete(request: Request, _: Writer, job_id: JobId) -> Response:
    """Forget a job that does not run. Files that no other job has are removed from the disk some time later."""
    services = services_of(request)

    def change() -> None:
        _cancel_in_engine(services, services.book.delete(str(job_id)))

    await asyncio.to_thread(change)
    services.feed.drop_job(str(job_id))
    return Response(status_code=204)


def _read_page(services: Services, states: list[JobState], limit: int, before: str | None) -> JobList:
    try:
        found = services.book.list_rows(states=states, limit=limit + 1, before=before)
    except UnknownJobError:
        raise Problem(
            422, Phrase("the job of this cursor no longer exists; start again without the cursor"), field="cursor"
        ) from None
    page = found[:limit]
    more = [("state", str(state)) for state in states] + [("limit", str(limit))]
    address = "/v1/jobs?" + urlencode([*more, ("cursor", page[-1].id)]) if len(found) > limit else None
    return JobList(jobs=read_summaries(services, page), next=address)


def _cancel_in_engine(services: Services, job: Job) -> None:
    """Remove the job's ticket from the engine. A worker that starts it all the same sees the cancellation in the job
    book.
    """
    try:
        services.engine.cancel(Ticket(job.id, job.attempt))
    except Exception as error:  # the engine's database may fail in any way: the job book has the cancellation
        _log.warning("the engine has not been notified", job=job.id, error=str(error)[:200])


def _with_address(response: Response, job: JobView) -> JobView:
    response.headers.update({"ETag": job.etag, "Location": job.links["self"]})
    return job


_EVENTS = (
    'id: 1\nevent: queued\ndata: {"attempt":1,"by":"anonymous","at":"2026-11-21T08:00:00.000Z"}\n\n'
    'event: progress\ndata: {"stage":"map","share":0.5,"progress":0.21}\n\n'
    'id: 9\nevent: ended\ndata: {"state":"succeeded","attempt":1,"error":null,"at":"2026-11-21T08:01:00.000Z"}\n\n'
)
_STREAM: Responses = event_stream("the stream; it ends after the event `ended`", _EVENTS) | {
    204: {"description": "the job has ended and the client has every event: do not come back"},
}


@router.get("/v1/jobs/{id:uuid}/events", summary="Follow a job", response_class=Response, responses=_STREAM)
async def events(
    request: Request,
    _: Reader,
    job_id: JobId,
    last_event_id: Annotated[
        str | None, Header(alias="Last-Event-ID", description="id of the last event the client has", examples=["3"])
    ] = None,
) -> Response:
    """Every event of the job from the first, or after Last-Event-ID, then each new one as it happens.

    Kinds: queued, started, stage.started, stage.committed, stage.reused, stage.interrupted, stage.failed,
    cancel.requested, retried, ended. `progress` comes between them, without an id. A comment every 15 s shows that the
    connection lives. A reader that does not keep up is dropped and may come back with Last-Event-ID.
    """
    services = services_of(request)
    after = await asyncio.to_thread(_find_event, services, str(job_id), _after(last_event_id))
    if await asyncio.to_thread(_is_over, services, str(job_id), after):
        return Response(status_code=204)
    if services.feed.full:
        raise Problem(503, Phrase("too many followers already; ask again later"), headers={"Retry-After": "5"})
    return services.feed.stream(str(job_id), after or 0)


def _after(last_event_id: str | None) -> int | None:
    if last_event_id is None or not last_event_id.strip():
        return None
    text = last_event_id.strip()
    if not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise Problem(422, Phrase("this is not an event id of this server"), field="Last-Event-ID")
    return int(text)


def _find_event(services: Services, job_id: str, after: int | None) -> int | None:
    """Return the id, if there is such an event; else (the database is an older one, put back) the client begins
    anew.
    """
    return after if after and services.book.list_events(job_id, after - 1, 1) else None


def _is_over(services: Services, job_id: str, after: int | None) -> bool:
    """Return whether a client that comes back has nothing to wait for. UnknownJobError."""
    ended = services.book.get(job_id).ended
    return ended and after is not None and not services.book.list_events(job_id, after, 1)


def matches(if_none_match: str | None, etag: str) -> bool:
    """Return whether the client has this version already (weak comparison)."""
    if if_none_match is None:
        return False
    given = {tag.strip().removeprefix("W/") for tag in if_none_match.split(",")}
    return "*" in given or etag in given
