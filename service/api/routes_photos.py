"""POST /v1/jobs/{id}/photos: what a photograph of a lens's light on the wall tells. Nothing is kept of it."""

from __future__ import annotations

import asyncio
import json
import tempfile
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import JSONResponse, Response

from service import job_files
from service.api.answers import answers, example
from service.api.auth import Writer
from service.api.form import JobForm, received_form
from service.api.routes_jobs import JobId
from service.api.schemas_photos import LOOK_EXAMPLE, LookView
from service.api.services import Services, services_of
from service.api.space import Space
from service.errors import PictureError
from service.job.photo.names import FORETOLD
from service.web.problems import Kind, Problem

router = APIRouter()

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


@router.post(
    "/v1/jobs/{id:uuid}/photos",
    tags=["jobs"],
    summary="Look at a photograph of the wall",
    response_model=LookView,
    responses=answers({200: example(LOOK_EXAMPLE)}, 408, 409, 415, 507),
    openapi_extra=_PHOTO_FORM,
)
async def looked(request: Request, principal: Writer, job_id: JobId) -> Response:
    """What is off: distance, tilt, turn, sharpness, surface, each with how surely it is told. A photograph that tells
    nothing is refused with what to do. A caller who asks again of the same job ends the request before with 409.
    """
    services = services_of(request)
    settings, space = services.settings, Space(services.settings)
    await asyncio.to_thread(space.require)
    limit = int(settings.max_upload_mb * 1e6)
    uploads = settings.data / "uploads"
    async with received_form(request, uploads, max_image_bytes=limit, space=space, picture=_PART, small={}) as form:
        with tempfile.TemporaryDirectory(prefix="causticmill-look-") as folder:
            await asyncio.to_thread(_fetch, services, str(job_id), Path(folder))
            asked = {
                "path": str(form.path),
                "name": form.image_name,
                "max_pixels": int(settings.max_megapixels * 1e6),
                "job": folder,
            }
            try:
                async with services.accepting:
                    await asyncio.to_thread(_check_picture, services, form)
                caller = f"{principal.id or principal.name} {job_id}"
                found = await asyncio.wrap_future(services.looks.ask(caller, asked))
            except PictureError as error:
                raise Problem(422, str(error), field=_PART, kind=Kind.PICTURE) from None
    return JSONResponse(found, headers={"Cache-Control": "no-store"})


def _check_picture(services: Services, form: JobForm) -> None:
    services.pictures.check(form.path, form.image_name, int(services.settings.max_megapixels * 1e6))


def _fetch(services: Services, job_id: str, folder: Path) -> None:
    """The files of the job that a look needs. Problem 409 where there is no lens yet."""
    job = services.book.get(job_id)
    files = {file.name: file for file in services.book.artifacts(job_id)}
    missing = [name for name in (job_files.HEIGHTFIELD, job_files.MAP) if name not in files]
    if missing:
        raise Problem(409, f"the job has no {missing[0]} yet: there is no lens to compare a photograph with")
    for name in (job_files.HEIGHTFIELD, job_files.MAP, *FORETOLD.values()):
        if name in files:
            services.store.fetch(files[name].sha256, folder / name)
    (folder / job_files.SPEC).write_text(json.dumps(job.spec), encoding="utf-8")
