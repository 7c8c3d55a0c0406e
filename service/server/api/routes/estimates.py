"""POST /v1/estimates: what a job would come to, while a person still edits its form. Nothing is kept of it."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response

from service.server.api.access.scopes import Writer
from service.server.api.intake.disk_space import Space
from service.server.api.intake.form import JobForm, receive_form
from service.server.api.intake.request import job_request
from service.server.api.openapi import refusals
from service.server.api.routes.submit import JOB_FORM
from service.server.api.services import Services, services_of
from service.server.schemas.estimates import EstimateView

router = APIRouter()
_LOOK_S = 1.0  # whether somebody still waits

Tab = Annotated[
    str,
    Header(alias="Causticmill-Tab", max_length=64, pattern=r"^[!-~]*$", description="any word; one for each window"),
]

Exactly = Annotated[bool, Query(description="from a lens as fine as the picture, planned as the job's: half a minute")]


@router.post(
    "/v1/estimates",
    tags=["jobs"],
    summary="Estimate a job",
    response_model=EstimateView,
    responses=refusals(408, 409, 415, 507),
    openapi_extra=JOB_FORM,
)
async def post_estimate(
    request: Request, response: Response, principal: Writer, tab: Tab = "", exactly: Exactly = False
) -> dict[str, Any]:
    """Relief, hours and blur, from a coarse picture unless it is to be exact. A caller who asks again ends the requests
    before with 409, but an exact one lets a coarse one be; several windows of one caller name themselves, and do not
    end each other's.
    """
    services = services_of(request)
    settings, space = services.settings, Space(services.settings)
    await asyncio.to_thread(space.require)
    limit = settings.max_upload_bytes
    async with receive_form(request, settings.data / "uploads", max_image_bytes=limit, space=space) as form:
        wanted = await asyncio.to_thread(job_request, form)
        async with services.accepting:
            await asyncio.to_thread(_check_picture, services, form)
        asked = {
            "path": str(form.path),
            "name": form.image_name,
            "max_pixels": settings.max_pixels,
            "spec": wanted.spec,
            "figures": wanted.figures,
            "exactly": exactly,
            "plans": str(settings.plans),
        }
        caller = f"{principal.id or principal.name} {tab}"
        estimates = services.exact_estimates if exactly else services.estimates
        if not exactly:
            services.exact_estimates.leave(caller)
        asking = estimates.ask(caller, asked, is_long=exactly)
        answer = asyncio.wrap_future(asking)
        while not (await asyncio.wait({answer}, timeout=_LOOK_S))[0]:
            # Once this one has ended, the caller's asks are newer ones.
            if await request.is_disconnected() and not asking.done():
                estimates.leave(caller)
        found = await answer
    response.headers["Cache-Control"] = "no-store"
    return {"spec": wanted.spec, **found}


def _check_picture(services: Services, form: JobForm) -> None:
    services.pictures.check(form.path, form.image_name, services.settings.max_pixels)
