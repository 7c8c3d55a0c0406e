"""Files of a job: listing, and downloads that can be resumed."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Request, Response

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.server.api.access.scopes import Reader
from service.server.api.answers.download import Conditions, download
from service.server.api.answers.job_views import MEDIA_TYPES, make_artifact_view, programs
from service.server.api.openapi import Responses, refusals
from service.server.api.routes.jobs import JobId
from service.server.api.services import services_of
from service.server.database.records import Artifact
from service.server.schemas.jobs import ArtifactList

router = APIRouter(tags=["artifacts"])


def byte_answers(what: str, kinds: Iterable[str]) -> Responses:
    """Return what a download may answer, for the document; kinds: media types."""
    content: dict[str, Any] = {kind: {"schema": {}} for kind in kinds}
    return {
        200: {"description": f"the {what}; ETag is its SHA-256", "content": content},
        206: {"description": "the part that Range asked for", "content": content},
        304: {"description": f"the client has this {what}"},
        307: {"description": f"the {what} is at another address, for a short time (artifact store S3)"},
        **refusals(416),
    }


_DOWNLOAD = byte_answers("file", MEDIA_TYPES)

Ranged = Annotated[
    str | None, Header(alias="Range", description="bytes=FIRST-LAST; one range", examples=["bytes=0-99"])
]
IfRange = Annotated[str | None, Header(description="the ETag of the file whose beginning the client has")]
IfNoneMatch = Annotated[str | None, Header(description="the ETag of the file that the client has")]
FileName = Annotated[str, Path(max_length=100, description="name of an artifact", examples=["report.json"])]


def _conditions(ranged: Ranged = None, if_range: IfRange = None, if_none_match: IfNoneMatch = None) -> Conditions:
    return Conditions(ranged, if_range, if_none_match)


Asked = Annotated[Conditions, Depends(_conditions)]
Number = Annotated[int, Path(ge=1, le=999, description="number of the pass, from 1", examples=[1])]


def _get_and_head(path: str, **told: Any) -> Any:
    """Register a route for GET, which the document shows, and HEAD, as RFC 9110 wants it."""

    def register(function: Any) -> Any:
        name = function.__name__
        router.get(path, operation_id=name, **told)(function)
        head = told | {"summary": f"{told['summary']} (headers only)"}
        router.head(path, operation_id=f"{name}_head", **head)(function)
        return function

    return register


@_get_and_head("/v1/jobs/{id:uuid}/artifacts", summary="List the files of a job")
async def artifacts(request: Request, _: Reader, job_id: JobId) -> ArtifactList:
    """Each file is there as soon as its stage is committed; programs once all of them have been checked."""
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
    found = programs(await asyncio.to_thread(services.book.list_artifacts, str(job_id)))
    if n not in found:
        offered = ", ".join(map(str, found)) or Phrase("none yet")
        words = Phrase("the job offers no program {number}; offered: {offered}", number=n, offered=offered)
        raise Problem(404, words, field="n")
    return await send_artifact(request, found[n], asked)


async def send_artifact(request: Request, file: Artifact, asked: Conditions) -> Response:
    """Send the file as it was asked for; a browser gets it from here, whatever store it is in."""
    store, with_body = services_of(request).store, request.method == "GET"
    return await download(store, file, asked, with_body=with_body, elsewhere=not _by_browser(request))


def _by_browser(request: Request) -> bool:
    """Return whether a browser asks: its scripts may not follow to another site, and it would save a hash as name."""
    return "sec-fetch-mode" in request.headers or "text/html" in request.headers.get("accept", "")
