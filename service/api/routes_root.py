"""GET /: what answers here, and where the rest is. Open to everybody: it tells nothing that is not in every answer."""

from __future__ import annotations

from html import escape
from importlib import metadata
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import HTMLResponse, JSONResponse, Response

from service.api.answers import answers, example
from service.api.schemas import Root

router = APIRouter(tags=["operations"])

_LINKS = {
    "jobs": "/v1/jobs",
    "machines": "/v1/machines",
    "runs": "/v1/runs",
    "openapi": "/openapi.json",
    "ready": "/readyz",
    "metrics": "/metrics",
}
_POLICY = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
_PAGE: dict[str, Any] = {"text/html": {"schema": {"type": "string"}}}
_EXAMPLE = example({"name": "causticmill", "version": "1.2.0", "links": _LINKS})
_HEADERS = {"Vary": "Accept", "X-Content-Type-Options": "nosniff"}


@router.get(
    "/",
    summary="What is here",
    response_model=Root,
    responses=answers({200: {"content": _EXAMPLE["content"] | _PAGE}}),
)
async def root(request: Request) -> Response:
    """Name, version and addresses; a page for people where Accept has text/html."""
    version = metadata.version("causticmill")
    if "text/html" in request.headers.get("accept", ""):
        return HTMLResponse(_page(version), headers=_HEADERS | {"Content-Security-Policy": _POLICY})
    return JSONResponse({"name": "causticmill", "version": version, "links": _LINKS}, headers=_HEADERS)


def _page(version: str) -> str:
    rows = "\n".join(f'<li><a href="{escape(path)}">{escape(name)}</a></li>' for name, path in _LINKS.items())
    return (
        '<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>causticmill</title>\n'
        f"<h1>causticmill {escape(version)}</h1>\n<p>A job server: pictures to caustic lenses. <code>causticmill "
        f"submit</code>, or:</p>\n<ul>\n{rows}\n</ul>\n"
    )
