"""Everything a job offers in one zip: made while it is sent, the same bytes for the same files."""

from __future__ import annotations

import asyncio
import hashlib
import zipfile
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Header, Request
from starlette.responses import Response, StreamingResponse

from service.http.disposition import name_download
from service.job.files import is_drawing, zip_entry
from service.server.api.access.scopes import Reader
from service.server.api.answers.download import iterate_in_threads, matches
from service.server.api.intake.form import harmless_name
from service.server.api.openapi import Responses
from service.server.api.routes.jobs import JobId
from service.server.api.services import services_of
from service.server.database.records import Artifact
from service.store.base import Store

router = APIRouter(tags=["artifacts"])

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
    """What the listing shows at this moment, as a zip, but for what only the operator page shows: .path, .bin, the
    thumbnail.

    A job that still runs has more later.
    """
    services = services_of(request)
    listed = await asyncio.to_thread(services.book.list_artifacts, str(job_id))
    files = [file for file in listed if not is_drawing(file.name)]
    job = await asyncio.to_thread(services.book.get, str(job_id))
    stem = harmless_name(job.name.rpartition(".")[0], default="job")[:60]
    headers = {
        "ETag": _etag(files),
        "Cache-Control": "private, no-cache",
        "Content-Disposition": name_download("attachment", f"{stem}-{job.id[:8]}.zip"),
    }
    if matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if request.method == "HEAD":
        return Response(headers=headers, media_type="application/zip")
    for file in files:
        await asyncio.to_thread(services.store.head, file.sha256)  # refused now, not in the middle
    pieces = _write_zip(services.store, files)
    return StreamingResponse(iterate_in_threads(pieces), headers=headers, media_type="application/zip")


class _Outlet:
    """A file for zipfile that cannot seek: what is written waits here until it is taken."""

    def __init__(self) -> None:
        self._held: list[bytes] = []

    def write(self, data: bytes) -> int:
        self._held.append(bytes(data))
        return len(data)

    def flush(self) -> None: ...

    def taken(self) -> bytes:
        held, self._held = b"".join(self._held), []
        return held


def _write_zip(store: Store, files: Sequence[Artifact]) -> Iterator[bytes]:
    outlet = _Outlet()
    with zipfile.ZipFile(outlet, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:  # type: ignore[call-overload]
        for file in files:
            with archive.open(zip_entry(file.name), "w", force_zip64=True) as target:
                for piece in store.open_range(file.sha256):
                    target.write(piece)
                    yield outlet.taken()
    yield outlet.taken()


def _etag(files: Sequence[Artifact]) -> str:
    names = "\n".join(f"{file.name} {file.sha256}" for file in files)
    return f'"{hashlib.sha256(names.encode()).hexdigest()}"'
