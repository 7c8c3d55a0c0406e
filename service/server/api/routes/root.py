"""GET /: what answers here, and where the rest is. Open to everybody: it tells nothing that is not in every answer."""

from __future__ import annotations

import asyncio
from importlib import metadata
from typing import Any

from fastapi import APIRouter, Request, Response

from service.server.api.openapi import answers, example
from service.server.api.routes import page
from service.server.schemas.jobs import Root

router = APIRouter(tags=["operations"])

_LINKS = {
    "jobs": "/v1/jobs",
    "machines": "/v1/machines",
    "runs": "/v1/runs",
    "openapi": "/openapi.json",
    "ready": "/readyz",
    "metrics": "/metrics",
}
_PAGE: dict[str, Any] = {"text/html": {"schema": {"type": "string"}}}
_EXAMPLE = example({"name": "causticmill", "version": "1.2.0", "links": _LINKS})
_HEADERS = {"Vary": "Accept", "X-Content-Type-Options": "nosniff"}


@router.get(
    "/",
    summary="What is here",
    response_model=Root,
    responses=answers({200: {"content": _EXAMPLE["content"] | _PAGE}}),
)
async def root(request: Request, response: Response) -> Root | Response:
    """Name, version and addresses; the operator page where Accept has text/html."""
    if "text/html" in request.headers.get("accept", ""):
        return await asyncio.to_thread(page.index, request)
    response.headers.update(_HEADERS)
    return Root(name="causticmill", version=metadata.version("causticmill"), links=_LINKS)
