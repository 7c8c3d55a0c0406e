"""For whoever runs the server: is it alive, can it work, and in figures how it does."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Depends, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST

from phrases.phrase import Phrase, join
from service.http.problems import Kind, Problem
from service.server.api.access.guard import ADMIN, caller_of, require
from service.server.api.errors import Responses
from service.server.api.services import services_of
from service.server.schemas.jobs import Alive, Ready

router = APIRouter(tags=["operations"])


async def _require_here_or_known(request: Request) -> None:
    """Admit callers on this computer, or with any token."""
    if not caller_of(request.scope).open_here:
        await require()(request, None)


async def _require_here_or_admin(request: Request) -> None:
    if not caller_of(request.scope).open_here:
        await require(ADMIN)(request, None)


Known = Depends(_require_here_or_known)
Admin = Depends(_require_here_or_admin)
_PLAIN: dict[str, Any] = {
    "text/plain": {"schema": {"type": "string"}, "example": 'causticmill_jobs{state="queued"} 0\n'}
}
_METRICS: Responses = {200: {"description": "Prometheus text format", "content": _PLAIN}}


@router.get("/livez", summary="Is the process alive?", dependencies=[Known])
async def livez() -> Alive:
    """Answers as long as the process does; asks nothing of the database."""
    return Alive(alive=True)


@router.get("/readyz", summary="Can the server do its work?", dependencies=[Known])
async def readyz(request: Request) -> Ready:
    """Writes to the database and to the artifact store, looks for a live worker and for free disk space."""
    services = services_of(request)
    checks = await services.readiness.checks()
    wrong = {name: words for name, words in checks.items() if words != "ok"}
    if wrong:
        detail = join("; ", (Phrase("{name}: {words}", name=name, words=words) for name, words in wrong.items()))
        more = {"ready": False, "checks": checks}
        raise Problem(
            503, detail, field=next(iter(wrong)), kind=Kind.NOT_READY, headers={"Retry-After": "2"}, more=more
        )
    return Ready(ready=True, checks=checks)


@router.get(
    "/metrics",
    summary="Figures for Prometheus",
    dependencies=[Admin],
    response_class=Response,
    responses=_METRICS,
)
async def metrics(request: Request) -> Response:
    """Jobs, stages and artifacts by the database; requests by this process since its start."""
    services = services_of(request)
    services.metrics.followers.set(services.feed.followers)
    try:
        text = await services.metrics.text()
    except TimeoutError:
        raise Problem(503, Phrase("the figures have not been computed yet"), headers={"Retry-After": "2"}) from None
    return Response(text, headers={"Content-Type": CONTENT_TYPE_LATEST})
