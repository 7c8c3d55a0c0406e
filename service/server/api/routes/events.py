"""GET /v1/jobs/{id}/events: what happens to a job, as server-sent events."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Header, Request
from starlette.responses import Response

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.server.api.access.scopes import Reader
from service.server.api.openapi import Responses, answers, event_stream
from service.server.api.routes.jobs import JobId
from service.server.api.services import Services, services_of
from service.server.schemas.jobs import EVENTS_EXAMPLE

router = APIRouter(tags=["jobs"])

_STREAM: Responses = event_stream("the stream; it ends after the event `ended`", EVENTS_EXAMPLE) | {
    204: {"description": "the job has ended and the client has every event: do not come back"},
}


@router.get(
    "/v1/jobs/{id:uuid}/events",
    summary="Follow a job",
    response_class=Response,
    responses=answers(_STREAM),
)
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
    after = await asyncio.to_thread(_known, services, str(job_id), _after(last_event_id))
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


def _known(services: Services, job_id: str, after: int | None) -> int | None:
    """Return the id, if there is such an event; else (the database is an older one, put back) the client begins
    anew.
    """
    return after if after and services.book.list_events(job_id, after - 1, 1) else None


def _is_over(services: Services, job_id: str, after: int | None) -> bool:
    """Return whether a client that comes back has nothing to wait for. UnknownJobError."""
    ended = services.book.get(job_id).ended
    return ended and after is not None and not services.book.list_events(job_id, after, 1)
