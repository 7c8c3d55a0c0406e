"""What a new job can begin with: the profiles of machines, the shop's own among them; the end mills that the shop has;
and what another job was made from.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from pydantic import Field

from machines.profile import MachineProfile, ProfileError, load_profile, profile_names
from service.http.schema import Body, phrase_views
from service.job.spec.loading import reduce_spec
from service.job.spec.own_files import forget_profile, read_stated_profiles, save_profile
from service.job.spec.tools import BUILT_IN, forget_tools, library_file, load_tools, save_tools
from service.server.api.access.guard import Operator, Reader, Writer
from service.server.api.routes.files import Asked, byte_answers, send_artifact
from service.server.api.routes.jobs import JobId
from service.server.api.services import services_of
from service.server.database.records import Artifact
from service.server.fleet.registry import KnownMachine, read_machines
from service.server.schemas.jobs import (
    ProfileBody,
    ProfileList,
    ProfileMill,
    ProfileView,
    RequestView,
)
from service.settings import ServerSettings

router = APIRouter()

OwnName = Annotated[
    str,
    Path(
        min_length=1,
        max_length=40,
        pattern=r"^[^\x00-\x1f\x7f/\\. ][^\x00-\x1f\x7f/\\]*$",
        description="of the profile",
        examples=["shop-mill"],
    ),
]

_PICTURE = "picture"
_AS_THEY_ARE = ProfileView.model_fields.keys() - {"mills", "built_in", "stated"}


@router.get("/v1/profiles", tags=["machines"], summary="List the machine profiles")
async def profiles(request: Request, _: Reader) -> ProfileList:
    """The values that `machine.profile` of a spec may have, each with the mills of this server that its programs are
    for. A profile that cannot be read is left out.
    """
    return await asyncio.to_thread(_read_profiles, services_of(request).settings)


@router.put("/v1/profiles/{profile}", tags=["machines"], summary="State a mill of the shop")
async def put_profile(request: Request, _: Operator, profile: OwnName, body: ProfileBody) -> ProfileList:
    """From now on new jobs can be made for it; existing jobs keep their figures. Only its file can state its link."""
    await asyncio.to_thread(save_profile, profile, body.model_dump(exclude_none=True))
    return await asyncio.to_thread(_read_profiles, services_of(request).settings)


@router.delete("/v1/profiles/{profile}", tags=["machines"], summary="Take a mill of the shop away")
async def delete_profile(request: Request, _: Operator, profile: OwnName) -> ProfileList:
    await asyncio.to_thread(forget_profile, profile)
    return await asyncio.to_thread(_read_profiles, services_of(request).settings)


@router.get("/v1/jobs/{id:uuid}/request", tags=["jobs"], summary="What a job was asked for with")
async def get_request(request: Request, _: Reader, job_id: JobId) -> RequestView:
    """A request to change and post as a new job: its spec is as short as possible and resolves to the job's own."""
    job = await asyncio.to_thread(services_of(request).book.get, str(job_id))
    spec = await asyncio.to_thread(reduce_spec, job.spec)
    return RequestView(name=job.name, spec=spec, image=f"/v1/jobs/{job.id}/image")


@router.get(
    "/v1/jobs/{id:uuid}/image",
    tags=["jobs"],
    summary="The picture a job was made from",
    response_class=Response,
    responses=byte_answers("picture", ["application/octet-stream"]),
)
async def image(request: Request, _: Reader, job_id: JobId, asked: Asked) -> Response:
    """The bytes as they were uploaded, with headers that keep a browser from showing them as a page of this server."""
    job = await asyncio.to_thread(services_of(request).book.get, str(job_id))
    file = Artifact(
        job_id=job.id,
        name=_PICTURE,
        sha256=job.image_sha256,
        bytes=job.image_bytes,
        stage="",
        created_at=job.created_at,
    )
    return await send_artifact(request, file, asked)


def _read_profiles(settings: ServerSettings) -> ProfileList:
    profiles = []
    for name in profile_names():
        with contextlib.suppress(ProfileError):
            profiles.append(load_profile(name))
    mills = mills_by_profile(read_machines(settings)[0].values(), profiles)
    stated, built_in = read_stated_profiles(), profile_names(())
    return ProfileList(
        profiles=[
            ProfileView(
                **{key: getattr(profile, key) for key in _AS_THEY_ARE},
                mills=[ProfileMill(name=mill.name, simulated=mill.simulated) for mill in mills.get(profile.name, ())],
                built_in=profile.name in built_in,
                stated=ProfileBody.model_validate(stated[profile.name]) if profile.name in stated else None,
            )
            for profile in profiles
        ],
        phrases=phrase_views([profile.description for profile in profiles]),
    )


def mills_by_profile(
    mills: Iterable[KnownMachine], profiles: Sequence[MachineProfile]
) -> dict[str, list[KnownMachine]]:
    """List mills by profile. A mill uses the profile of its name; if there is none, the first profile that makes the
    same programs.
    """
    found: dict[str, list[KnownMachine]] = {}
    names = {profile.name for profile in profiles}
    for mill in mills:
        alike = (one.name for one in profiles if mill.profile is not None and _are_made_alike(one, mill.profile))
        name = mill.name if mill.name in names else next(alike, None)
        if name is not None:
            found.setdefault(name, []).append(mill)
    return found


def _are_made_alike(one: MachineProfile, other: MachineProfile) -> bool:
    """Return whether programs for one fit the other: all figures agree except name, link and homing."""
    ours, theirs = asdict(one), asdict(other)
    return all(ours[key] == theirs[key] for key in ours.keys() - {"name", "description", "link", "homing"})


class ToolView(Body):
    """An end mill; lengths in mm. Balls finish, flat ends only rough.

    Of two that do equally well a plan takes the one with the lower cost_class.
    """

    name: Annotated[str, Field(min_length=1, max_length=40, pattern=r"^[^\x00-\x1f\x7f]*$", examples=["ball-r1"])]
    radius_mm: Annotated[float, Field(ge=0.05, le=25)]
    flutes: Annotated[int, Field(ge=1, le=8)] = 2
    flute_length_mm: Annotated[float, Field(ge=0.1, le=200, description="how high it cuts, from its tip")]
    shank_radius_mm: Annotated[float, Field(ge=0.1, le=50)]
    stick_out_mm: Annotated[float, Field(ge=0.5, le=300, description="from its tip to the chuck")]
    max_rpm: Annotated[float, Field(ge=100, le=200_000)] = 30_000
    cost_class: Annotated[int, Field(ge=1, le=3)] = 2
    corner_radius_mm: Annotated[
        float | None,
        Field(ge=0, le=25, description="0: flat; less than radius_mm: bull-nose; left out: a ball"),
    ] = None
    number: Annotated[int | None, Field(ge=1, le=9999, description="in the mill's tool table")] = None


class ToolsBody(Body):
    tools: Annotated[list[ToolView], Field(min_length=1, max_length=100)]


class ToolList(ToolsBody):
    own: Annotated[bool, Field(description="a list of the shop's own; false: the usual ones")]


@router.get("/v1/tools", tags=["machines"], summary="List the end mills that plans choose among")
async def get_tools(_: Reader) -> ToolList:
    """The end mills in tools.toml, in the configuration of the server's account; without that file, the usual ones."""
    return await asyncio.to_thread(_read_tools)


@router.put("/v1/tools", tags=["machines"], summary="State the end mills that the shop has")
async def put_tools(_: Writer, body: ToolsBody) -> ToolList:
    """From now on new jobs are planned with these alone; existing jobs keep their plans."""
    await asyncio.to_thread(save_tools, [tool.model_dump(exclude_none=True) for tool in body.tools])
    return await asyncio.to_thread(_read_tools)


@router.delete("/v1/tools", tags=["machines"], summary="Go back to the usual end mills")
async def delete_tools(_: Writer) -> ToolList:
    await asyncio.to_thread(forget_tools)
    return await asyncio.to_thread(_read_tools)


def _read_tools() -> ToolList:
    tools = [ToolView.model_validate(tool) for tool in load_tools()]
    return ToolList(tools=tools, own=library_file() != BUILT_IN)
