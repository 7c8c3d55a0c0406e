"""What a new job can begin with: the profiles of machines, and what another job was made from."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import JSONResponse, Response

from machines.profiles import ProfileError, load_profile, profile_names
from service.api.answers import answers, example
from service.api.auth import Reader
from service.api.routes_artifacts import Asked, byte_answers, sent
from service.api.routes_jobs import JobId
from service.api.schemas import JOB_EXAMPLE, ProfileList, RequestView
from service.api.services import services_of
from service.asked_spec import asked_spec
from service.jobs.records import Artifact

router = APIRouter()

_PICTURE = "picture"
_PROFILES = {
    "profiles": [
        {"name": "grbl", "description": "desktop router", "dialect": "grbl", "travel_mm": [300.0, 300.0, 80.0]}
    ]
}
_REQUEST = {
    "name": "portrait.png",
    "spec": {"preset": "draft", "optics": {"width_mm": 40.0}},
    "image": f"/v1/jobs/{JOB_EXAMPLE['id']}/image",
}


@router.get(
    "/v1/profiles",
    tags=["machines"],
    summary="List the machine profiles",
    response_model=ProfileList,
    responses=answers({200: example(_PROFILES)}),
)
async def profiles(_: Reader) -> Response:
    """The values that `machine.profile` of a spec may have. A profile that cannot be read is left out."""
    return JSONResponse({"profiles": await asyncio.to_thread(_profiles)})


@router.get(
    "/v1/jobs/{id:uuid}/request",
    tags=["jobs"],
    summary="What a job was asked for with",
    response_model=RequestView,
    responses=answers({200: example(_REQUEST)}),
)
async def asked(request: Request, _: Reader, job_id: JobId) -> Response:
    """To be changed and posted as a new job: the spec is as short as it can be, and resolves to that of the job."""
    job = await asyncio.to_thread(services_of(request).book.get, str(job_id))
    spec = await asyncio.to_thread(asked_spec, job.spec)
    return JSONResponse({"name": job.name, "spec": spec, "image": f"/v1/jobs/{job.id}/image"})


@router.get(
    "/v1/jobs/{id:uuid}/image",
    tags=["jobs"],
    summary="The picture a job was made from",
    response_class=Response,
    responses=byte_answers("picture", ["application/octet-stream"]),
)
async def image(request: Request, _: Reader, job_id: JobId, asked: Asked) -> Response:
    """The very bytes that were uploaded. They are a stranger's: no browser shows them as a page of ours."""
    job = await asyncio.to_thread(services_of(request).book.get, str(job_id))
    file = Artifact(
        job_id=job.id,
        name=_PICTURE,
        sha256=job.image_sha256,
        bytes=job.image_bytes,
        stage="",
        created_at=job.created_at,
    )
    return await sent(request, file, asked)


def _profiles() -> list[dict[str, Any]]:
    found = []
    for name in profile_names():
        try:
            profile = load_profile(name)
        except ProfileError:
            continue
        found.append(
            {
                "name": profile.name,
                "description": profile.description,
                "dialect": profile.dialect,
                "travel_mm": list(profile.travel_mm),
            }
        )
    return found
