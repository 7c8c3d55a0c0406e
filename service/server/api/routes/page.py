"""GET /: name, version and addresses of this server; and the operator page, with its files under /page/. Open to
everybody: the page contains no data, and / contains nothing that is not in every answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import asdict
from importlib import metadata
from typing import Any

from fastapi import APIRouter, Request, Response

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.job.report.pictures import PICTURES
from service.job.spec.loading import DEFAULT_JOB
from service.job.spec.model import JobSpec
from service.page.files import INDEX, PageFile, PageFiles
from service.server.api.routes.jobs import matches
from service.server.schemas.jobs import Root

PREFIX = "/page/"

# Everything comes from this server: a stranger's text that gets into the page can load and send nothing.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": _POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

MADE: dict[str, tuple[str, Callable[[], object]]] = {
    "new/spec_schema.js": ("SCHEMA", lambda: {**JobSpec.model_json_schema(), "default": DEFAULT_JOB}),
    "job/report_pictures.js": ("PICTURES", lambda: [asdict(picture) for picture in PICTURES]),
}
"""Modules of what the page would else have to list itself."""

_LINKS = {
    "jobs": "/v1/jobs",
    "machines": "/v1/machines",
    "runs": "/v1/runs",
    "openapi": "/openapi.json",
    "ready": "/readyz",
    "metrics": "/metrics",
}
_PAGE_ANSWER: dict[str, Any] = {"text/html": {"schema": {"type": "string"}}}
_ROOT_HEADERS = {"Vary": "Accept", "X-Content-Type-Options": "nosniff"}

router = APIRouter()
_files = PageFiles(made=MADE)


@router.api_route(PREFIX + "{path:path}", methods=["GET", "HEAD"], include_in_schema=False)
def file(request: Request, path: str) -> Response:
    """In a thread of a separate pool, because a disk may be slow."""
    found = _files.file(path)
    if found is None:
        raise Problem(404, Phrase("the page has no file '{path}'", path=path[:100]), field="path")
    return _answer_file(request, found)


def _index(request: Request) -> Response:
    """Return the page that a browser gets at /."""
    found = _files.file(INDEX)
    if found is None:
        raise Problem(404, Phrase("the page is not installed"), field="path")
    return _answer_file(request, found, vary="Accept, Accept-Encoding")


def _answer_file(request: Request, found: PageFile, *, vary: str = "Accept-Encoding") -> Response:
    packed = found.packed if _takes_gzip(request.headers.get("accept-encoding", "")) else None
    etag = f'"{found.etag}{"-gz" if packed is not None else ""}"'
    headers = _HEADERS | {"ETag": etag, "Vary": vary}
    if matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    headers |= {"Content-Encoding": "gzip"} if packed is not None else {}
    content = found.content if packed is None else packed
    if request.method == "HEAD":
        headers["Content-Length"] = str(len(content))
        content = b""
    return Response(content, headers=headers, media_type=found.media_type)


def _takes_gzip(header: str) -> bool:
    """Return whether gzip is named, and not with the weight 0 (RFC 9110)."""
    for coding in header.lower().split(","):
        name, _, weight = coding.replace(" ", "").partition(";q=")
        if name == "gzip":
            return weight not in ("0", "0.0", "0.00", "0.000")
    return False


@router.get(
    "/",
    tags=["operations"],
    summary="What is here",
    response_model=Root,
    responses={200: {"content": _PAGE_ANSWER}},
)
async def root(request: Request, response: Response) -> Root | Response:
    """Name, version and addresses; the operator page where Accept has text/html."""
    if "text/html" in request.headers.get("accept", ""):
        return await asyncio.to_thread(_index, request)
    response.headers.update(_ROOT_HEADERS)
    return Root(name="causticmill", version=metadata.version("causticmill"), links=_LINKS)
