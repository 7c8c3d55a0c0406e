"""POST /v1/jobs: a picture and a spec become a durable job, or nothing at all. POST /v1/estimates: relief, hours and
blur of a job whose form a person still edits; nothing is stored.
"""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

import structlog
from fastapi import APIRouter, Header, Query, Request, Response

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.server.api.access.guard import Writer
from service.server.api.errors import refusals
from service.server.api.intake.form import JobForm, Space, receive_form
from service.server.api.intake.request import JobRequest, idempotency_key, job_request
from service.server.api.job_views import read_view
from service.server.api.services import Services, services_of
from service.server.database.records import ClientKey, Job, NewJob
from service.server.queue.engine import Ticket
from service.server.schemas.jobs import EstimateView, JobView

router = APIRouter()
_LOOK_S = 1.0  # whether somebody still waits
_log = structlog.get_logger("api")

JOB_FORM: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["image"],
                    "additionalProperties": False,
                    "properties": {
                        "image": {
                            "type": "string",
                            "format": "binary",
                            "description": "the picture: PNG, JPEG, TIFF, WebP, BMP or GIF",
                        },
                        "spec": {
                            "type": "string",
                            "contentMediaType": "application/json",
                            "description": "the job spec, a JSON object with the keys of the TOML file",
                            "examples": ['{"preset": "draft", "optics": {"width_mm": 40, "height_mm": 40}}'],
                        },
                        "priority": {"type": "string", "enum": ["high", "normal", "low"], "default": "normal"},
                    },
                },
                "encoding": {"image": {"contentType": "image/*"}, "spec": {"contentType": "application/json"}},
            }
        },
    }
}
_ACCEPTED = {
    "description": "durable: the job will run, whatever happens to the server",
    "headers": {
        "Location": {"description": "address of the job", "schema": {"type": "string"}},
        "Retry-After": {"description": "ask again after so many seconds", "schema": {"type": "integer"}},
    },
}


@router.post(
    "/v1/jobs",
    tags=["jobs"],
    summary="Submit a picture",
    status_code=202,
    responses={202: _ACCEPTED, **refusals(408, 415, 507)},
    openapi_extra=JOB_FORM,
)
async def submit(
    request: Request,
    response: Response,
    principal: Writer,
    idempotency_key_header: Annotated[
        str | None,
        Header(
            alias="Idempotency-Key",
            description="the same key with the same request gives the same job: safe to send again after a fault",
            openapi_examples={"any": {"value": "order-4711-lens-2"}},
        ),
    ] = None,
) -> JobView:
    """A new job. Answers with the job that the same `Idempotency-Key` made before, if this is the same request."""
    services = services_of(request)
    key = idempotency_key(idempotency_key_header, principal)
    async with receive_form(request, services.settings) as form:
        wanted = await asyncio.to_thread(job_request, form)
        await asyncio.to_thread(Space(services.settings).require_for_programs, wanted.spec)
        async with services.accepting:
            job = await asyncio.to_thread(_accept, services, form, wanted, principal.name, key)
    response.headers.update({"Location": job.links["self"], "Retry-After": "1", "ETag": job.etag})
    return job


def _accept(services: Services, form: JobForm, wanted: JobRequest, caller: str, key: ClientKey | None) -> JobView:
    """Check, store, record, hand to the engine: in this order, so that no answer names a job that does not exist."""
    services.pictures.check(form.path, form.image_name, services.settings.max_pixels)
    stored = services.store.put_file(form.path)
    if stored.sha256 != form.image_sha256:
        raise Problem(503, Phrase("the picture changed on its way into the artifact store; send it again"))
    new = NewJob(
        name=form.image_name,
        spec=wanted.spec,
        figures=wanted.figures,
        image_sha256=stored.sha256,
        image_bytes=stored.bytes,
        created_by=caller,
        request_sha256=wanted.sha256,
        priority=wanted.priority,
        key=key,
    )
    job, made = services.book.create(new)
    if made:
        hand_to_engine(services, job)
    return read_view(services, job)


def hand_to_engine(services: Services, job: Job) -> None:
    """Hand the job to the engine. If that fails, workers hand it over later: they look for queued jobs that the engine
    does not know.
    """
    try:
        services.engine.submit(Ticket(job.id, job.attempt), priority=job.priority)
    except Exception as error:  # the engine's database may fail in any way: the job is durable already
        _log.warning("engine did not take the job yet", job=job.id, error=str(error)[:200])


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
    """Relief, hours and blur, from a coarse picture unless it is to be exact. If a caller asks again, earlier requests
    end with 409, except that an exact one does not end a coarse one. Several windows of one caller give themselves
    names, and do not end each other's requests.
    """
    services = services_of(request)
    settings = services.settings
    async with receive_form(request, settings) as form:
        wanted = await asyncio.to_thread(job_request, form)
        async with services.accepting:
            await asyncio.to_thread(services.pictures.check, form.path, form.image_name, settings.max_pixels)
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
            # After the end of this request, the caller's next ones are newer.
            if await request.is_disconnected() and not asking.done():
                estimates.leave(caller)
        found = await answer
    response.headers["Cache-Control"] = "no-store"
    return {"spec": wanted.spec, **found}
