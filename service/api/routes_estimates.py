"""POST /v1/estimates: what a job would come to, while a person still turns the knobs. Nothing is kept of it."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Header, Request
from starlette.responses import JSONResponse, Response

from service.api.answers import answers, example
from service.api.auth import Writer
from service.api.form import JobForm, received_form
from service.api.job_request import job_request
from service.api.routes_submit import JOB_FORM
from service.api.schemas_estimates import ESTIMATE_EXAMPLE, EstimateView
from service.api.services import Services, services_of
from service.api.space import Space

router = APIRouter()

Tab = Annotated[
    str,
    Header(alias="Causticmill-Tab", max_length=64, pattern=r"^[!-~]*$", description="any word; one for each window"),
]


@router.post(
    "/v1/estimates",
    tags=["jobs"],
    summary="Estimate a job",
    response_model=EstimateView,
    responses=answers({200: example(ESTIMATE_EXAMPLE)}, 408, 409, 415, 507),
    openapi_extra=JOB_FORM,
)
async def estimated(request: Request, principal: Writer, tab: Tab = "") -> Response:
    """Relief, hours and blur, from a coarse picture. A caller who asks again ends the request before with 409; several
    windows of one caller name themselves, and do not end each other's.
    """
    services = services_of(request)
    settings, space = services.settings, Space(services.settings)
    await asyncio.to_thread(space.require)
    limit = int(settings.max_upload_mb * 1e6)
    async with received_form(request, settings.data / "uploads", max_image_bytes=limit, space=space) as form:
        wanted = await asyncio.to_thread(job_request, form)
        async with services.accepting:
            await asyncio.to_thread(_check_picture, services, form)
        asked = {
            "path": str(form.path),
            "name": form.image_name,
            "max_pixels": int(settings.max_megapixels * 1e6),
            "spec": wanted.spec,
        }
        caller = f"{principal.id or principal.name} {tab}"
        found = await asyncio.wrap_future(services.estimates.ask(caller, asked))
    return JSONResponse({**found, "spec": wanted.spec}, headers={"Cache-Control": "no-store"})


def _check_picture(services: Services, form: JobForm) -> None:
    services.pictures.check(form.path, form.image_name, int(services.settings.max_megapixels * 1e6))
