"""The files of a job: listing; downloads that can be resumed, whole or a range, from the store's own address where it
has one; and all of them in one zip, made while it is sent, the same bytes for the same files.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import re
import zipfile
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal
from urllib.parse import quote

from fastapi import APIRouter, Depends, Header, Path, Request
from starlette.responses import RedirectResponse, Response, StreamingResponse

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.job.files import is_drawing, zip_entry
from service.server.api.access.guard import Reader
from service.server.api.errors import Responses, refusals
from service.server.api.intake.form import harmless_name
from service.server.api.job_views import MEDIA_TYPES, make_artifact_view, media_type
from service.server.api.routes.jobs import JobId, matches
from service.server.api.services import services_of
from service.server.database.job_rows import sort_programs
from service.server.database.records import Artifact
from service.server.schemas.jobs import ArtifactList
from service.store.base import Store

router = APIRouter(tags=["artifacts"])


def name_download(kind: Literal["inline", "attachment"], name: str) -> str:
    """Return the value of Content-Disposition (RFC 6266).

    A name that is not plain ASCII is encoded by RFC 8187, beside an ASCII one for clients that cannot read that.
    """
    plain = "".join(c if c.isascii() and c.isprintable() and c not in '"\\%' else "_" for c in name)
    shown = f'{kind}; filename="{plain}"'
    return shown if plain == name else f"{shown}; filename*=UTF-8''{quote(name.encode('utf-8', 'replace'), safe='')}"


_INLINE = ("image/png", "application/json", "text/html; charset=utf-8", "text/plain; charset=utf-8")
# A report is a page with pictures beside it and no scripts: it gets no rights over this server's pages.
_PAGE_POLICY = "sandbox; default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'"
_ONE_RANGE = re.compile(r"bytes=\s*(\d{0,18})-(\d{0,18})\s*", re.IGNORECASE)


Ranged = Annotated[
    str | None, Header(alias="Range", description="bytes=FIRST-LAST; one range", examples=["bytes=0-99"])
]
IfRange = Annotated[str | None, Header(description="the ETag of the file whose beginning the client has")]
IfNoneMatch = Annotated[str | None, Header(description="the ETag of the file that the client has")]


@dataclass(frozen=True, slots=True)
class Conditions:
    """The headers of a request that concern downloads."""

    range: Ranged = None
    if_range: IfRange = None
    if_none_match: IfNoneMatch = None


Asked = Annotated[Conditions, Depends()]


async def download(
    store: Store, file: Artifact, conditions: Conditions, *, with_body: bool, elsewhere: bool = True
) -> Response:
    """Send the file; MissingObjectError if the store has lost it. `elsewhere`: the caller may be redirected to the
    store itself.

    A bucket knows the file by its hash only: pages, and the pictures in them, always come from here.
    """
    kind, tag = media_type(file.name), f'"{file.sha256}"'
    headers = _headers(file, kind, tag)
    if matches(conditions.if_none_match, tag):
        return Response(status_code=304, headers=headers)
    asked = conditions.range if with_body else None  # RFC 9110, 14.2: GET is the only method that has ranges
    part = parse_range(asked, conditions.if_range, size=file.bytes, etag=tag)
    if with_body and elsewhere and kind not in _INLINE:
        url = await asyncio.to_thread(store.url, file.sha256, file_name=file.name, media_type=kind)
        if url is not None:
            named = headers["Content-Disposition"]
            return RedirectResponse(
                url, status_code=307, headers={"ETag": tag, "Cache-Control": "no-store", "Content-Disposition": named}
            )
    start, end = part or (0, file.bytes)
    if part is not None:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{file.bytes}"
    headers["Content-Length"] = str(end - start)
    status = 200 if part is None else 206
    if not with_body:
        await asyncio.to_thread(store.head, file.sha256)
        return Response(status_code=status, headers=headers, media_type=kind)
    pieces = await asyncio.to_thread(store.open_range, file.sha256, start, end)
    return StreamingResponse(iterate_in_threads(pieces), status_code=status, headers=headers, media_type=kind)


async def iterate_in_threads(pieces: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Make each piece in a thread, when the one before has been taken; one more is ready at any time."""
    ahead = asyncio.ensure_future(asyncio.to_thread(next, pieces, None))
    try:
        while (piece := await ahead) is not None:
            ahead = asyncio.ensure_future(asyncio.to_thread(next, pieces, None))
            yield piece
    finally:
        await asyncio.wait({ahead})
        with contextlib.suppress(asyncio.CancelledError, Exception):
            ahead.result()  # otherwise the loop logs an error that nobody retrieved
        if close := getattr(pieces, "close", None):
            close()


def _headers(file: Artifact, kind: str, tag: str) -> dict[str, str]:
    headers = {
        "ETag": tag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        "Content-Disposition": name_download("inline" if kind in _INLINE else "attachment", file.name),
        "X-Content-Type-Options": "nosniff",
    }
    return headers | ({"Content-Security-Policy": _PAGE_POLICY} if kind.startswith("text/html") else {})


def parse_range(range_header: str | None, if_range: str | None, *, size: int, etag: str) -> tuple[int, int] | None:
    """Start and end (exclusive); None for the whole file. Problem 416 where there is no such part.

    An invalid range, or several ranges, are answered with the whole file, as the RFC allows. An If-Range that is not
    this ETag means that the client's beginning belongs to another version.
    """
    if range_header is None or (if_range is not None and if_range.strip() != etag):
        return None
    asked = _ONE_RANGE.fullmatch(range_header)
    if asked is None or not any(asked.groups()):
        return None
    first, last = asked.groups()
    if not first:
        start, end = max(0, size - int(last)), size
    else:
        start, end = int(first), min(size, int(last) + 1) if last else size
        if last and int(last) < start:
            return None
    if start >= end:
        words = Phrase("the file has {size} bytes", size=size)
        raise Problem(416, words, field="Range", headers={"Content-Range": f"bytes */{size}"})
    return start, end


def byte_answers(what: str, kinds: Iterable[str]) -> Responses:
    """Return the answers that a download may have, for the OpenAPI document; kinds: media types."""
    content: dict[str, Any] = {kind: {"schema": {}} for kind in kinds}
    return {
        200: {"description": f"the {what}; ETag is its SHA-256", "content": content},
        206: {"description": "the part that Range asked for", "content": content},
        304: {"description": f"the client has this {what}"},
        307: {"description": f"the {what} is at another address, for a short time (artifact store S3)"},
        **refusals(416),
    }


_DOWNLOAD = byte_answers("file", MEDIA_TYPES)

FileName = Annotated[str, Path(max_length=100, description="name of an artifact", examples=["report.json"])]


Number = Annotated[int, Path(ge=1, le=999, description="number of the pass, from 1", examples=[1])]


def _get_and_head(path: str, **options: Any) -> Any:
    """Register a route for GET, which the document shows, and HEAD, as RFC 9110 wants it."""

    def register(function: Any) -> Any:
        name = function.__name__
        router.get(path, operation_id=name, **options)(function)
        head = options | {"summary": f"{options['summary']} (headers only)"}
        router.head(path, operation_id=f"{name}_head", **head)(function)
        return function

    return register


@_get_and_head("/v1/jobs/{id:uuid}/artifacts", summary="List the files of a job")
async def artifacts(request: Request, _: Reader, job_id: JobId) -> ArtifactList:
    """The job's files. Each appears as soon as its stage is committed; programs once all of them have been checked."""
    files = await asyncio.to_thread(services_of(request).book.list_artifacts, str(job_id))
    return ArtifactList(artifacts=[make_artifact_view(file) for file in files])


@_get_and_head(
    "/v1/jobs/{id:uuid}/artifacts/{name}",
    summary="Download a file of a job",
    response_class=Response,
    responses=_DOWNLOAD,
)
async def artifact(request: Request, _: Reader, job_id: JobId, name: FileName, asked: Asked) -> Response:
    """The file's bytes. To go on after a break, ask for the rest with Range, and If-Range with the ETag."""
    file = await asyncio.to_thread(services_of(request).book.find_artifact, str(job_id), name)
    return await send_artifact(request, file, asked)


@_get_and_head(
    "/v1/jobs/{id:uuid}/programs/{n}",
    summary="Download the program of a pass",
    response_class=Response,
    responses=_DOWNLOAD,
)
async def program(request: Request, _: Reader, job_id: JobId, n: Number, asked: Asked) -> Response:
    """The program of pass n, as soon as every program of the job has been checked."""
    services = services_of(request)
    files = await asyncio.to_thread(services.book.list_artifacts, str(job_id))
    found = dict(enumerate(sort_programs(files), 1))
    if n not in found:
        offered = ", ".join(map(str, found)) or Phrase("none yet")
        words = Phrase("the job offers no program {number}; offered: {offered}", number=n, offered=offered)
        raise Problem(404, words, field="n")
    return await send_artifact(request, found[n], asked)


async def send_artifact(request: Request, file: Artifact, asked: Conditions) -> Response:
    """Send the requested part of the file; a browser always gets it from here and not from the store."""
    store, with_body = services_of(request).store, request.method == "GET"
    return await download(store, file, asked, with_body=with_body, elsewhere=not _by_browser(request))


def _by_browser(request: Request) -> bool:
    """Return whether a browser asks: its scripts may not follow to another site, and it would use the hash as file
    name.
    """
    return "sec-fetch-mode" in request.headers or "text/html" in request.headers.get("accept", "")


ZIP: dict[str, Any] = {"application/zip": {"schema": {"type": "string", "format": "binary"}}}
_ANSWERS: Responses = {
    200: {"description": "the archive, stored without compression", "content": ZIP},
    304: {"description": "the client has this archive"},
}


@router.get(
    "/v1/jobs/{id:uuid}/archive.zip",
    summary="Download all files of a job",
    operation_id="archive",
    response_class=Response,
    responses=_ANSWERS,
)
@router.head(
    "/v1/jobs/{id:uuid}/archive.zip",
    summary="Download all files of a job (headers only)",
    operation_id="archive_head",
    response_class=Response,
    responses=_ANSWERS,
)
async def archive(
    request: Request, _: Reader, job_id: JobId, if_none_match: Annotated[str | None, Header()] = None
) -> Response:
    """The files of the present listing as a zip, without those that only the operator page uses: .path, .bin, the
    thumbnail. A job that still runs will have more later.
    """
    services = services_of(request)
    listed = await asyncio.to_thread(services.book.list_artifacts, str(job_id))
    files = [file for file in listed if not is_drawing(file.name)]
    job = await asyncio.to_thread(services.book.get, str(job_id))
    stem = harmless_name(job.name.rpartition(".")[0], default="job")[:60]
    headers = {
        "ETag": _archive_etag(files),
        "Cache-Control": "private, no-cache",
        "Content-Disposition": name_download("attachment", f"{stem}-{job.id[:8]}.zip"),
    }
    if matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if request.method == "HEAD":
        return Response(headers=headers, media_type="application/zip")
    for file in files:
        await asyncio.to_thread(services.store.head, file.sha256)  # refuse now, not in the middle
    pieces = _write_zip(services.store, files)
    return StreamingResponse(iterate_in_threads(pieces), headers=headers, media_type="application/zip")


class _Outlet:
    """A file for zipfile that cannot seek: written bytes wait here until they are taken."""

    def __init__(self) -> None:
        self._held: list[bytes] = []

    def write(self, data: bytes) -> int:
        self._held.append(bytes(data))
        return len(data)

    def flush(self) -> None: ...

    def take(self) -> bytes:
        held, self._held = b"".join(self._held), []
        return held


def _write_zip(store: Store, files: Sequence[Artifact]) -> Iterator[bytes]:
    outlet = _Outlet()
    with zipfile.ZipFile(outlet, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:  # type: ignore[call-overload]
        for file in files:
            with archive.open(zip_entry(file.name), "w", force_zip64=True) as target:
                for piece in store.open_range(file.sha256):
                    target.write(piece)
                    yield outlet.take()
    yield outlet.take()


def _archive_etag(files: Sequence[Artifact]) -> str:
    names = "\n".join(f"{file.name} {file.sha256}" for file in files)
    return f'"{hashlib.sha256(names.encode()).hexdigest()}"'
