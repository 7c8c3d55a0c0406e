"""Findings from photographs of a lens's light on the wall, and of a test piece; and the files of the test piece.
Photographs are not stored.
"""

from __future__ import annotations

import asyncio
import json
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Request, Response
from fastapi import Path as InPath

from machines.profile import profile_names
from phrases.phrase import Phrase, phrases_in
from service.errors import PictureError
from service.http.problems import Kind, Problem
from service.job import files as job_files
from service.job.report.pictures import PREDICTED
from service.server.api.access.guard import Writer
from service.server.api.errors import Responses, refusals
from service.server.api.intake.form import Space, receive_form
from service.server.api.routes.files import ZIP, name_download
from service.server.api.routes.jobs import JobId
from service.server.api.services import Services, services_of
from service.server.schemas.photos import CouponView, LookView

router = APIRouter()

ProfileName = Annotated[str, InPath(min_length=1, max_length=64, description="name of a machine profile")]
_PART = "photo"
_PHOTO_FORM: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": [_PART],
                    "additionalProperties": False,
                    "properties": {
                        _PART: {
                            "type": "string",
                            "format": "binary",
                            "description": "the photograph: PNG, JPEG, TIFF, WebP, BMP or GIF",
                        },
                    },
                },
                "encoding": {_PART: {"contentType": "image/*"}},
            }
        },
    }
}
_ZIP_ANSWERS: Responses = {
    200: {"description": "the archive", "content": ZIP},
    **refusals(507),
}


@router.post(
    "/v1/jobs/{id:uuid}/photos",
    tags=["jobs"],
    summary="Look at a photograph of the wall",
    response_model=LookView,
    responses=refusals(408, 409, 415, 507),
    openapi_extra=_PHOTO_FORM,
)
async def post_look(request: Request, response: Response, principal: Writer, job_id: JobId) -> dict[str, Any]:
    """The deviations of the set-up: distance, tilt, turn, sharpness and surface, each with its uncertainty. A
    photograph that shows none of them is refused, with advice. If a caller asks again about the same job, the earlier
    request ends with 409.
    """
    services = services_of(request)
    with tempfile.TemporaryDirectory(prefix="causticmill-look-") as folder:
        async with _receive_photo(request) as photo:
            await asyncio.to_thread(_fetch, services, str(job_id), Path(folder))
            caller = f"{principal.id or principal.name} {job_id}"
            found = await asyncio.wrap_future(services.looks.ask(caller, {**photo, "job": folder}))
    response.headers["Cache-Control"] = "no-store"
    return {**found, "phrases": phrases_in(found)}


@router.get(
    "/v1/profiles/{profile}/coupon.zip",
    tags=["machines"],
    summary="Download a machine's test piece",
    operation_id="coupon",
    response_class=Response,
    responses=_ZIP_ANSWERS,
)
async def download_coupon(request: Request, principal: Writer, profile: ProfileName) -> Response:
    """Programs, setup sheet and predicted light of a test piece that measures the mill and a finish. The first request
    for a machine waits until the piece has been designed.
    """
    services = services_of(request)
    await asyncio.to_thread(_require_profile, profile)
    await asyncio.to_thread(Space(services.settings).require)
    caller = f"{principal.id or principal.name} coupon {profile}"
    making = services.looks.ask(caller, _piece_of(services, profile), is_long=True)
    found = await asyncio.shield(asyncio.wrap_future(making))  # others may wait for it, too
    try:
        archive = await asyncio.to_thread(Path(found["archive"]).read_bytes)
    except FileNotFoundError:
        raise Problem(
            503, Phrase("the test piece is being made again; try again"), headers={"Retry-After": "5"}
        ) from None
    headers = {
        "Cache-Control": "private, no-cache",
        "Content-Disposition": name_download("attachment", job_files.COUPON_ARCHIVE),
    }
    return Response(archive, headers=headers, media_type="application/zip")


@router.post(
    "/v1/profiles/{profile}/coupon/photos",
    tags=["machines"],
    summary="Measure a mill and a finish",
    response_model=CouponView,
    responses=refusals(408, 409, 415, 507),
    openapi_extra=_PHOTO_FORM,
)
async def measure(request: Request, response: Response, principal: Writer, profile: ProfileName) -> dict[str, Any]:
    """Errors of the mill and figures of the finish, from a photograph of the test piece's light, with the values for a
    job's spec. A photograph that shows none of them is refused, with advice. If a caller asks again, the earlier
    request ends with 409.
    """
    services = services_of(request)
    await asyncio.to_thread(_require_profile, profile)
    async with _receive_photo(request) as photo:
        caller = f"{principal.id or principal.name} photo {profile}"
        asked = {**_piece_of(services, profile), **photo}
        found = await asyncio.wrap_future(services.looks.ask(caller, asked, is_long=True))
    response.headers["Cache-Control"] = "no-store"
    return {**found, "phrases": phrases_in(found)}


@asynccontextmanager
async def _receive_photo(request: Request) -> AsyncIterator[dict[str, Any]]:
    """Receive the request's photograph for the process that evaluates it; its file is removed at the end."""
    services = services_of(request)
    most = services.settings.max_pixels
    async with receive_form(request, services.settings, picture=_PART, small={}) as form:
        try:
            async with services.accepting:
                await asyncio.to_thread(services.pictures.check, form.path, form.image_name, most)
            yield {"path": str(form.path), "name": form.image_name, "max_pixels": most}
        except PictureError as error:
            raise Problem(422, str(error), field=_PART, kind=Kind.PICTURE) from None


def _piece_of(services: Services, profile: str) -> dict[str, Any]:
    return {"machine": profile, "pieces": str(services.settings.data / "coupons"), "max_pixels": 0}


def _require_profile(name: str) -> None:
    if name not in (known := profile_names()):
        words = Phrase("there is no machine profile {name}; allowed: {known}", name=repr(name), known=", ".join(known))
        raise Problem(404, words)


def _fetch(services: Services, job_id: str, folder: Path) -> None:
    """Fetch the files of the job that the evaluation needs. Problem 409 where there is no lens yet."""
    job = services.book.get(job_id)
    files = {file.name: file for file in services.book.list_artifacts(job_id)}
    missing = [name for name in (job_files.HEIGHTFIELD, job_files.MAP) if name not in files]
    if missing:
        words = Phrase("the job has no {file} yet: there is no lens to compare a photograph with", file=missing[0])
        raise Problem(409, words)
    for name in (job_files.HEIGHTFIELD, job_files.MAP, *PREDICTED.values()):
        if name in files:
            services.store.fetch(files[name].sha256, folder / name)
    (folder / job_files.SPEC).write_text(json.dumps(job.spec), encoding="utf-8")
